"""Launchers of sweep jobs: the interface, and the launcher that starts processes on this machine."""

from __future__ import annotations

import os
from collections.abc import Collection, Iterator, Sequence
from typing import Protocol, cast

from wheelleg_exp.child_process import Child, Event, listen
from wheelleg_exp.jobs.training_job import JobRequest, job_program


class Job(Protocol):
    """A job that was started.

    Attributes:
        ended: the event with which the job ended; None while it runs, and if it died.
    """

    ended: Event | None

    def over(self) -> bool:
        """Return whether the job has ended, well or not."""

    def ask_to_stop(self) -> None:
        """Ask the job to stop at its next whole iteration."""

    def interrupt(self) -> None:
        """Stop a job at once that was asked to stop."""

    def kill(self) -> None:
        """Kill the job."""

    def close(self) -> None:
        """Close the connection to the job."""

    def describe_death(self) -> str:
        """Return how a job ended that sent no last event."""


class Launcher(Protocol):
    """Starts jobs and receives their events.

    Attributes:
        queued: whether a started job can wait in a queue; such a job sends ``began``.
    """

    queued: bool

    def start(self, number: int, request: JobRequest) -> Job:
        """Start a job.

        Args:
            number: the number of the job in the index.
            request: what the job trains.
        """

    def listen(self, jobs: Collection[Job], wait_s: float) -> Iterator[tuple[Job, Event]]:
        """Yield the events that jobs have sent; wait at most ``wait_s`` for the first one."""


class LocalLauncher:
    """Runs jobs as processes of this machine; they stop by themselves when this process is killed.

    Args:
        program: the command that serves one job, by default ``job_program()``.
    """

    queued = False

    def __init__(self, program: Sequence[str] | None = None) -> None:
        self._program = program or job_program()

    def start(self, number: int, request: JobRequest) -> Job:
        """Start the process of a job."""
        del number  # the pipes identify the process
        # Python's environment, because libraries of this process may have changed the C library's environment.
        return Child(self._program, request.line(), os.environ)

    def listen(self, jobs: Collection[Job], wait_s: float) -> Iterator[tuple[Job, Event]]:
        """Yield what the processes have written to their pipes."""
        return listen(cast(Collection[Child], jobs), wait_s)
