"""Ask a device for masks and for finite numbers, without waiting for the answer at once."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch


class AsyncMaskQuery:
    """Which environments have ended: masks that go to the host, and their indices that come back.

    What is launched on a GPU between ``begin`` and ``ids`` runs while the host waits and works out the indices.

    Args:
        count: the length of a mask, N.
        device: where the masks are.
    """

    def __init__(self, count: int, device: torch.device) -> None:
        self._device, on_gpu = device, device.type == "cuda"
        with torch.inference_mode(False):
            self._masks = torch.zeros(3, count, dtype=torch.bool, device="cpu", pin_memory=on_gpu)
            self._ids = torch.empty(4, count if on_gpu else 0, dtype=torch.long, device="cpu", pin_memory=on_gpu)
            self._none = torch.zeros(0, dtype=torch.long, device=device)
        self._seen, self._found = self._masks.numpy(), self._ids.numpy()  # NumPy asks in a tenth of torch's time
        self._events = [torch.cuda.Event(), torch.cuda.Event()] if on_gpu else []
        self._is_late = False

    def begin(self, outer: torch.Tensor, inner: torch.Tensor) -> None:
        """Let a mask (N,) go to the host, and another that holds nowhere else."""
        self._masks[0].copy_(outer, non_blocking=True)
        self._masks[1].copy_(inner, non_blocking=True)
        self._record(0)

    def ids(self, also: torch.Tensor, at_once: bool) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the indices at which each mask holds, or ``also`` (N,) does; they are on the device by then.

        Args:
            also: a third mask, which is known later.
            at_once: whether it is waited for; else ``late`` tells where it holds.
        """
        self._masks[2].copy_(also, non_blocking=True)
        self._record(1)
        self._wait_for(int(at_once))
        outer, inner, later = self._seen
        if at_once:
            outer, inner = outer | later, inner | later
        self._is_late = not at_once
        return self._brought(outer, 0), self._brought(inner, 1)

    def late(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Return where the third mask holds and the second does not, and where alone it holds: what ``ids`` left."""
        if not self._is_late:
            return self._none, self._none
        self._wait_for(1)
        outer, inner, later = self._seen
        return self._brought(later & ~inner, 2), self._brought(later & ~outer, 3)

    def _record(self, index: int) -> None:
        if self._events:
            self._events[index].record(torch.cuda.current_stream(self._device))

    def _wait_for(self, index: int) -> None:
        if self._events:
            self._events[index].synchronize()

    def _brought(self, mask: np.ndarray[Any, Any], row: int) -> torch.Tensor:
        (found,) = mask.nonzero()
        count = len(found)
        if not count:
            return self._none
        if not self._events:
            return torch.from_numpy(found)
        self._found[row, :count] = found
        return self._ids[row, :count].to(self._device, non_blocking=True)


def is_finite(total: torch.Tensor) -> bool:
    """Return whether a number (a tensor of one) is finite.

    A GPU is not waited for: there a number that is none is noticed some checks later, and from then on every check
    waits, until ``_PATIENCE`` of them have found none.
    """
    if not total.is_cuda:
        return math.isfinite(float(total))
    watch = _watch(total.device)
    if not torch.cuda.is_current_stream_capturing() and not watch.is_calm():
        return math.isfinite(float(total))
    watch.note(total)  # a graph is not to ask, which would wait
    return True


def note(total: torch.Tensor) -> None:
    """Take note of whether a number (a tensor of one, on a GPU) is finite, for ``is_calm``; a graph can."""
    _watch(total.device).note(total)


def is_calm(device: torch.device) -> bool:
    """Return whether no number that is none has been noted of late, as far as the host knows; of a CPU nothing is."""
    return device.type == "cuda" and _watch(device).is_calm()


def _watch(device: torch.device) -> _FiniteWatch:
    index = torch.cuda.current_device() if device.index is None else device.index
    if index not in _watches:
        _watches[index] = _FiniteWatch(torch.device("cuda", index))
    return _watches[index]


class _FiniteWatch:
    """Takes note of numbers on a GPU that are none, and looks at the note when it has come."""

    def __init__(self, device: torch.device) -> None:
        with torch.inference_mode(False):
            self._sum, self._zero = torch.zeros(2, device=device).unbind()
        self._told = torch.zeros((), device="cpu", pin_memory=True)
        self._checks, self._waits = 0, 0

    def note(self, total: torch.Tensor) -> None:
        """Add what is 0 for a number and NaN for good for what is none, infinity too: one kernel."""
        self._sum.addcmul_(total, self._zero)

    def is_calm(self) -> bool:
        """Return whether nothing was noted; when something was, False for the next ``_PATIENCE`` times."""
        if self._waits == 0 and math.isnan(self._told):
            self._waits = _PATIENCE
            self._sum.zero_()
            self._told.zero_()
        if self._waits > 0:
            self._waits -= 1
            return False
        self._checks += 1
        if self._checks % _EVERY == 0:
            self._told.copy_(self._sum, non_blocking=True)
        return True


_EVERY, _PATIENCE = 16, 256  # checks
_watches: dict[int, _FiniteWatch] = {}  # by the GPU's index
