"""Displays of a job's progress: the interface, one that shows nothing, and one that sends events to a parent process.

The commands define the displays that people see.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

from wheelleg_exp.child_process import EventPipe

if TYPE_CHECKING:
    from wheelleg_exp.rl.trainer import Iteration


class Display(Protocol):
    """Receives what happens during a job."""

    def environment(self, description: str) -> None:
        """Show the managers' tables."""

    def note(self, text: str) -> None:
        """Show one line."""

    def iteration(self, iteration: Iteration, total: int) -> None:
        """Show that a training iteration is done."""

    def steps(self, done: int, total: int) -> None:
        """Show how many steps of a rollout are done."""


class SilentDisplay:
    """A display that shows nothing."""

    def environment(self, description: str) -> None:
        """Show nothing."""

    def note(self, text: str) -> None:
        """Show nothing."""

    def iteration(self, iteration: Iteration, total: int) -> None:
        """Show nothing."""

    def steps(self, done: int, total: int) -> None:
        """Show nothing."""


class PipeDisplay(SilentDisplay):
    """Sends notes and iterations as events; its parent has no use for tables and rollouts."""

    def __init__(self, pipe: EventPipe) -> None:
        self._pipe = pipe

    def note(self, text: str) -> None:
        """Send one line."""
        self._pipe.send("note", text=text)

    def iteration(self, iteration: Iteration, total: int) -> None:
        """Send that a training iteration is done."""
        self._pipe.send("iteration", done=iteration.index + 1, total=total, scalars=iteration.scalars)
