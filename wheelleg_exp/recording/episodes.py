"""Numbering the episodes of a recorded environment."""

from __future__ import annotations


class Episodes:
    """Counts up whenever a row does not continue the one before: a reset, or a gap between two segments."""

    def __init__(self) -> None:
        self.number = -1
        self._step, self._episode_step = -1, -1

    def advance(self, step: int, episode_step: int) -> None:
        """Take up a row: its control step and its step within the episode, from 1."""
        if step != self._step + 1 or episode_step != self._episode_step + 1:
            self.number += 1
        self._step, self._episode_step = step, episode_step

    def restore(self, number: int, step: int, episode_step: int) -> None:
        """Go on after a row that is already recorded."""
        self.number, self._step, self._episode_step = number, step, episode_step
