"""Run each job of a sweep in its own process, on this machine or through the queue of Slurm or Ray.

A sweep and its queued jobs exchange files on a shared file system: ``request.json`` in a job's folder describes the
job, ``events.jsonl`` has its events, and ``stop`` asks it to stop. submitit (for Slurm) and Ray are optional.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import socket
import sys
import time
from collections import deque
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Protocol, cast

from wheelleg_exp.child_process import Child, Event, listen, parse_event
from wheelleg_exp.config.tree_lookup import section_at
from wheelleg_exp.errors import ConfigError, RunDirectoryError, WheellegError
from wheelleg_exp.files import read_yaml, require_mapping, while_running, write_json, write_text
from wheelleg_exp.jobs.training_job import JobRequest, job_program, resume_request, train_request
from wheelleg_exp.machine import share_cores
from wheelleg_exp.run.environment import replay_environ, variables
from wheelleg_exp.run.file_inventory import MANIFEST_NAME
from wheelleg_exp.run.manifest import Manifest
from wheelleg_exp.run.run_config import require_overrides, resolved
from wheelleg_exp.run.run_index import MULTIRUN_NAME, JobEntry, JobStatus, SweepIndex, SweepStatus
from wheelleg_exp.run.timestamps import utc_now, utc_text
from wheelleg_exp.stop_request import StopRequest

if TYPE_CHECKING:
    import submitit
    from submitit.helpers import DelayedSubmission

    from wheelleg_exp.config.composing.compose_sweep import Sweep

_LISTEN_S, _KILL_S = 0.2, 10.0


REQUEST, EVENTS, STOP = "request.json", "events.jsonl", "stop"
SOON, NOW = "soon", "now"  # the content of STOP
JOBS = "jobs"
_WAIT_S = 0.3
_PATIENCE_S = 90.0  # Wait less than the 120 s after which Slurm kills a job that was asked to stop.
# Save the import path of this process before submitit or Ray changes ``sys.path``.
_PATH = tuple(entry for entry in sys.path if Path(entry).exists())


class QueueWorker:
    """Runs a sweep job on a machine of a cluster. A new ``QueueWorker`` can be pickled, because it has no attributes.

    Environment variables that can change results come from the machine that started the sweep.
    """

    _child: Child | None = None
    _relayed: Future[str] | None = None
    _preempted = False

    def __call__(self, folder: str) -> str:
        """Run the job that the file ``request.json`` in ``folder`` describes, and return the job's status.

        If the queue runs the job again, resume the job's run from its last checkpoint.
        """
        place = Path(folder)
        request = json.loads((place / REQUEST).read_text(encoding="utf-8"))
        order = JobRequest(**json.loads(request["line"]))
        if (event := last_event(place, "run")) is not None:
            order = resume_request(Path(event["path"]), order.config_dirs)
        self._write(place, {"event": "began", "host": socket.gethostname(), "pid": os.getpid()})
        same = all(Path(entry).exists() for entry in request["path"])
        path = request["path"] if same else sys.path  # The submitting machine may import from other folders.
        here = Path(request["working_directory"])
        self._child = Child(job_program(path), order.line(), replay_environ(request["variables"]), here)
        with ThreadPoolExecutor(1) as reader:  # Signals interrupt the main thread, so a second thread reads events.
            self._relayed = reader.submit(self._relay, self._child, place)
            return self._relayed.result()

    def checkpoint(self, folder: str) -> DelayedSubmission | None:
        """Stop the job after a checkpoint, and return what the queue must run again, or None.

        submitit calls this method at a preemption and at the time limit of the job.
        """
        from submitit.helpers import DelayedSubmission

        self._preempted = True
        if self._child is not None and self._relayed is not None:
            self._child.ask_to_stop()
            if not wait([self._relayed], _PATIENCE_S).done:
                self._child.kill()
            if self._relayed.result() != "interrupted":
                return None
        return None if (Path(folder) / STOP).exists() else DelayedSubmission(QueueWorker(), folder)

    def _relay(self, child: Child, place: Path) -> str:
        """Copy the events of the job's process to ``events.jsonl``, and pass stop requests to the process."""
        asked = ""
        while not child.over():
            self._write_events(child, place, _WAIT_S)
            wanted = asked
            with suppress(OSError):
                wanted = (place / STOP).read_text(encoding="utf-8")
            if wanted != asked:
                child.ask_to_stop() if wanted == SOON else child.interrupt()
                asked = wanted
        self._write_events(child, place, 0.0)
        message = f"its process on {socket.gethostname()} {child.describe_death()}"
        ended = child.ended or {"event": "ended", "status": "failed", "error": {"type": "error", "message": message}}
        child.close()
        again = self._preempted and not (place / STOP).exists()
        if again and (child.ended is None or ended["status"] == "interrupted"):
            ended = {"event": "preempted", "status": "interrupted"}
        self._write(place, ended)
        return str(ended["status"])

    def _write_events(self, child: Child, place: Path, wait_s: float) -> None:
        for _, event in listen([child], wait_s):
            self._write(place, event)

    def _write(self, place: Path, event: Mapping[str, object]) -> None:
        with (place / EVENTS).open("a", encoding="utf-8") as file:
            file.write(json.dumps(event) + "\n")


