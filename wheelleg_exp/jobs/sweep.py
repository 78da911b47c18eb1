"""Running the jobs of a sweep, each in a process of its own, and keeping the sweep's index up to date."""

from __future__ import annotations

import contextlib
import json
import os
import selectors
import signal
import subprocess
import sys
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol

from wheelleg_exp.errors import RunDirectoryError, WheellegError
from wheelleg_exp.jobs.stop import StopRequest
from wheelleg_exp.jobs.sweep_job import Request
from wheelleg_exp.run.manifest import Manifest
from wheelleg_exp.run.sweep import JobStatus, SweepIndex, SweepStatus

# The job imports what this process would import, whatever folder it is called from.
_BOOT = (
    "import os, sys; sys.path[:] = sys.argv.pop().split(os.pathsep); "
    "from wheelleg_exp.jobs.sweep_job import main; sys.exit(main())"
)
_WAIT_S = 0.2
_PATIENCE_S = 10.0
_CHUNK = 1 << 16


class SweepDisplay(Protocol):
    """Receives what happens during a sweep; jobs are told as the index has them."""

    def started(self, job: Mapping[str, Any]) -> None:
        """Show that a job began."""

    def iteration(self, job: Mapping[str, Any], done: int, total: int, scalars: Mapping[str, float]) -> None:
        """Show how far a job's training is."""

    def ended(self, job: Mapping[str, Any]) -> None:
        """Show how a job ended."""

    def note(self, job: Mapping[str, Any], text: str) -> None:
        """Show one line of a job."""


class _Lines:
    """The whole lines of a pipe, read without waiting."""

    def __init__(self, descriptor: int) -> None:
        self.descriptor = descriptor
        self._rest = b""
        os.set_blocking(descriptor, False)

    def read(self) -> tuple[list[str], bool]:
        """Return the lines there are by now, and whether more may come."""
        try:
            while chunk := os.read(self.descriptor, _CHUNK):
                self._rest += chunk
        except BlockingIOError:
            more = True
        else:
            more = False
        *whole, self._rest = (self._rest if more else self._rest + b"\n").split(b"\n")
        return [line.decode(errors="replace") for line in whole if line.strip()], more


class _Job:
    """A running job: its process, and what it has told."""

    def __init__(self, entry: dict[str, Any], request: Request, program: Sequence[str]) -> None:
        self.entry = entry
        # A group of its own: Ctrl-C reaches the sweep alone, which asks the jobs to stop. Python's environment, and
        # not the C library's, into which libraries of this process may have written.
        self.process = subprocess.Popen(
            program,
            env=dict(os.environ),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            bufsize=0,
            process_group=0,
        )
        words, output, errors = self.process.stdin, self.process.stdout, self.process.stderr
        assert words is not None
        assert output is not None
        assert errors is not None
        self._input, self._pipes = words, (words, output, errors)
        self.events, self.errors = _Lines(output.fileno()), _Lines(errors.fileno())
        self.last_words: deque[str] = deque(maxlen=1)
        self.ended: dict[str, Any] | None = None
        with contextlib.suppress(OSError):  # it may be gone already; how it ended says so
            self._input.write(request.line())

    @property
    def number(self) -> int:
        """The job's number in the index."""
        return int(self.entry["number"])

    def ask_to_stop(self) -> None:
        """Let the job stop at its next whole iteration."""
        self._input.close()

    def interrupt(self) -> None:
        """Let a job that has been asked to stop do so at once: it takes this as the second time."""
        self.process.send_signal(signal.SIGINT)

    def kill(self) -> None:
        """End the process."""
        self.process.kill()

    def close(self) -> None:
        """Close the pipes."""
        for pipe in self._pipes:
            pipe.close()


