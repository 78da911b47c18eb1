"""Ranges that commands are drawn from, and that a curriculum may change."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch

from wheelleg_exp.managers import CommandTerm, bounds


class RangedCommand(CommandTerm):
    """A command that is drawn from a range for each axis.

    Attributes:
        ranges: [low, high] by axis; one that is set anew holds from the next draw on.
    """

    ranges: dict[str, Any]

    def take_ranges(self, ranges: Mapping[Any, Sequence[float] | None], axes: Sequence[str]) -> None:
        """Draw from ranges by axis; an axis without one is 0.

        Raises:
            ConfigError: an axis is unknown or a range is not two numbers in order.
        """
        self._axes = tuple(axes)
        self.ranges = {axis: list(pair) for axis, pair in ranges.items() if pair is not None}
        self._take()

    def bounds(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Return lows and highs (k,) of the axes in order."""
        if self.ranges != self._taken:  # a curriculum has set one
            self._take()
        return self._bounds

    def _take(self) -> None:
        # A tuple: tensors among the attributes are state.
        self._bounds = bounds(self.ranges, self._axes, "ranges", self.time_left.device)
        self._taken = {axis: list(pair) for axis, pair in self.ranges.items()}
