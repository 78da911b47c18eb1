"""Check on the host, without waiting for the GPU, whether countdown timers on a GPU may have expired.

The smallest remaining time is copied to the host every few steps; until it has passed, no timer can expire.
"""

from __future__ import annotations

import torch
from torch.utils.weak import WeakTensorKeyDictionary

_EVERY = 16  # Copy the timers' shortest remaining time from the GPU only every 16 control steps.
_SLACK = 1e-3  # s


def may_be_due(timers: torch.Tensor, least: float, dt: float) -> bool:
    """Return False if none of the ``timers`` on a GPU can have expired; always return True for timers on a CPU.

    ``timers`` (n,) has the remaining times, s; ``dt`` is the time since the last call, s. An expired timer must be
    restarted with at least ``least`` seconds; call ``forget`` after setting one to less.
    """
    if not timers.is_cuda:
        return True
    if timers not in _bounds:
        _bounds[timers] = _Bound()
    return bool(_bounds[timers].may_be_due(timers, least, dt))


def forget() -> None:
    """Discard the remaining times that were copied from the GPU; call this function after changing timers."""
    _bounds.clear()


class _Bound:
    """A lower bound, s, of the smallest remaining time of timers on a GPU, known without waiting for the GPU."""

    def __init__(self) -> None:
        self._bound = float("-inf")
        self._smallest: torch.Tensor | None = None
        self._arrived: torch.cuda.Event | None = None
        self._age, self._steps = 0.0, 0

    def may_be_due(self, timers: torch.Tensor, least: float, dt: float) -> bool:
        self._bound -= dt
        self._age += dt
        if self._arrived is not None and self._arrived.query() and self._smallest is not None:
            self._bound = min(float(self._smallest), least) - self._age - dt - _SLACK
            self._arrived = None
        if self._steps % _EVERY == 0 and self._arrived is None:
            if self._smallest is None:
                with torch.inference_mode(False):
                    self._smallest = torch.zeros((), dtype=timers.dtype, device="cpu", pin_memory=True)
            self._smallest.copy_(timers.amin(), non_blocking=True)
            self._arrived, self._age = torch.cuda.Event(), 0.0
            self._arrived.record()
        self._steps += 1
        return self._bound <= 0.0


_bounds: WeakTensorKeyDictionary = WeakTensorKeyDictionary()