class SweepRunner:
    """Runs jobs, a fixed number at once, until all have ended or a stop is asked for.

    A job is a process of its own from its first import on: it computes the same bytes as ``wheelleg train`` of
    its overrides, whatever runs beside it, and one that dies takes no other with it.

    Args:
        index: the sweep's index, which is kept up to date.
        requests: what each job of the index trains.
        at_once: how many jobs run at the same time.
        display: receives what happens.
        stop: asks to stop; every job stops at its next whole iteration, with a checkpoint.
        program: the command that runs one job, by default ``sweep_job`` under this interpreter.
    """

    def __init__(
        self,
        index: SweepIndex,
        requests: Sequence[Request],
        at_once: int,
        display: SweepDisplay,
        stop: StopRequest,
        program: Sequence[str] | None = None,
    ) -> None:
        self._index = index
        self._waiting = deque(zip(index.jobs, requests, strict=True))
        self._at_once = at_once
        self._display = display
        self._stop = stop
        self._program = program or (sys.executable, "-P", "-c", _BOOT, os.pathsep.join(sys.path))
        self._running: list[_Job] = []
        self._selector = selectors.DefaultSelector()

    def run(self) -> SweepStatus:
        """Run all jobs and return how the sweep ended, as the index has it.

        Raises:
            SimulationFailure: the index cannot be written; the jobs have been stopped.
        """
        status: SweepStatus = "failed"
        try:
            with self._selector:
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
                    self._ask_to_stop()
                elif self._waiting and len(self._running) < self._at_once:
                    self._start(*self._waiting.popleft())
                    continue
                self._listen()
                self._reap()
        finally:
            self._end_all()

    def _start(self, entry: dict[str, Any], request: Request) -> None:
        self._index.job_started(entry["number"])
        job = _Job(entry, request, self._program)
        self._running.append(job)
        for lines, heard in ((job.events, self._hear_event), (job.errors, self._hear_error)):
            self._selector.register(lines.descriptor, selectors.EVENT_READ, (lines, heard, job))
        self._display.started(entry)

    def _ask_to_stop(self) -> None:
        for job in self._running:
            job.ask_to_stop()

    def _listen(self, wait_s: float = _WAIT_S) -> None:
        """Take in what the jobs have told."""
        for key, _ in self._selector.select(wait_s):
            lines, heard, job = key.data
            told, more = lines.read()
            for line in told:
                heard(job, line)
            if not more:
                self._selector.unregister(key.fd)

    def _hear_event(self, job: _Job, line: str) -> None:
        told = json.loads(line)
        if told["event"] == "run":
            self._index.job_has_run(job.number, told["path"])
        elif told["event"] == "iteration":
            self._display.iteration(job.entry, told["done"], told["total"], told["scalars"])
        elif told["event"] == "note":
            self._display.note(job.entry, told["text"])
        elif told["event"] == "ended":
            job.ended = told

    def _hear_error(self, job: _Job, line: str) -> None:
        job.last_words.append(line.strip())
        self._display.note(job.entry, line.rstrip())

    def _reap(self) -> None:
        """Record the jobs whose process has ended."""
        for job in [job for job in self._running if job.process.poll() is not None]:
            self._listen(0.0)
            self._running.remove(job)
            for lines in (job.events, job.errors):
                with contextlib.suppress(KeyError):
                    self._selector.unregister(lines.descriptor)
            job.close()
            self._index.job_ended(job.number, *self._outcome(job))
            self._display.ended(job.entry)

    def _outcome(self, job: _Job) -> tuple[JobStatus, dict[str, Any], Any]:
        """Return status, results and error of a job: its manifest's, if that says how it ended."""
        run = self._index.run_of(job.entry)
        if run is not None:
            with contextlib.suppress(RunDirectoryError):
                manifest = Manifest.load(run)
                if manifest.status != "running":
                    return manifest.status, manifest.results, manifest.data["error"]  # type: ignore[return-value]
        if job.ended is not None:
            return job.ended["status"], {}, job.ended["error"]
        return "failed", {}, {"type": "error", "message": _how_it_died(job)}

    def _end_all(self) -> None:
        """End what still runs, when the sweep itself fails or is interrupted for the second time."""
        try:
            self._end(_Job.ask_to_stop, 0.0)
            self._end(_Job.interrupt, _PATIENCE_S)
            self._end(_Job.kill, _PATIENCE_S)
        finally:
            for job in self._running:  # a third interrupt: nobody waits any longer
                job.kill()
                job.process.wait()
                job.close()

    def _end(self, act: Callable[[_Job], None], patience_s: float) -> None:
        for job in self._running:
            act(job)
        deadline = time.monotonic() + patience_s
        while self._running and time.monotonic() < deadline:
            self._listen()
            with contextlib.suppress(WheellegError):  # a full disk has been told already
                self._reap()


def _how_it_died(job: _Job) -> str:
    code = job.process.returncode
    if code >= 0:
        how = f"its process ended with status {code} and did not say why"
    else:
        name = signal.Signals(-code).name
        how = f"its process was ended by {name}" + (" (out of memory?)" if name == "SIGKILL" else "")
    return how + "".join(f": {words}" for words in job.last_words)
