"""Sweeps whose jobs a queue runs: what passes by files, and what the index says whatever becomes of the jobs."""

from __future__ import annotations

import json
import os
import signal
import sys
import threading
import time
from pathlib import Path
from typing import Any

import pytest
from forks import forking
from patience import wait_until

from jobs.small import SMALL, lines, manifest, only_run, succeed, trained_once, wheelleg
from jobs.sweeps import STAND_IN, Seen
from jobs.test_sweep import _index as index
from wheelleg_exp.config.composing.compose import compose
from wheelleg_exp.config.composing.compose_sweep import compose_sweep, digest_of
from wheelleg_exp.errors import ConfigError
from wheelleg_exp.jobs import run_sweep
from wheelleg_exp.jobs.run_sweep import Queue, QueueWorker, SweepRunner, make_launcher
from wheelleg_exp.jobs.training_job import JobRequest
from wheelleg_exp.run.environment import variables
from wheelleg_exp.run.manifest import Manifest
from wheelleg_exp.run.run_index import SweepIndex
from wheelleg_exp.stop_request import StopRequest


class Ticket:
    """A thread that runs a queued job, or a job that never starts."""

    def __init__(self, folder: str, begins: bool) -> None:
        self.thread = threading.Thread(target=QueueWorker(), args=(folder,), daemon=True)
        self.cancelled = False
        if begins:
            self.thread.start()

    def gone(self) -> bool:
        return self.cancelled or (self.thread.ident is not None and not self.thread.is_alive())

    def cancel(self) -> None:
        self.cancelled = True

    def why(self) -> str:
        return "was ended from outside, as the test's job"


class Threads(Queue):
    """A queue of threads; the jobs from number ``full`` on never start."""

    def __init__(self, folder: Path, full: int = 99) -> None:
        super().__init__(folder)
        self.full = full
        self.handed_in: list[int] = []

    def submit(self, jobs):
        self.handed_in.append(len(jobs))
        return [Ticket(str(job.folder), number < self.full) for number, job in enumerate(jobs)]


@pytest.fixture(autouse=True)
def _stand_in(monkeypatch, request):
    if not request.node.get_closest_marker("train"):
        monkeypatch.setattr(run_sweep, "job_program", lambda path: (sys.executable, "-S", "-c", STAND_IN))


def swept(whats: list[str], stop: StopRequest, seen: Seen | None = None, full: int = 99) -> tuple[SweepRunner, Threads]:
    jobs = [([what], [what]) for what in whats]
    index = SweepIndex.create("runs", command=["wheelleg"], launcher={"name": "threads"}, jobs=jobs)
    requests = [JobRequest("train", [what], [], ["wheelleg", "train", what]) for what in whats]
    queue = Threads(index.folder, full)
    return SweepRunner(index, requests, len(whats), seen or Seen(), stop, queue), queue


def test_all_jobs_are_handed_in_together_and_heard(stop):
    seen = Seen()
    runner, queue = swept(["finish1", "finish2", "talk"], stop, seen)
    assert (runner.run(), queue.handed_in) == ("finished", [3])
    assert ("iteration", 1, 1, 1) in seen.told
    assert [job["run"] for job in index()["jobs"]] == [f"../../stand/{what}" for what in ("finish1", "finish2", "talk")]
    assert sum(told[0] == "note" and told[1] == 3 for told in seen.told) == 22000


def test_jobs_that_fail_or_die_are_named_and_stop_no_other(stop):
    runner, _ = swept(["fail", "killed", "die", "finish"], stop)
    assert runner.run() == "failed"
    jobs = index()["jobs"]
    assert [job["status"] for job in jobs] == ["failed", "failed", "failed", "finished"]
    assert jobs[0]["error"]["message"] == "gone to NaN"
    assert "was ended by SIGKILL" in jobs[1]["error"]["message"]
    assert "ended with status 7 and did not say why: the last words" in jobs[2]["error"]["message"]


def test_a_stop_ends_running_jobs_and_removes_waiting_jobs_from_the_queue(stop):
    moments = []

    def interrupt(job):
        moments.append([each["status"] for each in index()["jobs"]])
        os.kill(os.getpid(), signal.SIGINT)

    seen = Seen(on_start=interrupt)
    runner, _ = swept(["wait", "finish"], stop, seen, full=1)
    assert (runner.run(), [job["status"] for job in index()["jobs"]]) == ("interrupted", ["interrupted", "waiting"])
    assert moments == [["running", "waiting"]]
    assert [told for told in seen.told if told[0] == "ended"] == [("ended", 1, "interrupted")]


