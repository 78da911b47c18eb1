from __future__ import annotations

import json
import threading
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime, timedelta

import pytest

from wheelleg_exp.errors import ConfigError, RunDirectoryError
from wheelleg_exp.run.run_directory import RunDirectory, create_exclusively

NOW = datetime(2026, 1, 31, 17, 5, 9)


def test_the_name_is_task_time_seed_and_name(tmp_path, monkeypatch):
    directory = RunDirectory.create(tmp_path / "runs", "walk", 42, "fast", NOW)
    assert directory.path == tmp_path / "runs" / "walk" / "2026-01-31_17-05-09_42_fast"
    assert directory.path.is_dir()
    assert (directory.id, directory.root) == ("2026-01-31_17-05-09_42_fast", tmp_path / "runs")
    monkeypatch.chdir(tmp_path)  # A relative root folder gives an absolute run directory.
    assert RunDirectory.create("runs", "walk", 0, now=NOW).path == tmp_path / "runs/walk/2026-01-31_17-05-09_0"


def test_a_taken_name_gets_a_number(tmp_path):
    names = [RunDirectory.create(tmp_path, "walk", 0, now=NOW).id for _ in range(3)]
    assert names == ["2026-01-31_17-05-09_0", "2026-01-31_17-05-09_0-2", "2026-01-31_17-05-09_0-3"]


def test_many_that_start_in_one_moment_get_a_directory_each(tmp_path):
    barrier = threading.Barrier(16)

    def make(_):
        barrier.wait()
        return create_exclusively(tmp_path, "x")

    with ThreadPoolExecutor(16) as pool:
        assert len(set(pool.map(make, range(16)))) == 16


@pytest.mark.parametrize("name", ["", "a/b", "..", ".hidden", "a b", "ä", "x" * 101, "-x", "a\n"])
def test_a_name_that_no_folder_should_have_is_refused(tmp_path, name):
    with pytest.raises(ConfigError, match=r"run\.name: "):
        RunDirectory.create(tmp_path, "walk", 0, name, NOW)
    with pytest.raises(ConfigError, match=r"task\.name: "):
        RunDirectory.create(tmp_path, name, 0, None, NOW)
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "runs").write_text("")
    with pytest.raises(RunDirectoryError, match="cannot write"):
        RunDirectory.create(tmp_path / "runs", "walk", 0)


@pytest.mark.parametrize("task", ["agents", "sweeps", "latest"])
def test_a_task_cannot_take_a_name_that_means_something_else(tmp_path, task):
    with pytest.raises(ConfigError, match="is reserved and cannot be the name"):
        RunDirectory.create(tmp_path, task, 0)


def test_a_run_opens_by_path_id_and_task_with_id(make_run, tmp_path, monkeypatch):
    run = make_run()
    root = tmp_path / "runs"
    for name in (run.path, str(run.path), run.id, f"walk/{run.id}", run):
        assert RunDirectory.open(name, root) == run
    monkeypatch.chdir(tmp_path)
    assert RunDirectory.open(f"runs/walk/{run.id}/", "elsewhere") == run


def test_latest_is_the_newest_start_in_any_manifest_whatever_the_name(make_run, tmp_path):
    base = datetime(2026, 1, 1, 12, tzinfo=UTC)
    make_run("walk", now=base)
    newest = make_run("stand", now=base + timedelta(hours=2))
    make_run("walk", now=base + timedelta(hours=1))
    assert RunDirectory.open("latest", tmp_path / "runs") == newest
    renamed = newest.path.rename(newest.path.with_name("2000-01-01_00-00-00_1"))
    assert RunDirectory.open("latest", tmp_path / "runs").path == renamed


