"""Run the jobs of a sweep, each in its own process, and keep the index of the sweep up to date."""

from __future__ import annotations

import contextlib
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

from wheelleg_exp.child_process import Event
from wheelleg_exp.errors import RunDirectoryError, WheellegError
from wheelleg_exp.files import while_running
from wheelleg_exp.jobs.sweep_launchers import Job, Launcher, LocalLauncher
from wheelleg_exp.jobs.training_job import JobRequest
from wheelleg_exp.machine import share_cores
from wheelleg_exp.run.manifest import Manifest
from wheelleg_exp.run.run_index import JobStatus, SweepIndex, SweepStatus
from wheelleg_exp.stop_request import StopRequest

_WAIT_S = 0.2
_PATIENCE_S = 10.0


def make_launcher(name: str, settings: Mapping[str, Any], folder: Path) -> Launcher:
    """Return the launcher that Hydra's group ``hydra/launcher`` names.

    Args:
        name: the option of the group.
        settings: its settings, plain.
        folder: the folder of the sweep, which all machines must see.

    Raises:
        WheellegError: the library of the launcher is not installed, or its queue cannot be reached.
    """
    if name.startswith("submitit"):
        from wheelleg_exp.jobs.sweep_queue import SubmititLauncher

        return SubmititLauncher(name.removeprefix("submitit_"), settings, folder)
    if name == "ray":
        from wheelleg_exp.jobs.sweep_queue import RayLauncher

        return RayLauncher(settings, folder)
    return LocalLauncher()


class SweepDisplay(Protocol):
    """Receives what happens during a sweep. Each job is its entry in the index."""

    def started(self, job: Mapping[str, Any]) -> None:
        """Show that a job started."""

    def iteration(self, job: Mapping[str, Any], done: int, total: int, scalars: Mapping[str, float]) -> None:
        """Show the iterations that a job has done."""

    def ended(self, job: Mapping[str, Any]) -> None:
        """Show how a job ended."""

    def note(self, job: Mapping[str, Any], text: str) -> None:
        """Show one line of a job."""


class SweepRunner:
    """Runs jobs, a fixed number at once, until all have ended or a stop is requested.

    Each job has its own process: it computes the same bytes as ``wheelleg train`` with its overrides, and a job that
    dies does not affect the others.

    Args:
        index: the index of the sweep, which this object keeps up to date.
        requests: what each job of the index trains.
        at_once: how many jobs run at the same time.
        display: receives what happens.
        stop: requests a stop; every job stops at its next whole iteration, with a checkpoint.
        launcher: runs the jobs, by default as processes of this machine.
    """

    def __init__(
        self,
        index: SweepIndex,
        requests: Sequence[JobRequest],
        at_once: int,
        display: SweepDisplay,
        stop: StopRequest,
        launcher: Launcher | None = None,
    ) -> None:
        self._index = index
        self._waiting = deque(zip(index.jobs, requests, strict=True))
        self._at_once = at_once
        if at_once > 1:
            share_cores()
        self._display = display
        self._stop = stop
        self._launcher: Launcher = launcher or LocalLauncher()
        self._running: dict[Job, dict[str, Any]] = {}  # with the entry in the index

    @while_running()
    def run(self) -> SweepStatus:
        """Run all jobs, and return the status of the sweep.

        Raises:
            SimulationFailure: the index cannot be written; the jobs were stopped.
        """
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
            self._end_all()

    def _start(self, entry: dict[str, Any], request: JobRequest) -> None:
        if not self._launcher.queued:
            self._index.job_started(entry["number"])
        self._running[self._launcher.start(entry["number"], request)] = entry
        if not self._launcher.queued:
            self._display.started(entry)

    def _listen(self, wait_s: float = _WAIT_S) -> None:
        for job, event in self._launcher.listen(self._running, wait_s):
            self._hear(self._running[job], event)

    def _hear(self, job: dict[str, Any], event: Event) -> None:
        kind = event["event"]
        if kind == "began":
            self._index.job_started(job["number"])
            self._display.started(job)
        elif kind == "run":
            self._index.job_has_run(job["number"], event["path"])
        elif kind == "iteration":
            self._display.iteration(job, event["done"], event["total"], event["scalars"])
        elif kind == "note":
            self._display.note(job, event["text"])

    def _reap(self) -> None:
        """Record the jobs that have ended. A job that left its queue before it started is still waiting."""
        for job in [job for job in self._running if job.over()]:
            self._listen(0.0)
            entry = self._running.pop(job)
            job.close()
            if entry["status"] == "waiting" and self._stop.requested:
                continue
            self._index.job_ended(entry["number"], *self._outcome(entry, job))
            self._display.ended(entry)

    def _outcome(self, entry: dict[str, Any], job: Job) -> tuple[JobStatus, dict[str, Any], Any]:
        """Return status, results, and error of a job: from its manifest if possible, else from its process."""
        run = self._index.run_of(entry)
        if run is not None:
            with contextlib.suppress(RunDirectoryError):
                manifest = Manifest.load(run)
                if manifest.status != "running":
                    return manifest.status, manifest.results, manifest.data["error"]  # type: ignore[return-value]
        if job.ended is not None:
            return job.ended["status"], {}, job.ended["error"]
        return "failed", {}, {"type": "error", "message": f"its process {job.describe_death()}"}

    def _end_all(self) -> None:
        """End the jobs that still run when the sweep itself fails or is interrupted for the second time."""
        try:
            self._end(lambda job: job.ask_to_stop(), 0.0)
            self._end(lambda job: job.interrupt(), _PATIENCE_S)
            self._end(lambda job: job.kill(), _PATIENCE_S)
        finally:
            for job in self._running:  # a third interrupt ends the waiting
                job.kill()
                job.close()

    def _end(self, act: Callable[[Job], None], patience_s: float) -> None:
        for job in self._running:
            act(job)
        deadline = time.monotonic() + patience_s
        while self._running and time.monotonic() < deadline:
            self._listen()
            with contextlib.suppress(WheellegError):  # the index reported a full disk before
                self._reap()
