import json
import shutil
import subprocess
import sys
import tracemalloc
from datetime import UTC, datetime, timedelta

import pytest
from effort import bytecodes
from patience import wait_until

from wheelleg_exp.run.run_directory import NEEDED
from wheelleg_exp.run.run_index import SweepIndex
from wheelleg_exp.run.run_list import list_runs, list_sweeps, summarize
from wheelleg_exp.run.run_lock import is_alive, this_process

START = datetime(2026, 1, 1, 12, tzinfo=UTC)


def set_process(run, **changes):
    path = run.path / "manifest.json"
    data = json.loads(path.read_text())
    data["process"].update(changes)
    path.write_text(json.dumps(data))


@pytest.fixture
def dead_pid():
    process = subprocess.Popen([sys.executable, "-c", ""])
    process.wait()
    return process.pid


def test_runs_of_all_tasks_are_listed_newest_first(make_run, tmp_path):
    assert list_runs(tmp_path / "runs") == []
    a = make_run("walk", 1, now=START)
    b = make_run("stand", 2, now=START + timedelta(hours=2))
    c = make_run("walk", 3, now=START + timedelta(hours=1))
    c.manifest().finish("finished", {"survival": 1.0})
    (tmp_path / "runs" / "walk" / "notes").mkdir()
    (tmp_path / "runs" / "README.md").write_text("")
    found = list_runs(tmp_path / "runs")
    assert ([s.id for s in found], [s.task for s in found]) == ([b.id, c.id, a.id], ["stand", "walk", "walk"])
    assert ([s.status for s in found], found[1].results) == (["running", "finished", "running"], {"survival": 1.0})
    assert found[1].seeds == (3,)


@pytest.mark.parametrize(
    ("changes", "status"),
    [
        ({"pid": "dead"}, "crashed"),
        ({"start_ticks": 1}, "crashed"),  # A later process has the same pid.
        ({"boot_id": "00000000-0000-0000-0000-000000000000"}, "crashed"),
        ({"pid": "dead", "host": "elsewhere"}, "running"),
    ],
)
def test_a_run_has_crashed_if_its_process_has_ended(make_run, tmp_path, dead_pid, changes, status):
    run = make_run()
    set_process(run, **{key: dead_pid if value == "dead" else value for key, value in changes.items()})
    assert [s.status for s in list_runs(tmp_path / "runs")] == [status]
    run.manifest().finish("finished")
    assert [s.status for s in list_runs(tmp_path / "runs")] == ["finished"]


def test_a_run_with_a_broken_or_missing_manifest_is_listed_as_damaged(make_run, tmp_path):
    make_run(now=START)
    for hours in (1, 2):
        make_run(now=START + timedelta(hours=hours))
    without, broken = (path / "manifest.json" for path in sorted((tmp_path / "runs" / "walk").iterdir())[:0:-1])
    broken.write_text("{")
    without.unlink()
    *damaged, whole = list_runs(tmp_path / "runs")
    assert [(s.status, s.started) for s in damaged] == [("damaged", START + timedelta(hours=n)) for n in (2, 1)]
    assert ("has no manifest.json" in damaged[0].problem, "broken JSON" in damaged[1].problem) == (True, True)
    assert whole.status == "running"


