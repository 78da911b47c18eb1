"""Running a sweep: what its index says at every moment, and that its runs are those one would train alone."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import joblib  # noqa: F401 - importing joblib sets KMP_INIT_AT_FORK, which environment.txt contains
import pytest
from omegaconf import OmegaConf
from patience import PATIENCE_S, wait_until

from jobs.small import (
    ITERATIONS,
    SMALL,
    cache_of,
    lines,
    manifest,
    only_run,
    succeed,
    trained_once,
    wheelleg,
    without_times,
)
from jobs.sweeps import STAND_IN, Seen, stand_in, swept_once
from wheelleg_exp.child_process import EventPipe, run_job
from wheelleg_exp.config.composing.compose import compose
from wheelleg_exp.config.composing.compose_sweep import compose_sweep, digest_of
from wheelleg_exp.errors import ConfigError, RunDirectoryError, SimulationFailure
from wheelleg_exp.files import write_json
from wheelleg_exp.jobs import run_sweep as runner_module
from wheelleg_exp.jobs.training_job import JobRequest, serve
from wheelleg_exp.recording.reading.recording_digest import entity_digests
from wheelleg_exp.run import run_list
from wheelleg_exp.run.run_directory import RunDirectory
from wheelleg_exp.run.run_index import SweepIndex
from wheelleg_exp.run.run_list import list_runs
from wheelleg_exp.run.run_lock import RunLock
from wheelleg_exp.stop_request import StopRequest

GROWING = (".lock", ".manifest.lock", "manifest.json", "iterations.jsonl", "recording.rrd")  # they hold times


def _index() -> dict:
    (path,) = Path("runs/sweeps").glob("*/sweep.json")
    return json.loads(path.read_text())


def _statuses() -> list[str]:
    return [job["status"] for job in _index()["jobs"]]


@pytest.mark.parametrize("at_once", [1, 2, 3])
def test_as_many_jobs_run_at_once_as_are_asked_for(stop, at_once):
    seen = Seen()
    stand_in([f"finish{i}" for i in range(4)], stop, at_once, seen).run()
    assert (seen.most_at_once(), [told[1] for told in seen.told if told[0] == "started"]) == (at_once, [1, 2, 3, 4])


@pytest.mark.parametrize("at_once", [1, 4])
def test_jobs_that_fail_or_die_stop_no_other(stop, at_once):
    assert stand_in(["fail", "die", "killed", "finish"], stop, at_once).run() == "failed"
    assert (_index()["status"], _statuses()) == ("failed", ["failed", "failed", "failed", "finished"])
    *told, last = [job["error"] and job["error"]["message"] for job in _index()["jobs"]]
    died = "its process ended with status 7 and did not say why: the last words"
    assert (told, last) == (["gone to NaN", died, "its process was ended by SIGKILL (out of memory?)"], None)


def test_a_resume_that_fails_before_it_changes_the_run_is_reported(stop, monkeypatch):
    before = SimpleNamespace(status="interrupted", results={}, data={"error": None})
    monkeypatch.setattr(runner_module.Manifest, "load", lambda path: before)
    assert stand_in(["fail"], stop).run() == "failed"
    assert (_statuses(), _index()["jobs"][0]["error"]["message"]) == (["failed"], "gone to NaN")


def test_much_talk_blocks_nobody(stop):
    seen = Seen()
    assert stand_in(["talk", "talk"], stop, 2, seen).run() == "finished"
    notes = [told[2] for told in seen.told if told[0] == "note" and told[1] == 1]
    assert (notes.count("something"), notes.count("x" * 100)) == (20000, 2000)


def test_a_job_that_exits_without_a_final_status_has_failed(stop):
    assert (stand_in(["leave", "finish"], stop).run(), _statuses()) == ("failed", ["failed", "finished"])
    assert "ended with status 0 and did not say why" in _index()["jobs"][0]["error"]["message"]


def test_the_index_describes_each_job_while_it_runs(stop):
    moments, runs = [], []
    seen = Seen(on_start=lambda job: moments.append(_statuses()))
    seen.on_iteration = lambda job: runs.append(_index()["jobs"][job["number"] - 1]["run"])
    stand_in(["finish1", "fail", "finish3"], stop, seen=seen).run()
    first, second = ["running", "waiting", "waiting"], ["finished", "running", "waiting"]
    assert moments == [first, second, ["finished", "failed", "running"]]
    assert runs == ["../../stand/finish1", "../../stand/finish3"]


def test_an_index_that_cannot_be_written_ends_the_jobs(stop, monkeypatch):
    runner = stand_in(["wait", "finish"], stop, 2)

    update = runner._index.update

    def refuse(number, **changes):
        if "ended" in changes:
            raise RunDirectoryError("the disk is full")
        update(number, **changes)

    monkeypatch.setattr(runner._index, "update", refuse)
    with pytest.raises(SimulationFailure, match="disk is full"):
        runner.run()
    assert not runner._running


def test_a_stop_ends_every_job_and_starts_no_other(stop):
    seen = Seen(on_start=lambda job: job["number"] == 2 and os.kill(os.getpid(), signal.SIGINT))
    assert stand_in(["wait", "wait", "finish"], stop, 2, seen).run() == "interrupted"
    assert (_index()["status"], _statuses()) == ("interrupted", ["interrupted", "interrupted", "waiting"])


def _interrupt_twice(_job):
    for _ in range(2):
        os.kill(os.getpid(), signal.SIGINT)


def test_a_second_stop_interrupts_the_jobs_at_once(stop, monkeypatch):
    runner = stand_in(["deaf", "finish"], stop, seen=Seen(on_iteration=_interrupt_twice))
    monkeypatch.setattr(runner_module, "_KILL_S", PATIENCE_S)
    assert (runner.run(), _statuses()) == ("interrupted", ["interrupted", "waiting"])
    assert _index()["jobs"][0]["error"] is None


def test_a_job_that_will_not_stop_is_killed(stop, monkeypatch):
    monkeypatch.setattr(runner_module, "_KILL_S", 0.5)

    runner = stand_in(["stubborn"], stop, seen=Seen(on_iteration=_interrupt_twice))
    assert runner.run() == "interrupted"
    assert "SIGKILL" in _index()["jobs"][0]["error"]["message"]
    assert not runner._running


def test_jobs_stop_when_the_sweep_itself_is_killed():
    job = subprocess.Popen([sys.executable, "-c", STAND_IN], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    job.stdin.write(JobRequest("train", ["wait"], [], []).line())
    job.stdin.flush()
    out, _ = job.communicate(timeout=PATIENCE_S)
    assert json.loads(out.splitlines()[-1])["status"] == "interrupted"


def _request(*overrides: str, digest: str = "") -> JobRequest:
    return JobRequest("train", list(overrides), [], ["wheelleg", "train", *overrides], digest)


def _ended(request: JobRequest, stop: StopRequest) -> tuple[int, dict]:
    reader, writer = os.pipe()
    status = run_job(EventPipe(writer), lambda pipe: serve(pipe, request.line(), stop))
    os.close(writer)
    with os.fdopen(reader) as lines:
        return status, json.loads(lines.read().splitlines()[-1])


def test_a_job_that_is_stopped_early_or_has_a_mistake_leaves_no_run_and_gives_the_reason(stop):
    status, told = _ended(_request(*SMALL, digest="another"), stop)
    assert (status, told["status"]) == (2, "failed")
    assert "have changed since the sweep was checked" in told["error"]["message"]
    status, told = _ended(_request("env.num_envs=0"), stop)
    assert (status, told["error"]["type"]) == (2, ConfigError.__name__)
    assert told["error"]["message"].startswith("env.num_envs: 0 is out of range")
    stop.requested = True
    status, told = _ended(_request(*SMALL, digest=digest_of(compose(SMALL))), stop)
    assert (status, told["status"]) == (130, "interrupted")
    assert not Path("runs").exists()


@pytest.fixture(scope="session")
def swept(tmp_path_factory):
    return swept_once(tmp_path_factory)


@pytest.fixture(scope="session")
def alone(swept, tmp_path_factory):
    """Train the second run of the sweep again, with the command in its manifest."""
    run = swept.index.run_of(swept.index.jobs[1])
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(swept.folder.parent.parent.parent)
        patch.setenv("WHEELLEG_CACHE", str(cache_of(tmp_path_factory)))
        succeed(*manifest(run)["command"][1:])
    (path,) = [path for path in run.parent.iterdir() if path.name.endswith("_1_small") and path != run]
    return path


def _files(run: Path) -> dict[str, Path]:
    """Return the files that contain no times, without the source: others may work in the checkout meanwhile."""
    files = {path.relative_to(run).as_posix(): path for path in run.rglob("*") if path.is_file()}
    excluded = (*GROWING, "events.out.tfevents.", "source/")
    return {name: path for name, path in files.items() if not name.startswith(excluded)}


@pytest.mark.train
def test_a_warning_of_the_physics_check_is_shown_once_for_all_jobs_and_their_runs_are_listed(swept):
    assert " ".join(swept.said.err.split()).count("check.silence.episode_end silences it") == 1
    said = succeed("list", "runs", "--root", swept.root, "--json")
    listed = {row["path"]: (row["status"], row["task"]) for row in json.loads(said.out)}
    assert [listed[str(swept.index.run_of(job))] for job in swept.index.jobs] == [("finished", "stand")] * 2


@pytest.mark.train
def test_runs_trained_at_the_same_time_are_byte_for_byte_those_trained_alone(swept, alone):
    of_sweep = swept.index.run_of(swept.index.jobs[1])
    ours, theirs = _files(of_sweep), _files(alone)
    assert set(ours) == set(theirs)
    assert {"model_2.pt", "exported/policy.onnx", "params/env.yaml", ".hydra/hydra.yaml"} <= set(ours)
    different = [name for name in ours if ours[name].read_bytes() != theirs[name].read_bytes()]
    # TorchScript writes a module's constants in the order of a set, which differs between processes.
    assert ([name for name in different if name != "exported/policy.pt"], len(lines(alone))) == ([], ITERATIONS)
    assert [without_times(a) for a in lines(of_sweep)] == [without_times(b) for b in lines(alone)]
    recorded = [entity_digests(run / "recording.rrd") for run in (of_sweep, alone)]
    assert recorded[0].keys() == recorded[1].keys()
    assert [key for key in recorded[0] if recorded[0][key] != recorded[1][key] and "Perf/" not in key] == []
    ours, theirs = manifest(of_sweep), manifest(alone)
    assert ours.keys() == theirs.keys()
    same = ("task", "status", "error", "command", "working_directory", "seeds", "versions", "threads", "hardware")
    assert [key for key in (*same, "environment_variables") if ours[key] != theirs[key]] == []
    assert ours["threads"]["torch"] == 1


@pytest.mark.train
def test_every_job_trains_a_listed_run_with_its_seed_and_the_index_has_its_results(swept, tmp_path_factory):
    zero, one = (swept.index.run_of(job) for job in swept.index.jobs)
    trained = trained_once(tmp_path_factory).run.path  # of seed 0
    model = f"model_{ITERATIONS - 1}.pt"
    assert (zero / model).read_bytes() == (trained / model).read_bytes()
    assert (zero / model).read_bytes() != (one / model).read_bytes()
    for job in swept.index.jobs:
        results = RunDirectory.open(swept.index.run_of(job), swept.root).manifest().results
        assert (job["results"], results["iterations"]) == (results, ITERATIONS)
        assert (job["status"], job["error"]) == ("finished", None)
    first, other = swept.index.jobs  # Both jobs ran at the same time.
    assert max(first["started"], other["started"]) < min(first["ended"], other["ended"])
    listed = {run.path.resolve() for run in list_runs(swept.root)}
    assert {zero, one} <= listed
    assert {path.parent.name for path in listed} == {"stand"}
    assert RunDirectory.open("latest", swept.root).path in listed


@pytest.mark.train
@pytest.mark.full  # The stand-ins above show the same stop without trainings.
def test_an_interrupt_stops_the_sweep_and_leaves_the_trained_runs(tmp_path, tmp_path_factory):
    words = ["train", "-m", "seed=1,2", *SMALL, "agent.max_iterations=100000", "agent.save_interval=100000"]
    script = "import sys; from wheelleg_exp.cli.main import main; sys.exit(main(sys.argv[1:]))"
    program = [sys.executable, "-c", script, *words]
    job = subprocess.Popen(program, stdout=subprocess.PIPE, stderr=subprocess.PIPE, start_new_session=True)
    logs = "runs/stand/*/iterations.jsonl"

    def has_begun() -> bool:
        return any(path.read_text().count("\n") > 2 for path in tmp_path.glob(logs))

    assert wait_until(lambda: has_begun() or job.poll() is not None), "the training does not begin"
    os.killpg(job.pid, signal.SIGINT)  # as a terminal does
    out, err = job.communicate(timeout=PATIENCE_S)
    assert job.returncode == 130, err.decode()
    assert (_index()["status"], _statuses()) == ("interrupted", ["interrupted", "waiting"])
    run = only_run(tmp_path / "runs")
    directory = RunDirectory.open(run, tmp_path / "runs")
    assert directory.manifest().status == "interrupted"
    assert directory.latest_checkpoint().name == f"model_{len(lines(run)) - 1}.pt"
    assert b"0 of 2 jobs finished" in out


def test_only_one_process_runs_a_sweep_and_a_job_that_may_still_be_queued_is_not_run_twice(monkeypatch, tmp_path):
    facts = {"name": "submitit_slurm", "at_once": 1}  # This machine has no Slurm, and without jobs none is needed.
    index = SweepIndex.create("runs", command=[], launcher=facts, jobs=[([], [])])
    write_json(index.folder / "multirun.yaml", {"hydra": {"launcher": {}, "sweep": {}, "job": {}}})
    again = ["resume", "--sweep", "latest"]

    def refused(why: str, *words: str) -> bool:
        said = wheelleg(*again, *words)
        return said.status == 2 and why in said.err

    assert refused("this sweep is still running")
    index.data["process"] = None
    index.write()
    assert refused("accepts no overrides", "agent.max_iterations=9")
    write_json(index.folder / "jobs" / "1" / "request.json", {})
    assert refused("job 1 may still be in the queue")
    early = SweepIndex.load(index.folder)
    index.update(1, status="finished")
    with RunLock(index.folder):
        assert refused("is being written by process")
    monkeypatch.setattr(run_list, "open_sweep", lambda name, root: early)  # Another resume has ended in between.
    assert (wheelleg(*again).status, _index()["status"]) == (0, "finished")


@pytest.mark.parametrize(
    "text",
    [
        "[",
        "",
        "hydra: 3",
        "hydra: {launcher: 3, sweep: {}, job: {}}",
        "hydra: {sweep: {}, job: {}, launcher: {a: '${b}'}}",
        "hydra: {launcher: {a: 2020-01-01}}",
        "hydra: {launcher: {a: '${'}}",
        "hydra: {launcher: {a: '${oc.env:HOME}'}}",
        "hydra: {launcher: {a: '${ oc.env:HOME}'}}",
        r"hydra: {launcher: {a: '\${oc.env:HOME}'}}",
        "hydra: {launcher: {b: oc, a: '${${hydra.launcher.b}.env:HOME}'}}",
    ],
)
def test_a_damaged_config_of_a_sweep_is_one_message(tmp_path, text):
    index = SweepIndex.create("runs", command=[], launcher={"name": "basic", "at_once": 1}, jobs=[])
    index.finish("interrupted")
    (index.folder / "multirun.yaml").write_text(text)
    said = wheelleg("resume", "--sweep", "latest")
    assert (said.status, said.err.count("\n"), "multirun.yaml" in said.err) == (2, 1, True), said.err


@pytest.mark.train
@pytest.mark.usefixtures("forks")
def test_a_resumed_sweep_resumes_unfinished_runs_and_leaves_finished_ones(run, tmp_path):
    half = shutil.copytree(run.path, run.path.with_name(f"{run.id}-2"))
    (half / "model_2.pt").unlink()
    (half / "manifest.json").write_text(json.dumps({**manifest(half), "status": "interrupted"}))
    facts = {"name": "basic", "at_once": 1}
    index = SweepIndex.create(tmp_path / "runs", command=[], launcher=facts, jobs=[([], []), ([], [])])
    (index.folder / "multirun.yaml").write_text(OmegaConf.to_yaml(compose_sweep(["seed=1,2"]).multirun))
    index.update(1, status="running", run=index.relative(run.path))  # The process of the sweep was killed.
    index.data["process"] = None
    index.update(2, status="interrupted", run=index.relative(half))
    said = succeed("resume", "--sweep", "latest")
    assert "jobs to resume: 1 of 2" in said.err
    assert [job["status"] for job in SweepIndex.load(index.folder).jobs] == ["finished", "finished"]
    assert (half / "model_2.pt").read_bytes() == (run.path / "model_2.pt").read_bytes()