def test_jobs_that_a_queue_refuses_are_not_waited_for(stop, monkeypatch):
    def refuse(jobs):
        raise ConfigError("the queue did not take the jobs", key="hydra.launcher")

    runner, queue = swept(["finish1", "finish2"], stop)
    monkeypatch.setattr(queue, "submit", refuse)
    with pytest.raises(ConfigError, match="did not take the jobs"):
        runner.run()
    assert index()["status"] == "failed"
    assert [job["status"] for job in index()["jobs"]] == ["failed", "failed"]


@pytest.mark.parametrize("asked", [False, True])
def test_time_that_is_over_stops_the_job_and_hands_it_in_again_unless_the_sweep_was_stopped(tmp_path, asked):
    again = preempt(JobRequest("train", ["wait"], [], []), tmp_path, "run", run_sweep.SOON if asked else "")
    assert kinds(tmp_path) == ["began", "run", "ended" if asked else "preempted"]
    assert again is None if asked else again.args == (str(tmp_path),)


def kinds(folder: Path) -> list[str]:
    """Return the kinds of the events of a job."""
    events = folder / run_sweep.EVENTS
    return [json.loads(line)["event"] for line in events.read_text().splitlines()] if events.exists() else []


def preempt(request: JobRequest, folder: Path, event: str, stop: str = "") -> Any:
    """Run a job, preempt the job after its first event of a kind, and return what the queue runs again."""
    facts = {"line": request.line().decode().strip(), "path": sys.path, "working_directory": str(Path.cwd())}
    (folder / run_sweep.REQUEST).write_text(json.dumps({**facts, "variables": variables()}))
    job, before = QueueWorker(), kinds(folder).count(event)
    thread = threading.Thread(target=job, args=(str(folder),), daemon=True)
    thread.start()
    wait_until(lambda: kinds(folder).count(event) > before or not thread.is_alive())
    if stop:
        (folder / run_sweep.STOP).write_text(stop)
    again = job.checkpoint(str(folder))
    thread.join()
    return again


@pytest.mark.train
def test_a_preempted_job_resumes_as_if_it_had_not_been_preempted(tmp_path):
    words = [*SMALL, "agent.max_iterations=1000000", "agent.save_interval=1000000"]
    request = JobRequest("train", words, [], ["wheelleg", "train", *words], digest_of(compose(words)))
    with forking():
        for _ in range(2):
            assert preempt(request, tmp_path, "iteration")
    run = only_run(Path("runs"))
    assert len(manifest(run)["resumes"]) == 1
    done = len(lines(run))
    succeed("train", *words, f"agent.max_iterations={done}", "run.root=alone")
    require_equal(run, only_run(Path("alone")), f"model_{done - 1}.pt")


def _preempt(count: int, pids: set[int]) -> None:
    """Send submitit's signal to ``count`` processes of the only job of a sweep, each after a training iteration."""
    while len(pids) < count:
        time.sleep(0.05)
        for file in Path("runs/sweeps").glob("*/jobs/1/events.jsonl"):
            began = file.read_text().rpartition('{"event": "began"')[2].splitlines()
            pid = json.loads('{"event": "began"' + began[0])["pid"] if began else 0
            if pid not in pids and any('"event": "iteration"' in line for line in began):
                pids.add(pid)
                os.kill(pid, signal.SIGUSR2)


@pytest.mark.train
@pytest.mark.full  # The test above preempts a job twice, without submitit.
@pytest.mark.filterwarnings("ignore")
def test_a_job_that_submitit_preempts_often_ends_as_the_uninterrupted_run():
    count = 20
    pytest.importorskip("submitit")
    words, pids = [*SMALL, f"agent.max_iterations={10 * count}", "agent.save_interval=1000"], set[int]()
    succeed("train", *words, "run.root=alone")
    threading.Thread(target=_preempt, args=(count, pids), daemon=True).start()
    settings = ["hydra/launcher=submitit_local", "hydra.launcher.timeout_min=60"]
    said = wheelleg("train", "-m", *words, *settings)
    while said.status and len(pids) < count:  # The local executor runs a job at most six times.
        said = wheelleg("resume", "--sweep", "latest")
    assert (said.status, len(pids)) == (0, count), said.out + said.err
    run = only_run(Path("runs"))
    require_equal(run, only_run(Path("alone")), f"model_{10 * count - 1}.pt", "exported/policy.onnx")
    assert len(manifest(run)["resumes"]) == count


def require_equal(run: Path, alone: Path, *names: str) -> None:
    """Compare a run of a queue with one in the test's process, also the variables that change numbers."""
    for name in ("params/env.yaml", *names):
        assert (run / name).read_bytes() == (alone / name).read_bytes(), name
    ours, theirs = (Manifest.load(path).data["environment_variables"] for path in (run, alone))
    numeric = ("MKL_CBWR", "OMP_WAIT_POLICY", "OMP_NUM_THREADS")
    assert {name: ours.get(name) for name in numeric} == {name: theirs.get(name) for name in numeric}


