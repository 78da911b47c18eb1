"""Launchers of sweep jobs: the interface, and the launcher that starts processes on this machine."""

from __future__ import annotations

import os
import sys
from collections import deque
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path
from typing import Protocol, cast

from wheelleg_exp.jobs.processes import Child, Event, listen
from wheelleg_exp.jobs.sweep_job import Request

# The job imports what this process would import, whatever folder it is called from.
_BOOT = (
    "import os, sys; sys.path[:] = sys.argv.pop().split(os.pathsep); "
    "from wheelleg_exp.jobs.sweep_job import main; sys.exit(main())"
)

# Before what a queue's library does to it.
PATH = tuple(entry for entry in sys.path if Path(entry).exists())


class Job(Protocol):
    """A job that was started: heard, asked to stop.

    Attributes:
        ended: what it has told of its end; None when it has not.
        last_words: its last lines on standard error.
    """

    ended: Event | None
    last_words: deque[str]

    def over(self) -> bool:
        """Return whether it has ended, well or not."""

    def ask_to_stop(self) -> None:
        """Let it stop at its next whole iteration."""

    def interrupt(self) -> None:
        """Let a job that has been asked to stop do so at once."""

    def kill(self) -> None:
        """End it."""

    def end_now(self) -> None:
        """End it, and wait for nobody else."""

    def close(self) -> None:
        """Let go of what it was heard by."""

    def how_it_died(self) -> str:
        """Return how a job ended that did not say so itself."""


class Launcher(Protocol):
    """Starts jobs and hears them.

    Attributes:
        queued: whether a job that was started may have to wait, and tells when it begins.
    """

    queued: bool

    def start(self, number: int, request: Request) -> Job:
        """Start a job.

        Args:
            number: the job's, in the index.
            request: what it trains.
        """

    def listen(self, jobs: Collection[Job], wait_s: float) -> Iterator[tuple[Job, Event]]:
        """Yield what jobs have told by now, having waited for a first word no longer than ``wait_s``."""


class LocalLauncher:
    """Runs jobs as processes of this machine; they stop by themselves when this one is killed.

    Args:
        program: the command that runs one job, by default ``job`` under this interpreter.
    """

    queued = False

    def __init__(self, program: Sequence[str] | None = None) -> None:
        self._program = program or program_here()

    def start(self, number: int, request: Request) -> Job:
        """Start a job's process."""
        del number  # of no use: its pipes are its own
        # Python's environment, and not the C library's, into which libraries of this process may have written.
        return Child(self._program, request.line(), os.environ)

    def listen(self, jobs: Collection[Job], wait_s: float) -> Iterator[tuple[Job, Event]]:
        """Yield what the processes have written to their pipes."""
        return listen(cast(Collection[Child], jobs), wait_s)


def program_here(path: Sequence[str] | None = None) -> tuple[str, ...]:
    """Return the command that runs one job under this interpreter.

    Args:
        path: where it imports from, by default as this process does.
    """
    return (sys.executable, "-P", "-c", _BOOT, os.pathsep.join(sys.path if path is None else path))
