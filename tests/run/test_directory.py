import json
import re
import threading
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime, timedelta

import pytest

from wheelleg_exp.errors import ConfigError, RunDirectoryError
from wheelleg_exp.run.run_directory import RunDirectory, create_exclusively

NOW = datetime(2026, 1, 31, 17, 5, 9)


def test_the_name_is_task_time_seed_and_name(tmp_path, monkeypatch):
    root, name = tmp_path / "runs", "2026-01-31_17-05-09_42_fast"
    directory = RunDirectory.create(root, "walk", 42, "fast", NOW)
    assert (directory.path, directory.id, directory.root) == (root / "walk" / name, name, root)
    assert directory.path.is_dir()
    monkeypatch.chdir(tmp_path)  # A relative root folder gives an absolute run directory.
    assert RunDirectory.create("runs", "walk", 0, now=NOW).path == tmp_path / "runs/walk/2026-01-31_17-05-09_0"


def test_a_taken_name_gets_a_number_even_if_many_runs_start_at_once(tmp_path):
    names = [RunDirectory.create(tmp_path, "walk", 0, now=NOW).id for _ in range(3)]
    assert names == ["2026-01-31_17-05-09_0", "2026-01-31_17-05-09_0-2", "2026-01-31_17-05-09_0-3"]
    barrier = threading.Barrier(16)
    with ThreadPoolExecutor(16) as pool:
        assert len(set(pool.map(lambda _: (barrier.wait(), create_exclusively(tmp_path, "x"))[1], range(16)))) == 16


@pytest.mark.parametrize("name", ["", 5, "a/b", "..", ".hidden", "a b", "ä", "x" * 101, "-x", "a\n"])
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
    with pytest.raises(ConfigError, match=r"task\.name: .* is reserved and cannot be the name"):
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


def test_latest_ignores_agents_and_sweeps(make_run, tmp_path):
    run = make_run()
    root = tmp_path / "runs"
    agent = RunDirectory.create(root, "walk", 1, "zero", datetime.now() + timedelta(days=1), section="agents")
    (agent.path / "manifest.json").write_bytes((run.path / "manifest.json").read_bytes())
    sweep = root / "sweeps" / "2030-01-01_00-00-00_1"
    sweep.mkdir(parents=True)
    (sweep / "manifest.json").write_bytes((run.path / "manifest.json").read_bytes())
    assert (agent.path.parent, agent.root, RunDirectory.open("latest", root)) == (root / "agents" / "walk", root, run)
    assert RunDirectory.open(f"agents/walk/{agent.id}", root) == agent


def test_a_name_that_opens_no_run_is_refused_with_the_reason(make_run, tmp_path):
    def refusal(name):
        with pytest.raises(RunDirectoryError) as caught:
            RunDirectory.open(name, tmp_path / "runs")
        return str(caught.value)

    assert "there is no run below" in refusal("latest")
    run, newest = make_run(name="gentle", now=NOW), make_run(now=NOW + timedelta(days=4))
    assert re.search(f"there is no run.*did you mean '{run.id}'", refusal(run.id.replace("gentle", "gentel")))
    make_run("stand", name="gentle", now=NOW)
    assert f"names 2 runs; expected one of stand/{run.id} and walk/{run.id}" in refusal(run.id)
    run.params.mkdir()
    assert f"did you mean '{run.path}'" in refusal(run.params)
    (tmp_path / "folder").mkdir()
    assert "is not a run directory: it has no manifest.json" in refusal(tmp_path / "folder")
    (newest.path / "manifest.json").write_text("{")
    assert "broken JSON" in refusal("latest")  # An older run does not take the place of a damaged newest run.


@pytest.mark.parametrize("change", [{"format": 99}, {"files": {"../x": {"sha256": "", "size": 0}}}, {"status": "done"}])
def test_a_manifest_that_cannot_be_believed_is_refused(make_run, tmp_path, change):
    run = make_run()
    path = run.path / "manifest.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), **change}))
    with pytest.raises(RunDirectoryError, match=r"manifest\.json"):
        RunDirectory.open(run.path, tmp_path)


def test_checkpoints_are_sorted_by_number_and_a_missing_one_names_the_nearest(make_run):
    run = make_run()
    with pytest.raises(RunDirectoryError, match="has no checkpoint"):
        run.latest_checkpoint()
    for name in ("model_100.pt", "model_9.pt", "model_20.pt", "model_x.pt", "model_3.pt.tmp", "policy.pt"):
        (run.path / name).write_bytes(b"")
    assert [p.name for p in run.checkpoints()] == ["model_9.pt", "model_20.pt", "model_100.pt"]
    assert (run.latest_checkpoint().name, run.checkpoint(20).name) == ("model_100.pt", "model_20.pt")
    with pytest.raises(RunDirectoryError, match=r"one of 9, 20, 100; did you mean 'model_20\.pt'"):
        run.checkpoint(19)


def test_a_name_that_leaves_the_directory_is_refused(make_run, tmp_path):
    run = make_run()
    assert run.inside("play/a.rrd") == run.path / "play" / "a.rrd"
    (run.path / "link").symlink_to(tmp_path)
    for name in ("../x", "/etc/passwd", "a/../../x", "", "link/x"):
        with pytest.raises(RunDirectoryError, match="outside"):
            run.inside(name)
