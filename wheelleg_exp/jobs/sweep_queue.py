"""Run sweep jobs through a queue: the part on the machine of the sweep, and the part on the machine of the job.

The machines exchange files in the job's folder, which both must see: ``request.json`` is written before the job is
submitted, ``events.jsonl`` grows while the job runs, and ``stop`` asks the job to stop.
"""

from __future__ import annotations

import json
import os
import socket
import sys
import time
from collections import deque
from collections.abc import Collection, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor, wait
from pathlib import Path
from typing import Any, Protocol, cast

from wheelleg_exp.files import write_json, write_text
from wheelleg_exp.jobs.processes import Child, Event, event_of, listen
from wheelleg_exp.jobs.sweep_job import Request
from wheelleg_exp.jobs.sweep_launchers import PATH, Job, program_here
from wheelleg_exp.run.environment import replay_environ, variables

REQUEST, EVENTS, STOP = "request.json", "events.jsonl", "stop"
SOON, NOW = "soon", "now"  # what STOP may hold
_WAIT_S = 0.3
_PATIENCE_S = 90.0  # of Slurm's delay between its warning and the kill, which is 120 s by default


class QueueWorker:
    """Runs one job; the object is what travels to the other machine, and holds nothing.

    Its process computes what it would on the machine of the sweep: variables on which numbers depend are that one's.
    """

    _child: Child | None = None
    _carried: Future[str] | None = None

    def __call__(self, folder: str) -> str:
        """Run the job whose folder it is, and return its status.

        Args:
            folder: absolute, seen by this machine as by the one that wrote it.
        """
        place = Path(folder)
        request = json.loads((place / REQUEST).read_text(encoding="utf-8"))
        if (place / EVENTS).exists():
            raise RuntimeError("the job has run already, and is not begun anew")
        self._tell(place, {"event": "began", "host": socket.gethostname(), "pid": os.getpid()})
        same = all(Path(entry).exists() for entry in request["path"])  # else this machine's own installation
        path = request["path"] if same else sys.path
        environ = replay_environ(request["variables"])
        self._child = Child(
            program_here(path), request["line"].encode() + b"\n", environ, Path(request["working_directory"])
        )
        with ThreadPoolExecutor(1) as reader:  # which no signal interrupts
            self._carried = reader.submit(self._carry, self._child, place)
            return self._carried.result()

    def checkpoint(self, folder: str) -> None:
        """Let the job stop with a checkpoint: its time is over. It is not begun again."""
        del folder
        if self._child is not None and self._carried is not None:
            self._child.ask_to_stop()
            if not wait([self._carried], _PATIENCE_S).done:
                self._child.kill()

    def _carry(self, child: Child, place: Path) -> str:
        asked = ""
        while child.process.poll() is None:
            self._pass_on(child, place, _WAIT_S)
            wanted = _read_or_empty(place / STOP)
            if wanted != asked:
                child.ask_to_stop() if wanted == SOON else child.interrupt()
                asked = wanted
        self._pass_on(child, place, 0.0)
        child.close()
        ended = child.ended or {"event": "ended", "status": "failed", "error": _death_error(child)}
        self._tell(place, ended)
        return str(ended["status"])

    def _pass_on(self, child: Child, place: Path, wait_s: float) -> None:
        for _, event in listen([child], wait_s):
            self._tell(place, event)

    def _tell(self, place: Path, event: Mapping[str, Any]) -> None:
        with (place / EVENTS).open("a", encoding="utf-8") as file:
            file.write(json.dumps(event) + "\n")


def _death_error(child: Child) -> dict[str, str]:
    words = "".join(f": {line.strip()}" for line in [*child.last_words][-1:])
    return {"type": "error", "message": f"its process on {socket.gethostname()} {child.how_it_died()}{words}"}


def _read_or_empty(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except OSError:
        return ""


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
