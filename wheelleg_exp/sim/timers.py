"""Timers that run down, of which the host knows without waiting for a GPU that none can be up yet."""

from __future__ import annotations

import torch
from torch.utils.weak import WeakTensorKeyDictionary

_EVERY = 16  # steps between two looks at a GPU
_SLACK = 1e-3  # s: of single precision


def may_be_due(timers: torch.Tensor, least: float, dt: float) -> bool:
    """Return whether one of some timers, which have just run down or are about to, may be up.

    On a CPU one always may: the timers are at hand. Who sets a timer to less than ``least`` calls ``forget``.

    Args:
        timers: (n,), s; asked for at every step.
        least: what a timer is set to at least, s.
        dt: by how much they have run down, s.
    """
    if not timers.is_cuda:
        return True
    if timers not in _bounds:
        _bounds[timers] = _Bound()
    return _bounds[timers].may_be_due(timers, least, dt)


def forget() -> None:
    """Know nothing of any timers: some were set by others than who looks at them."""
    _bounds.clear()


class _Bound:
    """A bound below the least of some timers, from what they were when a GPU was asked last."""

    def __init__(self) -> None:
        self._bound = float("-inf")
        self._told: torch.Tensor | None = None
        self._come: torch.cuda.Event | None = None
        self._age, self._steps = 0.0, 0

    def may_be_due(self, timers: torch.Tensor, least: float, dt: float) -> bool:
        """See the function."""
        self._bound -= dt
        self._age += dt
        if self._come is not None and self._come.query() and self._told is not None:
            self._bound = min(float(self._told), least) - self._age - dt - _SLACK
            self._come = None
        if self._steps % _EVERY == 0 and self._come is None:
            self._ask(timers)
        self._steps += 1
        return self._bound <= 0.0

    def _ask(self, timers: torch.Tensor) -> None:
        if self._told is None:
            with torch.inference_mode(False):
                self._told = torch.zeros((), dtype=timers.dtype, device="cpu", pin_memory=True)
        self._told.copy_(timers.amin(), non_blocking=True)
        self._come, self._age = torch.cuda.Event(), 0.0
        self._come.record()


_bounds: WeakTensorKeyDictionary = WeakTensorKeyDictionary()
