"""Run each job of a sweep in its own process, on this machine or through a queue, and update the sweep's index."""

from __future__ import annotations

import contextlib
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Protocol

from wheelleg_exp.errors import RunDirectoryError, WheellegError
from wheelleg_exp.files import while_running
from wheelleg_exp.jobs.sweep_queue import Job, LocalLauncher, Queue
from wheelleg_exp.jobs.training_job import JobRequest
from wheelleg_exp.machine import share_cores
from wheelleg_exp.run.manifest import Manifest
from wheelleg_exp.run.run_index import JobEntry, JobStatus, SweepIndex, SweepStatus
from wheelleg_exp.run.timestamps import utc_now, utc_text
from wheelleg_exp.stop_request import StopRequest

_WAIT_S, _PATIENCE_S = 0.2, 10.0


class SweepDisplay(Protocol):
    """Shows the progress of a sweep. The argument ``job`` is one job's dictionary from the sweep's index file."""

    def started(self, job: JobEntry) -> None:
        """Show that a job started."""

    def iteration(self, job: JobEntry, done: int, total: int, scalars: Mapping[str, float]) -> None:
        """Show the number of training iterations that a job has finished."""

    def ended(self, job: JobEntry) -> None:
        """Show how a job ended."""

    def note(self, job: JobEntry, text: str) -> None:
        """Show a line of text about a job of the sweep."""


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
        self._waiting = deque(zip(index.jobs, requests, strict=True))
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
                self._end(lambda job: job.interrupt(), _PATIENCE_S)
                self._end(lambda job: job.kill(), _PATIENCE_S)
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

    def _listen(self, wait_s: float = _WAIT_S) -> None:
        for source, event in self._launcher.listen(self._running, wait_s):
            job, kind = self._running[source], event["event"]
            if kind == "began":
                self._index.update(job["number"], status="running", started=utc_text(utc_now()))
                self._display.started(job)
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
