"""What a step asks of a device: which environments, and whether a number is one. A GPU is waited for late, or never."""

from __future__ import annotations

import math
import threading
from typing import Any

import numpy as np
import torch

from wheelleg_exp.sim.ids import ids_where


class Asked:
    """The indices at which masks hold, which are known at once.

    Args:
        outer: a mask, (N,).
        inner: another, which holds nowhere else, (N,).
    """

    def __init__(self, outer: torch.Tensor, inner: torch.Tensor) -> None:
        self._outer, self._inner = outer, inner

    def ids(self, also: torch.Tensor, at_once: bool) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the indices at which each mask holds, or ``also`` (N,) does.

        Args:
            also: a mask that has been asked for later.
            at_once: whether it is waited for; else ``late`` tells where it holds.
        """
        del at_once
        found = ids_where(self._outer | also)
        return found, ids_where(self._inner | also) if len(found) else found

    def late(self) -> torch.Tensor:
        """Return the indices at which ``also`` of the last call holds, unless that call has told them."""
        return self._outer.new_zeros(0, dtype=torch.long)


class _AskedOfGpu(Asked):
    """Brings masks to the host and their indices back by memory that a GPU reaches by itself.

    What is launched between ``begin`` and ``ids`` runs while the host waits for the masks and works out the indices.

    Args:
        count: the length of a mask, N.
        device: the GPU.
    """

    def __init__(self, count: int, device: torch.device) -> None:
        self._device = device
        with torch.inference_mode(False):
            self._masks = torch.zeros(3, count, dtype=torch.bool, device="cpu", pin_memory=True)
            self._ids = torch.empty(3, count, dtype=torch.long, device="cpu", pin_memory=True)
            self._seen, self._found = self._masks.numpy(), self._ids.numpy()  # NumPy asks in a tenth of torch's time
            self._none = torch.zeros(0, dtype=torch.long, device=device)
        self._events = torch.cuda.Event(), torch.cuda.Event()
        self._waited = True

    def begin(self, outer: torch.Tensor, inner: torch.Tensor) -> Asked:
        """Let two masks go to the host."""
        self._masks[0].copy_(outer, non_blocking=True)
        self._masks[1].copy_(inner, non_blocking=True)
        self._events[0].record(torch.cuda.current_stream(self._device))
        return self

    def ids(self, also: torch.Tensor, at_once: bool) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the indices; those of the last call are on the device by then."""
        self._masks[2].copy_(also, non_blocking=True)
        self._events[1].record(torch.cuda.current_stream(self._device))
        self._events[at_once].synchronize()
        self._waited = at_once
        outer, inner, later = self._seen
        if at_once:
            outer, inner = outer | later, inner | later
        return self._brought(outer, 0), self._brought(inner, 1)

    def late(self) -> torch.Tensor:
        """Return the indices that ``ids`` has not waited for."""
        if self._waited:
            return self._none
        self._events[1].synchronize()
        return self._brought(self._seen[2], 2)

    def _brought(self, mask: np.ndarray[Any, Any], row: int) -> torch.Tensor:
        (found,) = mask.nonzero()
        count = len(found)
        if not count:
            return self._none
        self._found[row, :count] = found
        return self._ids[row, :count].to(self._device, non_blocking=True)


def ask(outer: torch.Tensor, inner: torch.Tensor) -> Asked:
    """Ask where a mask (N,) holds, and where another does that holds nowhere else; a GPU goes on meanwhile."""
    if not outer.is_cuda:
        return Asked(outer, inner)
    key = outer.device, len(outer), torch.cuda.current_stream(outer.device).cuda_stream, threading.get_ident()
    if key not in _readers:
        _readers[key] = _AskedOfGpu(len(outer), outer.device)
    return _readers[key].begin(outer, inner)


_readers: dict[tuple[torch.device, int, int, int], _AskedOfGpu] = {}  # also by stream and thread


def is_finite(total: torch.Tensor) -> bool:
    """Return whether a number (a tensor of one) is finite.

    A GPU is not waited for: there a number that is none is noticed some checks later, and from then on every check
    waits, until ``_PATIENCE`` of them have found none.
    """
    if not total.is_cuda:
        return math.isfinite(float(total))
    watch = _watch(total.device)
    if not watch.is_calm():
        return math.isfinite(float(total))
    watch.note(total)
    return True


def note(total: torch.Tensor) -> None:
    """Take note of whether a number (a tensor of one, on a GPU) is finite, for ``is_calm``; a graph can."""
    _watch(total.device).note(total)


def is_calm(device: torch.device) -> bool:
    """Return whether no number that is none has been noted of late, as far as the host knows; of a CPU nothing is."""
    return device.type == "cuda" and _watch(device).is_calm()


def _watch(device: torch.device) -> _Watch:
    index = torch.cuda.current_device() if device.index is None else device.index
    if index not in _watches:
        _watches[index] = _Watch(torch.device("cuda", index))
    return _watches[index]


class _Watch:
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
_watches: dict[int, _Watch] = {}  # by the GPU's index