def written(run, iterations, *, checkpoints=(), total=10, cut=""):
    scalars = {"Train/mean_reward": 1.5, "Train/mean_episode_length": 30.0, "Episode_Termination/time_out": 0.25}
    lines = [{"iteration": i, "digests": {}, "scalars": scalars} for i in range(iterations)]
    (run.path / "iterations.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines) + cut)
    (run.path / "params").mkdir(exist_ok=True)
    (run.path / "params" / "agent.yaml").write_text(f"device: cpu\nmax_iterations: {total}\n")
    for iteration in checkpoints:
        (run.path / f"model_{iteration}.pt").write_bytes(b"x" * 100)
    return run


def test_a_crashed_run_is_listed_with_its_progress_from_the_end_of_its_log(make_run, tmp_path, dead_pid):
    run = written(make_run(name="mine"), 7, checkpoints=(0, 5), cut='{"iteration": 7, "sca')
    set_process(run, pid=dead_pid)
    (found,) = list_runs(tmp_path / "runs")
    assert (found.status, found.name) == ("crashed", "mine")
    assert (found.iterations, found.max_iterations, found.checkpoint, found.resumable) == (7, 10, 5, True)
    assert found.figures == {"return": 1.5, "episode_length": 30.0, "time_out": 0.25}
    assert found.seconds is not None
    written(run, 10, checkpoints=(9,))  # The process was killed during the export.
    (found,) = list_runs(tmp_path / "runs")
    assert (found.status, found.iterations, found.max_iterations, found.resumable) == ("crashed", 10, 10, True)


def test_how_long_a_resumed_run_took_leaves_out_the_pauses(make_run, tmp_path):
    run = written(make_run(now=START), 6)
    lines = [json.loads(text) for text in run.iterations.read_text().splitlines()]
    for line in lines:
        line["scalars"] |= {"Perf/collection_time": 1.5, "Perf/learning_time": 0.5, "Perf/total_fps": 100.0}
    run.iterations.write_text("".join(json.dumps(line) + "\n" for line in lines))
    run.manifest().finish("interrupted", {}, now=START + timedelta(seconds=20))
    (stopped,) = list_runs(tmp_path / "runs")
    assert stopped.seconds == pytest.approx(20.0)
    manifest = run.manifest()
    manifest.restart(command=["wheelleg", "resume"], threads={}, now=START + timedelta(minutes=24))
    manifest.finish("finished", {}, now=START + timedelta(minutes=25))
    (resumed,) = list_runs(tmp_path / "runs")
    assert resumed.seconds == pytest.approx(6 * 2.0)
    run.iterations.unlink()
    assert list_runs(tmp_path / "runs")[0].seconds == 0.0


@pytest.mark.parametrize(
    ("end", "iterations", "checkpoint", "resumable"),
    [
        (None, 3, 0, False),  # The run still runs.
        ("interrupted", 6, 5, True),
        ("failed", 6, 5, True),
        ("finished", 10, 9, False),
        ("interrupted", 3, 5, False),  # The log ends before the last checkpoint.
        ("finished", 10, 5, True),  # The last checkpoint is lost.
    ],
)
def test_only_runs_that_stopped_early_can_be_resumed(make_run, tmp_path, end, iterations, checkpoint, resumable):
    run = written(make_run(), iterations, checkpoints=(checkpoint,))
    if end is not None:
        run.manifest().finish(end, {"iterations": iterations}, "disk full" if end == "failed" else None)
    (found,) = list_runs(tmp_path / "runs")
    assert (found.status, found.resumable) == (end or "running", resumable)
    assert found.problem == ("disk full" if end == "failed" else None)


@pytest.mark.parametrize("iterations", [0, 2])
@pytest.mark.parametrize("lacks", [None, *NEEDED])
def test_a_run_without_a_checkpoint_restarts_if_its_files_exist(make_run, tmp_path, dead_pid, iterations, lacks):
    run = written(make_run(), iterations)
    for name in NEEDED:
        (run.path / name).parent.mkdir(exist_ok=True)
        (run.path / name).touch()
    if lacks is not None:
        (run.path / lacks).unlink()
    set_process(run, pid=dead_pid)
    (found,) = list_runs(tmp_path / "runs")
    assert (found.status, found.checkpoint, found.resumable) == ("crashed", None, lacks is None)


def test_results_of_plays_and_exports_are_listed(make_run, tmp_path):
    run = written(make_run(), 10)
    run.manifest().finish("finished")
    assert (list_runs(tmp_path / "runs")[0].played, list_runs(tmp_path / "runs")[0].bundles) == ({}, ())
    for survival, name in ((0.5, "bundle"), (1.0, "bundle-2")):
        run.manifest().add("play", results={"survival": survival})
        run.manifest().add("export", results={"folder": f"exported/{name}"})
    (found,) = list_runs(tmp_path / "runs")
    assert (found.played, found.bundles) == ({"survival": 1.0}, ("exported/bundle", "exported/bundle-2"))


def test_listing_costs_by_the_number_of_runs_and_not_by_their_length(make_run, tmp_path):
    first = written(make_run(), 10, checkpoints=(0, 5, 9))
    first.manifest().finish("finished", {"iterations": 10})
    # The first call imports and compiles modules.
    _, one = (bytecodes(lambda: list_runs(tmp_path / "runs")) for _ in range(2))
    for number in range(49):
        shutil.copytree(first.path, first.path.parent / f"2026-01-01_00-00-00_{number}")
    assert len(list_runs(tmp_path / "runs")) == 50
    assert bytecodes(lambda: list_runs(tmp_path / "runs")) < 51 * one
    written(first, 30_000)  # The iteration log has about 4 MB.
    tracemalloc.start()
    summarize(first.path)
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert most < 1e6
    assert bytecodes(lambda: summarize(first.path)) < 1.1 * one


def test_sweeps_are_listed_with_their_jobs(tmp_path, dead_pid):
    jobs = [(["task=stand", f"seed={seed}"], [f"seed={seed}"]) for seed in (1, 2)]
    index = SweepIndex.create(tmp_path, command=[], launcher={"name": "basic", "at_once": 1}, jobs=jobs, now=START)
    index.update(1, status="running")
    broken = SweepIndex.create(
        tmp_path, command=[], launcher={"name": "basic", "at_once": 1}, jobs=jobs, now=START + timedelta(hours=1)
    )
    broken.path.write_text("{")
    first, second = list_sweeps(tmp_path)
    assert (first.status, second.status) == ("damaged", "running")
    assert (second.jobs, second.swept) == ({"running": 1, "waiting": 1}, ("seed",))
    index.data["process"]["pid"] = dead_pid
    index.finish("finished")
    assert list_sweeps(tmp_path)[1].status == "finished"
    index.data["status"] = "running"
    index.write()
    assert list_sweeps(tmp_path)[1].status == "crashed"


def test_a_zombie_is_not_alive():
    process = subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE)
    recorded = {k: v for k, v in this_process().items() if k != "start_ticks"}
    recorded["pid"] = process.pid
    assert is_alive(recorded) is True
    process.stdin.close()
    assert wait_until(lambda: not is_alive(recorded))  # The process has ended, but nobody has waited for it.
    process.wait()
