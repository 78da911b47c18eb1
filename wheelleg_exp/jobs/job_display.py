"""Display of a job's progress: the interface; the commands decide how the progress looks."""

from __future__ import annotations

from typing import Protocol

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
        """Show how far a rollout is."""
