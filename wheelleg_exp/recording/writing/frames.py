"""Rows of captured frames, kept in numpy until they are sent, and the numbers of their episodes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from wheelleg_exp.recording.writing.channels import Channel
from wheelleg_exp.rendering.shapes import Array

_FIRST_CAPACITY = 256


@dataclass(frozen=True)
class Stamp:
    """The moment of a frame: control step, simulated time in ns, and the training iteration or -1."""

    step: int
    time_ns: int
    iteration: int


class Frames:
    """The frames of one environment since the last flush; grows as needed.

    Args:
        channels: what a frame holds, in the order in which it is read.
    """

    def __init__(self, channels: Sequence[Channel]) -> None:
        self.channels = list(channels)
        ends = np.cumsum([len(channel.names) for channel in self.channels]).tolist()
        starts = [0, *ends[:-1]]
        self._slices = [slice(a, b) for a, b in zip(starts, ends, strict=True)]
        self._readers = [(c.read, s) for c, s in zip(self.channels, self._slices, strict=True)]
        self._rows = np.empty((_FIRST_CAPACITY, ends[-1]))
        self.count = 0

    def append(self) -> None:
        """Read every channel into a new row."""
        if self.count == len(self._rows):
            self._rows = np.concatenate((self._rows, np.empty_like(self._rows)))
        row = self._rows[self.count]
        for read, columns in self._readers:
            row[columns] = read()
        self.count += 1

    def blocks(self) -> dict[str, Array]:
        """Return the rows (n, width) of each channel by its key."""
        rows = self._rows[: self.count]
        return {c.key: rows[:, s] for c, s in zip(self.channels, self._slices, strict=True)}

    def clear(self) -> None:
        """Forget the rows."""
        self.count = 0


class Episodes:
    """Counts up whenever a row does not continue the one before: a reset, or a gap between two samples."""

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