def last_event(folder: Path, kind: str) -> Event | None:
    """Return the last event of a kind, such as ``run`` or ``ended``, that a queued job wrote; None without one."""
    found: list[Event | None] = []
    with suppress(OSError):
        found = [parse_event(line) for line in (folder / EVENTS).read_text(errors="replace").splitlines()]
    return next((event for event in reversed(found) if event and event["event"] == kind), None)


class QueuedJob:
    """A job in a queue, whose ``QueueWorker`` writes the file that ``events`` reads; ``ended`` is its last event."""

    def __init__(self, folder: Path, request: JobRequest) -> None:
        self.folder = folder.absolute()
        self.ticket: _SubmititTicket | _RayTicket | None = None
        self.ended: Event | None = None
        self._read, self._began, self._stopped = 0, False, False
        path = [str(Path(entry).absolute()) for entry in _PATH]
        facts = {"line": request.line().decode().rstrip("\n"), "path": path, "working_directory": str(Path.cwd())}
        for name in (EVENTS, STOP):  # An earlier process of a resumed sweep has written these files.
            (self.folder / name).unlink(missing_ok=True)
        write_json(self.folder / REQUEST, {**facts, "variables": variables()})

    def events(self) -> Iterator[Event]:
        """Yield the events that the job has written since the last call."""
        try:
            with (self.folder / EVENTS).open("rb") as file:
                file.seek(self._read)
                found = file.read()
        except OSError:
            return
        whole = found[: found.rfind(b"\n") + 1]
        self._read += len(whole)
        for line in whole.splitlines():
            event = parse_event(line.decode(errors="replace"))
            if event is None:
                continue
            if event["event"] == "ended":
                self.ended = event
                continue
            self._began = event["event"] != "preempted" and (self._began or event["event"] == "began")
            yield event

    def over(self) -> bool:
        """Return whether the job has ended, left the queue, or was stopped before its submission."""
        return self._stopped if self.ticket is None else self.ended is not None or self.ticket.gone()

    def ask_to_stop(self) -> None:
        """Ask a running job to stop after its current training iteration; remove a waiting job from the queue."""
        if self._stopped:
            return
        self._stopped = True
        write_text(self.folder / STOP, SOON)
        if not self._began:
            self.kill()

    def interrupt(self) -> None:
        """Stop the job without waiting for the end of its training iteration."""
        write_text(self.folder / STOP, NOW)

    def kill(self) -> None:
        """Remove the job from the queue at once."""
        if self.ticket is not None:
            self.ticket.cancel()

    def close(self) -> None:
        """Leave the job's files in place, so that users can read the job's file ``events.jsonl`` later."""

    def describe_death(self) -> str:
        """Return the reason that the queue gives for the end of the job."""
        return "was never submitted" if self.ticket is None else self.ticket.why()


Job = Child | QueuedJob


class LocalLauncher:
    """Runs sweep jobs as child processes on this machine. If this process is killed, its child processes stop."""

    queued = False  # True for a launcher whose jobs wait in a queue, and send the event ``began`` when they start.

    def __init__(self, program: Sequence[str] | None = None) -> None:
        self._program = program or job_program()

    def start(self, number: int, request: JobRequest) -> Job:
        """Start the child process that runs a job."""
        del number
        # Pass ``os.environ``, because C libraries may have changed the environment variables of this process.
        return Child(self._program, request.line(), os.environ)

    def listen(self, jobs: Collection[Job], wait_s: float) -> Iterator[tuple[Job, Event]]:
        """Yield the events that the jobs have sent; wait at most ``wait_s`` seconds for the first event."""
        return listen(cast(Collection[Child], jobs), wait_s)


