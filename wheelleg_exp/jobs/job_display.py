"""Displays of the progress of a job: a silent base class, and one that sends events to a parent process."""

from __future__ import annotations

from typing import TYPE_CHECKING

from wheelleg_exp.child_process import EventPipe

if TYPE_CHECKING:
    from wheelleg_exp.rl.trainer import Iteration


class Display:
    """Receives the progress and the results of a job, such as a training; the methods of this base class do nothing."""

    def environment(self, description: str) -> None:
        """Show the tables of an environment's managers."""

    def note(self, text: str) -> None:
        """Show one line."""

    def iteration(self, iteration: Iteration, total: int) -> None:
        """Show that one training iteration has finished."""

    def steps(self, done: int, total: int) -> None:
        """Show how many steps of a rollout are finished."""


class PipeDisplay(Display):
    """Sends the notes and the iterations of a job as events to the parent process."""

    def __init__(self, pipe: EventPipe) -> None:
        self._pipe = pipe

    def note(self, text: str) -> None:
        self._pipe.send("note", text=text)

    def iteration(self, iteration: Iteration, total: int) -> None:
        self._pipe.send("iteration", done=iteration.index + 1, total=total, scalars=iteration.scalars)
