"""The near end of a job that a queue runs: its folder, its events, and whether it still goes on."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Protocol, cast

from wheelleg_exp.files import write_json, write_text
from wheelleg_exp.jobs.processes import Event, event_of
from wheelleg_exp.jobs.sweep.carrier import EVENTS, NOW, REQUEST, SOON, STOP
from wheelleg_exp.jobs.sweep.job import Request
from wheelleg_exp.jobs.sweep.launchers import PATH, Job
from wheelleg_exp.run.environment import variables

_FOLDER = "jobs"


class Ticket(Protocol):
    """What a queue gives for a job: whether it has it still, and how to take it back."""

    def gone(self) -> bool:
        """Return whether the queue is done with it."""

    def cancel(self) -> None:
        """Take it out of the queue, or end it."""

    def why(self) -> str:
        """Return what the queue says of a job that is gone and has not told how it ended."""


class QueuedJob:
    """A job of a queue, heard by the file that its far end writes (``carrier``).

    Args:
        folder: the job's own; it is made here.
        request: what it trains.

    Attributes:
        folder: as given, absolute.
        ticket: the queue's, once the job is submitted.
        began: whether it has told that it runs.
    """

    def __init__(self, folder: Path, request: Request) -> None:
        self.folder = folder.absolute()
        self.ticket: Ticket | None = None
        self.began = False
        self.ended: Event | None = None
        self.last_words: deque[str] = deque()  # the ticket has them
        self._read, self._stopped = 0, False
        facts = {
            "line": request.line().decode().rstrip("\n"),
            "path": [str(Path(entry).absolute()) for entry in PATH],
            "working_directory": str(Path.cwd()),
            "variables": variables(),
        }
        write_json(self.folder / REQUEST, facts)

    def events(self) -> Iterator[Event]:
        """Yield what has been told since the last call."""
        try:
            with (self.folder / EVENTS).open("rb") as file:
                file.seek(self._read)
                found = file.read()
        except OSError:
            return
        whole = found[: found.rfind(b"\n") + 1]
        self._read += len(whole)
        for line in whole.splitlines():
            told = event_of(line.decode(errors="replace"))
            if told is None:
                continue
            if told["event"] == "ended":
                self.ended = told
                continue
            self.began = self.began or told["event"] == "began"
            yield told

    def over(self) -> bool:
        """Return whether the queue is done with it, or it was stopped before it was handed in."""
        if self.ticket is None:
            return self._stopped
        return self.ended is not None or self.ticket.gone()

    def ask_to_stop(self) -> None:
        """Let it stop at its next whole iteration; one that waits is taken out of the queue."""
        if self._stopped:
            return
        self._stopped = True
        write_text(self.folder / STOP, SOON)
        if not self.began and self.ticket is not None:
            self.ticket.cancel()

    def interrupt(self) -> None:
        """Let it stop at once."""
        write_text(self.folder / STOP, NOW)

    def kill(self) -> None:
        """Take it from the queue."""
        if self.ticket is not None:
            self.ticket.cancel()

    def end_now(self) -> None:
        """Take it from the queue, which may take its time."""
        self.kill()

    def close(self) -> None:
        """Keep the folder: what the job has told may be asked for."""

    def how_it_died(self) -> str:
        """Return what the queue says of it."""
        return "was never handed in" if self.ticket is None else self.ticket.why()


class Queue:
    """What launchers have in common whose jobs a queue runs; a subclass says how jobs are handed in.

    Args:
        folder: the sweep's folder.
    """

    queued = True

    def __init__(self, folder: Path) -> None:
        self._folder = folder / _FOLDER
        self._pending: list[QueuedJob] = []

    def start(self, number: int, request: Request) -> Job:
        """Prepare a job; it is handed in with the others, when they are listened to."""
        job = QueuedJob(self._folder / str(number), request)
        self._pending.append(job)
        return job

    def submit(self, jobs: Collection[QueuedJob]) -> list[Ticket]:
        """Hand jobs in, and return the ticket of each."""
        raise NotImplementedError

    def listen(self, jobs: Collection[Job], wait_s: float) -> Iterator[tuple[Job, Event]]:
        """Yield what the jobs have written."""
        waiting, self._pending = [job for job in self._pending if not job.over()], []
        if waiting:
            for job, ticket in zip(waiting, self.submit(waiting), strict=True):
                job.ticket = ticket
        until = time.monotonic() + wait_s
        while not (told := [(job, e) for job in jobs for e in cast(QueuedJob, job).events()]):
            if time.monotonic() >= until or any(job.over() for job in jobs):
                return
            time.sleep(min(wait_s, 0.1))
        yield from told