class Queue:
    """The base class of the launchers that submit jobs to a queue."""

    queued = True

    def __init__(self, folder: Path) -> None:
        self._folder = folder / JOBS
        self._pending: list[QueuedJob] = []

    def start(self, number: int, request: JobRequest) -> Job:
        """Write the file ``request.json`` of a job; the method ``listen`` submits all prepared jobs together."""
        job = QueuedJob(self._folder / str(number), request)
        self._pending.append(job)
        return job

    def submit(self, jobs: Collection[QueuedJob]) -> Sequence[_SubmititTicket | _RayTicket]:
        """Submit jobs to the queue, and return one ticket per job."""
        raise NotImplementedError

    def listen(self, jobs: Collection[Job], wait_s: float) -> Iterator[tuple[Job, Event]]:
        """Submit all prepared jobs to the queue, and yield the events that the jobs have written."""
        waiting, self._pending = [job for job in self._pending if not job.over()], []
        if waiting:
            for job, ticket in zip(waiting, self.submit(waiting), strict=True):
                job.ticket = ticket
        until = time.monotonic() + wait_s
        while not (found := [(job, event) for job in jobs for event in cast(QueuedJob, job).events()]):
            if time.monotonic() >= until or any(job.over() for job in jobs):
                return
            time.sleep(min(wait_s, 0.1))
        yield from found


# All executors of submitit accept ``_SHARED_SETTINGS``, so these settings have no prefix such as ``slurm_``.
_SHARED_SETTINGS = (
    *("timeout_min", "cpus_per_task", "gpus_per_node", "tasks_per_node"),
    *("mem_gb", "nodes", "name", "stderr_to_stdout"),
)
_EXECUTOR_SETTINGS = ("max_num_timeout",)
_REFUSED = ("python", "additional_parameters", "runtime_env", "address")  # They select a program or a Ray cluster.
_OTHER_SETTINGS = ("_target_", "submitit_folder", *_EXECUTOR_SETTINGS)


class SubmititLauncher(Queue):
    """Submits the jobs of a sweep as one array through submitit (``slurm`` or ``local``), as its Hydra plugin does."""

    def __init__(self, cluster: str, settings: Mapping[str, object], folder: Path) -> None:
        import submitit

        super().__init__(folder)
        self._errors = (submitit.core.utils.FailedJobError, OSError)
        own = {f"{cluster}_{key}": settings[key] for key in _EXECUTOR_SETTINGS if key in settings}
        try:
            self._executor = submitit.AutoExecutor(folder=str(settings["submitit_folder"]), cluster=cluster, **own)
            keys = {key: key if key in _SHARED_SETTINGS else f"{cluster}_{key}" for key in settings}
            chosen = {keys[key]: value for key, value in settings.items() if key not in _OTHER_SETTINGS}
            self._executor.update_parameters(**chosen)
        except (RuntimeError, TypeError, ValueError, NameError, AssertionError) as error:
            message = f"submitit refuses it: {_one_line(error)[:300]}"
            expected = "settings of hydra-submitit-launcher, on a machine that has what they ask for"
            raise ConfigError(message, key="hydra.launcher", expected=expected) from error

    def submit(self, jobs: Collection[QueuedJob]) -> Sequence[_SubmititTicket | _RayTicket]:
        """Submit all given jobs as one Slurm job array."""
        try:
            with self._executor.batch():
                found = [self._executor.submit(QueueWorker(), str(job.folder)) for job in jobs]
        except self._errors as error:
            message = f"the queue did not take the jobs: {_one_line(error)[-300:]}"
            expected = "a partition, times and memory that the cluster has"
            raise ConfigError(message, key="hydra.launcher", expected=expected) from error
        return [_SubmititTicket(each) for each in found]


class _SubmititTicket:
    """A job in a queue: whether it has left the queue, how to remove or end it, and why it died without an event."""

    def __init__(self, job: submitit.Job[str]) -> None:
        self._job = job

    def gone(self) -> bool:
        return bool(self._job.done())

    def cancel(self) -> None:
        self._job.cancel(check=False)

    def why(self) -> str:
        words = [line.strip() for line in (self._job.stderr() or "").splitlines() if line.strip()]
        last = f": {words[-1][:300]}" if words else ""
        # submitit's local executor reports the state FINISHED even for failed jobs, so this state is not shown.
        state = "" if self._job.state == "FINISHED" else f" ({self._job.state})"
        return f"was ended from outside, as submitit's job {self._job.job_id}{state}{last}"