def test_variables_of_numbers_are_those_of_the_sweeps_machine(tmp_path, monkeypatch):
    made = []
    monkeypatch.setattr(run_sweep, "Child", lambda program, line, environ, folder: made.append(environ) or 1 / 0)
    monkeypatch.setenv("OMP_NUM_THREADS", "7")  # Ray sets this variable in its workers.
    monkeypatch.setenv("MKL_CBWR", "COMPATIBLE")
    line = JobRequest("train", [], [], []).line().decode()
    facts = {"line": line, "path": [], "working_directory": ".", "variables": {"MKL_CBWR": "AVX2,STRICT"}}
    (tmp_path / run_sweep.REQUEST).write_text(json.dumps(facts))
    with pytest.raises(ZeroDivisionError):
        QueueWorker()(str(tmp_path))
    assert made[0]["MKL_CBWR"] == "AVX2,STRICT"
    assert "OMP_NUM_THREADS" not in made[0]


@pytest.mark.parametrize(
    ("launcher", "module", "extra"), [("ray", "ray", "ray"), ("submitit_slurm", "submitit", "slurm")]
)
def test_a_missing_launcher_is_reported_with_its_package(monkeypatch, launcher, module, extra):
    from wheelleg_exp.config.composing import compose_sweep as launchers

    monkeypatch.setattr(launchers, "_is_installed", lambda name: name != module)
    with pytest.raises(ConfigError, match=rf"'{launcher}' is not installed.*wheelleg_exp\[{extra}\]"):
        compose_sweep(["seed=1,2", f"hydra/launcher={launcher}"])


def test_the_settings_of_a_queue_are_those_of_hydra():
    pytest.importorskip("submitit")
    words = ["hydra/launcher=submitit_slurm", "hydra.launcher.partition=gpu", "hydra.launcher.timeout_min=30"]
    sweep = compose_sweep(["seed=1,2,3", *words])
    assert (sweep.launcher, sweep.n_jobs) == ("submitit_slurm", 3)
    settings = sweep.settings(Path("/sweep"))
    assert (settings["partition"], settings["timeout_min"], settings["name"]) == ("gpu", 30, "wheelleg")
    assert settings["submitit_folder"] == "/sweep/.submitit/%j"
    assert all("hydra" not in word for job in sweep.jobs for word in job.overrides)
    with pytest.raises(ConfigError, match=r"hydra\.launcher\.partitoin"):
        compose_sweep(["seed=1,2", words[0], "hydra.launcher.partitoin=gpu"])


def test_errors_of_submitit_are_reported(tmp_path):
    pytest.importorskip("submitit")
    with pytest.raises(ConfigError, match=r"hydra\.launcher: submitit refuses it"):
        make_launcher("submitit_slurm", {"submitit_folder": str(tmp_path / "s"), "partition": "gpu"}, tmp_path)


@pytest.fixture(params=["submitit_local", "ray"])
def launcher(request, tmp_path):
    if request.param == "ray":
        ray = pytest.importorskip("ray", reason="ray is not installed (pip install 'wheelleg_exp[ray]')")
        yield "ray", {"ray": {"init": {"address": "local", "num_cpus": 2}, "remote": {}}}
        ray.shutdown()
        return
    pytest.importorskip("submitit")
    yield request.param, {"submitit_folder": str(tmp_path / "log" / "%j"), "timeout_min": 10}


@pytest.mark.train
@pytest.mark.filterwarnings("ignore")
def test_a_job_of_a_queue_is_the_run_alone_and_one_that_is_killed_is_named(launcher, stop, tmp_path, tmp_path_factory):
    jobs = [SMALL, [*SMALL, "agent.max_iterations=1000000", "agent.save_interval=1000000"]]
    index_ = SweepIndex.create("runs", command=["wheelleg"], launcher={"name": "x"}, jobs=[(w, []) for w in jobs])
    requests = [JobRequest("train", w, [], ["wheelleg", "train", *w], digest_of(compose(w))) for w in jobs]

    def kill(job):
        if job["number"] == 2:
            events = index_.folder / "jobs" / "2" / run_sweep.EVENTS
            os.kill(json.loads(events.read_text().splitlines()[0])["pid"], signal.SIGKILL)

    queue = make_launcher(*launcher, index_.folder)
    assert SweepRunner(index_, requests, 2, Seen(on_iteration=kill), stop, queue).run() == "failed"
    one, other = index()["jobs"]
    assert (one["status"], other["status"]) == ("finished", "failed")
    assert "was ended from outside" in other["error"]["message"]
    alone = trained_once(tmp_path_factory).run.path
    require_equal(index_.run_of(one), alone, "model_2.pt", "exported/policy.onnx")