def test_latest_looks_neither_at_agents_nor_at_sweeps(make_run, tmp_path):
    run = make_run()
    root = tmp_path / "runs"
    agent = RunDirectory.create(root, "walk", 1, "zero", datetime.now() + timedelta(days=1), section="agents")
    (agent.path / "manifest.json").write_bytes((run.path / "manifest.json").read_bytes())
    sweep = root / "sweeps" / "2030-01-01_00-00-00_1"
    sweep.mkdir(parents=True)
    (sweep / "manifest.json").write_bytes((run.path / "manifest.json").read_bytes())
    assert (agent.path.parent, agent.root, RunDirectory.open("latest", root)) == (root / "agents" / "walk", root, run)
    assert RunDirectory.open(f"agents/walk/{agent.id}", root) == agent


def test_a_run_that_does_not_exist_is_told_with_the_nearest(make_run, tmp_path):
    root = tmp_path / "runs"
    with pytest.raises(RunDirectoryError, match="there is no run below"):
        RunDirectory.open("latest", root)
    run = make_run(name="gentle")
    with pytest.raises(RunDirectoryError, match=f"there is no run.*did you mean '{run.id}'"):
        RunDirectory.open(run.id.replace("gentle", "gentel"), root)
    (tmp_path / "folder").mkdir()
    with pytest.raises(RunDirectoryError, match=r"is not a run directory: it has no manifest\.json"):
        RunDirectory.open(tmp_path / "folder", root)


def test_a_newest_run_that_is_damaged_is_not_passed_over(make_run, tmp_path):
    make_run(now=datetime(2026, 1, 1, tzinfo=UTC))
    (make_run(now=datetime(2026, 1, 5, tzinfo=UTC)).path / "manifest.json").write_text("{")
    with pytest.raises(RunDirectoryError, match="broken JSON"):
        RunDirectory.open("latest", tmp_path / "runs")


def test_a_path_into_a_run_names_the_run(make_run, tmp_path):
    run = make_run()
    run.params.mkdir()
    with pytest.raises(RunDirectoryError) as caught:
        RunDirectory.open(run.params, tmp_path / "runs")
    assert caught.value.nearest == str(run.path)


def test_an_id_of_two_tasks_is_ambiguous(make_run, tmp_path):
    run = make_run("walk", now=NOW)
    make_run("stand", now=NOW)
    with pytest.raises(RunDirectoryError, match=f"names 2 runs; expected one of stand/{run.id} and walk/{run.id}"):
        RunDirectory.open(run.id, tmp_path / "runs")


@pytest.mark.parametrize("change", [{"format": 99}, {"files": {"../x": {"sha256": "", "size": 0}}}, {"status": "done"}])
def test_a_manifest_that_cannot_be_believed_is_refused(make_run, tmp_path, change):
    run = make_run()
    path = run.path / "manifest.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), **change}))
    with pytest.raises(RunDirectoryError, match=r"manifest\.json"):
        RunDirectory.open(run.path, tmp_path)


def test_checkpoints_are_sorted_by_number(make_run):
    run = make_run()
    for name in ("model_100.pt", "model_9.pt", "model_20.pt", "model_x.pt", "model_3.pt.tmp", "policy.pt"):
        (run.path / name).write_bytes(b"")
    assert [p.name for p in run.checkpoints()] == ["model_9.pt", "model_20.pt", "model_100.pt"]
    assert (run.latest_checkpoint().name, run.checkpoint(20).name) == ("model_100.pt", "model_20.pt")


def test_a_missing_checkpoint_names_the_nearest(make_run):
    run = make_run()
    with pytest.raises(RunDirectoryError, match="has no checkpoint"):
        run.latest_checkpoint()
    for iteration in (9, 19):
        (run.path / f"model_{iteration}.pt").write_bytes(b"")
    with pytest.raises(RunDirectoryError, match=r"one of 9, 19; did you mean 'model_19\.pt'"):
        run.checkpoint(18)


def test_a_name_that_leaves_the_directory_is_refused(make_run, tmp_path):
    run = make_run()
    assert run.inside("play/a.rrd") == run.path / "play" / "a.rrd"
    (run.path / "link").symlink_to(tmp_path)
    for name in ("../x", "/etc/passwd", "a/../../x", "", "link/x"):
        with pytest.raises(RunDirectoryError, match="outside"):
            run.inside(name)