_OBJECT_STORE = 78_643_200  # ``_OBJECT_STORE`` is the smallest object store that Ray allows, bytes.
_INIT = {"include_dashboard": False, "log_to_driver": False, "logging_level": "error"}


class RayLauncher(Queue):
    """Submits each sweep job as a Ray task, with the settings ``ray.init`` and ``ray.remote`` of hydra-ray-launcher."""

    def __init__(self, settings: Mapping[str, object], folder: Path) -> None:
        import ray

        super().__init__(folder)
        init = {**_INIT, **section_at(settings, "ray.init")}
        if init.get("address") is None and "RAY_ADDRESS" not in os.environ:
            init.setdefault("object_store_memory", _OBJECT_STORE)  # Ray starts a new cluster if no address is given.
        try:
            if not ray.is_initialized():
                ray.init(**init)
            # Ray must not restart a job whose process died.
            options = {"max_retries": 0, **section_at(settings, "ray.remote")}
            self._task = ray.remote(**options)(_run_queue_worker)
        except (ConnectionError, RuntimeError, TypeError, ValueError) as error:
            message = f"Ray refuses it: {_one_line(error)[:300]}"
            expected = "init: what ray.init takes, such as address; remote: what ray.remote takes, such as num_cpus"
            raise ConfigError(message, key="hydra.launcher.ray", expected=expected) from error

    def submit(self, jobs: Collection[QueuedJob]) -> Sequence[_SubmititTicket | _RayTicket]:
        """Submit each given job as one Ray task."""
        return [_RayTicket(self._task.remote(str(job.folder))) for job in jobs]


def _run_queue_worker(folder: str) -> str:
    return QueueWorker()(folder)


class _RayTicket:
    def __init__(self, reference: object) -> None:
        import ray

        self._ray, self._reference = ray, reference

    def gone(self) -> bool:
        done, _ = self._ray.wait([self._reference], timeout=0)
        return bool(done)

    def cancel(self) -> None:
        self._ray.cancel(self._reference, force=True)

    def why(self) -> str:
        try:
            self._ray.get(self._reference, timeout=1)
        except self._ray.exceptions.RayError as error:
            line = next((line for line in str(error).splitlines() if line.strip()), type(error).__name__)
            return f"was ended from outside on Ray: {line.strip()[:300]}"
        return "ended on Ray and did not say why"


def _one_line(error: BaseException) -> str:
    return " ".join(str(error).split())


def make_launcher(name: str, settings: Mapping[str, object], folder: Path) -> LocalLauncher | Queue:
    """Return the launcher for a config name of Hydra's group ``hydra/launcher``, such as ``submitit_slurm``."""
    if name.startswith("submitit"):
        return SubmititLauncher(name.removeprefix("submitit_"), settings, folder)
    return RayLauncher(settings, folder) if name == "ray" else LocalLauncher()


def require_harmless(settings: Mapping[str, object], path: Path) -> None:
    """Raise RunDirectoryError for a launcher setting from the file ``path`` that could run a foreign program."""
    for key, value in settings.items():
        text = str(value).removeprefix(f"{path.parent}/.submitit/")
        if isinstance(value, Mapping) and key not in _REFUSED:
            require_harmless(value, path)
        elif value and (key in _REFUSED or isinstance(value, list) or not re.fullmatch(r"[^/\n]*", text)):
            expected = "numbers and names: remove the setting, or resume each run of the sweep with 'wheelleg resume'"
            raise RunDirectoryError(f"a resume does not trust the setting '{key}'", where=str(path), expected=expected)


def recorded_sweep(index: SweepIndex) -> Sweep:
    """Return the launcher of a sweep from its file ``multirun.yaml``.

    No setting can run a program or read a variable of the user's environment.
    """
    from omegaconf import DictConfig

    from wheelleg_exp.config.composing.compose_sweep import Sweep

    path, launcher = index.folder / MULTIRUN_NAME, index.data["launcher"]
    hydra = require_mapping(read_yaml(path), path).get("hydra")
    message, expected = (
        "the file contains no settings of a launcher",
        "the file that the sweep wrote, without ${oc.env:…}",
    )
    problem = RunDirectoryError(message, where=str(path), expected=expected)
    if not isinstance(hydra, Mapping):
        raise problem
    tree = {"launcher": hydra.get("launcher"), "sweep": {"dir": str(index.folder)}, "job": {"name": "wheelleg"}}
    nothing: dict[str, str] = {}
    try:
        found = cast(Mapping[str, object], resolved({"hydra": tree}, nothing, nothing.__getitem__)["hydra"])
    except RunDirectoryError as error:
        raise problem from error
    settings = found["launcher"]
    if not isinstance(settings, Mapping) or "${" in str(settings):  # An escaped ``${`` would be resolved next time.
        raise problem
    require_harmless(settings, path)
    multirun = DictConfig({"hydra": {"launcher": settings, "sweep": {}, "job": {}}})
    return Sweep((), launcher["name"], launcher["at_once"], multirun)


def remaining_requests(index: SweepIndex, config_dirs: Sequence[Path]) -> list[JobRequest]:
    """Return the requests that resume the unfinished runs of a sweep, and train its jobs that have no run.

    A job can have started or finished after the process of the sweep ended: record its run and results in ``index``.
    """
    requests = []
    for job in index.unfinished():
        run = _started_run(index, job)
        if run is None or not (run / MANIFEST_NAME).is_file():
            requests.append(_first_request(index, job, config_dirs))
            continue
        manifest, job["run"] = Manifest.load(run), index.relative(run)
        if manifest.status == "finished":
            job["status"], job["results"] = "finished", manifest.results
        else:
            requests.append(resume_request(run, [str(folder) for folder in config_dirs]))
    return requests


def _started_run(index: SweepIndex, job: JobEntry) -> Path | None:
    """Return the run directory of a job, also if only the job's events name it; refuse a job that may be queued."""
    place = index.folder / JOBS / str(job["number"])
    queued = index.data["status"] == "running" and (place / REQUEST).is_file()
    if queued and last_event(place, "ended") is None:
        expected = f"an ended job: cancel it in the queue, and delete {place / REQUEST}"
        raise RunDirectoryError(f"job {job['number']} may still be in the queue", expected=expected)
    event = last_event(place, "run")
    run = index.run_of(job) or (Path(event["path"]) if event else None)
    if run is not None:
        index.require_inside(run.resolve())
    return run


def _first_request(index: SweepIndex, job: JobEntry, config_dirs: Sequence[Path]) -> JobRequest:
    """Return the request to train a job that has no run, from its recorded overrides."""
    from wheelleg_exp.config.checking.find_mistakes import compose_valid
    from wheelleg_exp.config.composing.compose_sweep import digest_of

    if (folder := index.data["working_directory"]) != str(Path.cwd()):
        message = f"job {job['number']} has no run, and the sweep was started in another folder"
        raise RunDirectoryError(message, key=str(index.path), expected=f"this command in {folder}")
    require_overrides(job["overrides"], index.path)
    composed = compose_valid(job["overrides"], config_dirs=config_dirs)
    index.require_inside(Path(composed.config["run"]["root"]).resolve())
    return train_request(job["overrides"], config_dirs, digest_of(composed))


class SweepDisplay(Protocol):
    """Shows the progress of a sweep. The argument ``job`` is one job's dictionary from the sweep's index file."""

    def started(self, job: JobEntry) -> None:
        """Show that a job started."""

    def iteration(self, job: JobEntry, done: int, total: int, scalars: Mapping[str, float]) -> None:
        """Show the number of training iterations that a job has finished."""

    def ended(self, job: JobEntry) -> None:
        """Show how a job ended."""

    def note(self, job: JobEntry, text: str, *, once: bool = True) -> None:
        """Show a line of text about a job of the sweep; if ``once`` is true, equal lines are shown once."""


class SweepRunner:
    """Runs the jobs of a sweep, at most ``at_once`` in parallel, until all jobs have ended or a stop is requested.

    A job computes the same bytes as ``wheelleg train``. After a stop request, it first finishes its current iteration.
    """

    def __init__(
        self,
        index: SweepIndex,
        requests: Sequence[JobRequest],
        at_once: int,
        display: SweepDisplay,
        stop: StopRequest,
        launcher: LocalLauncher | Queue | None = None,
    ) -> None:
        self._index = index
        self._waiting = deque(zip(index.unfinished(), requests, strict=True))
        self._at_once = at_once
        if at_once > 1:
            share_cores()
        self._display, self._stop = display, stop
        self._launcher = launcher or LocalLauncher()
        self._running: dict[Job, JobEntry] = {}

    @while_running()
    def run(self) -> SweepStatus:
        """Run all jobs of the sweep, and return the sweep's status."""
        status: SweepStatus = "failed"
        try:
            self._run()
            if self._stop.requested:
                status = "interrupted"
            elif all(job["status"] == "finished" for job in self._index.jobs):
                status = "finished"
        except KeyboardInterrupt:
            status = "interrupted"
        finally:
            self._index.finish(status)
        return status

    def _run(self) -> None:
        try:
            while self._running or (self._waiting and not self._stop.requested):
                if self._stop.requested:
                    for job in self._running:
                        job.ask_to_stop()
                elif self._waiting and len(self._running) < self._at_once:
                    self._start(*self._waiting.popleft())
                    continue
                self._listen()
                self._reap()
        finally:
            # If the sweep itself fails or is interrupted for the second time, stop all running jobs.
            try:
                self._end(lambda job: job.ask_to_stop(), 0.0)
                self._end(lambda job: job.interrupt(), _KILL_S)
                self._end(lambda job: job.kill(), _KILL_S)
            finally:
                for job in self._running:  # A third Ctrl-C interrupts the waits above, so kill the remaining jobs.
                    job.kill()
                    job.close()

    def _start(self, entry: JobEntry, request: JobRequest) -> None:
        if not self._launcher.queued:
            self._index.update(entry["number"], status="running", started=utc_text(utc_now()))
        self._running[self._launcher.start(entry["number"], request)] = entry
        if not self._launcher.queued:
            self._display.started(entry)

    def _listen(self, wait_s: float = _LISTEN_S) -> None:
        for source, event in self._launcher.listen(self._running, wait_s):
            job, kind = self._running[source], event["event"]
            if kind == "began":
                self._index.update(job["number"], status="running", started=utc_text(utc_now()))
                self._display.started(job)
            elif kind == "preempted":
                self._index.update(job["number"], status="waiting")
                self._display.note(job, "stopped by the queue, with a checkpoint", once=False)
            elif kind == "run":
                self._index.update(job["number"], run=self._index.relative(Path(event["path"])))
            elif kind == "iteration":
                self._display.iteration(job, event["done"], event["total"], event["scalars"])
            elif kind == "note":
                self._display.note(job, event["text"])

    def _reap(self) -> None:
        """Record the status of ended jobs in the sweep's index; a stopped job that never started stays ``waiting``."""
        for job in [job for job in self._running if job.over()]:
            self._listen(0.0)
            entry = self._running.pop(job)
            job.close()
            if entry["status"] == "waiting" and self._stop.requested:
                continue
            status, results, error = self._outcome(entry, job)
            ended = utc_text(utc_now())
            self._index.update(entry["number"], status=status, ended=ended, results=dict(results), error=error)
            self._display.ended(entry)

    def _outcome(self, entry: JobEntry, job: Job) -> tuple[JobStatus, Mapping[str, object], object]:
        """Return status, results, and error of a job: from its manifest if possible, else from its process."""
        # A resume can fail before it changes the manifest.
        if job.ended is not None and job.ended["status"] == "failed" and job.ended["error"]:
            return "failed", {}, job.ended["error"]
        run = self._index.run_of(entry)
        if run is not None:
            with contextlib.suppress(RunDirectoryError):
                manifest = Manifest.load(run)
                if manifest.status != "running":
                    return manifest.status, manifest.results, manifest.data["error"]  # type: ignore[return-value]
        if job.ended is not None:
            return job.ended["status"], {}, job.ended["error"]
        return "failed", {}, {"type": "error", "message": f"its process {job.describe_death()}"}

    def _end(self, act: Callable[[Job], None], patience_s: float) -> None:
        for job in self._running:
            act(job)
        deadline = time.monotonic() + patience_s
        while self._running and time.monotonic() < deadline:
            self._listen()
            with contextlib.suppress(WheellegError):  # Stop all jobs even if writing the sweep's index fails.
                self._reap()
