"""Ask a device for masks and for finite numbers, without waiting for the answer at once."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch


class AsyncMaskQuery:
    """Find the environments whose episode ended: masks go to the host, and indices come back.

    The GPU continues to work while the host waits for the masks: ``start`` starts the copies, ``ids`` waits for them. A
    third mask is known later than the first two. On a GPU ``ids`` does not wait for the third mask unless the
    caller needs it at once; ``late`` then returns the remaining environments.

    Args:
        count: the length of a mask, N.
        device: where the masks are.

    Attributes:
        answers_late: whether ``late`` may answer for the third mask. On a CPU this would save nothing.
    """

    def __init__(self, count: int, device: torch.device) -> None:
        self._device, on_gpu = device, device.type == "cuda"
        self.answers_late = on_gpu
        with torch.inference_mode(False):
            self._masks = torch.zeros(3, count, dtype=torch.bool, device="cpu", pin_memory=on_gpu)
            self._ids = torch.empty(4, count if on_gpu else 0, dtype=torch.long, device="cpu", pin_memory=on_gpu)
            self._none = torch.zeros(0, dtype=torch.long, device=device)
        # NumPy finds the indices in a tenth of torch's time.
        self._host_masks, self._host_ids = self._masks.numpy(), self._ids.numpy()
        self._copied = [torch.cuda.Event(), torch.cuda.Event()] if on_gpu else []
        self._has_late = False

    def start(self, ended: torch.Tensor, failed: torch.Tensor) -> None:
        """Start to copy two masks (N,) to the host. ``failed`` is a subset of ``ended``."""
        self._masks[0].copy_(ended, non_blocking=True)
        self._masks[1].copy_(failed, non_blocking=True)
        self._record(0)

    def ids(self, also_failed: torch.Tensor, *, at_once: bool) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the indices of the environments that ended, and of those that failed.

        Args:
            also_failed: further environments (N,) that failed.
            at_once: whether the caller needs the indices of these now; otherwise ``late`` may return them.
        """
        self._masks[2].copy_(also_failed, non_blocking=True)
        self._record(1)
        self._has_late = self.answers_late and not at_once
        self._wait(0 if self._has_late else 1)
        ended, failed, also = self._host_masks
        if not self._has_late:
            ended, failed = ended | also, failed | also
        return self._to_device(ended, 0), self._to_device(failed, 1)

    def late(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the environments of ``also_failed`` that ``ids`` left out: not in ``failed``, and not in ``ended``."""
        if not self._has_late:
            return self._none, self._none
        self._wait(1)
        ended, failed, also = self._host_masks
        return self._to_device(also & ~failed, 2), self._to_device(also & ~ended, 3)

    def _record(self, index: int) -> None:
        if self._copied:
            self._copied[index].record(torch.cuda.current_stream(self._device))

    def _wait(self, index: int) -> None:
        if self._copied:
            self._copied[index].synchronize()

    def _to_device(self, mask: np.ndarray[Any, Any], row: int) -> torch.Tensor:
        (found,) = mask.nonzero()
        if not len(found):
            return self._none
        if not self._copied:
            return torch.from_numpy(found)
        self._host_ids[row, : len(found)] = found
        return self._ids[row, : len(found)].to(self._device, non_blocking=True)


def is_finite(total: torch.Tensor) -> bool:
    """Return whether a number (a tensor with one element) is finite.

    The host does not wait for a GPU: it learns of a NaN or inf some checks later. From then on every check waits, until
    ``_PATIENCE`` checks in a row were finite.
    """
    if not total.is_cuda:
        return math.isfinite(float(total))
    watch = _watch(total.device)
    if not torch.cuda.is_current_stream_capturing() and not watch.is_calm():
        return math.isfinite(float(total))
    watch.note(total)  # a CUDA graph cannot wait for the answer
    return True


def note(total: torch.Tensor) -> None:
    """Add a number (a tensor with one element on a GPU) to the numbers that ``is_calm`` reports on."""
    _watch(total.device).note(total)


def is_calm(device: torch.device) -> bool:
    """Return whether the host knows of no recent NaN or inf on a GPU. On a CPU the answer is always False."""
    return device.type == "cuda" and _watch(device).is_calm()


def _watch(device: torch.device) -> _FiniteWatch:
    index = torch.cuda.current_device() if device.index is None else device.index
    if index not in _watches:
        _watches[index] = _FiniteWatch(torch.device("cuda", index))
    return _watches[index]


class _FiniteWatch:
    """Detects NaN and inf on a GPU. The host reads the answer when a copy of it has arrived."""

    def __init__(self, device: torch.device) -> None:
        with torch.inference_mode(False):
            self._sum, self._zero = torch.zeros(2, device=device).unbind()
        self._host_sum = torch.zeros((), device="cpu", pin_memory=True)
        self._checks, self._waits = 0, 0

    def note(self, total: torch.Tensor) -> None:
        """Add ``total * 0`` to a running sum: 0 while all numbers are finite, NaN once one is NaN or inf."""
        self._sum.addcmul_(total, self._zero)  # one kernel

    def is_calm(self) -> bool:
        """Return whether all numbers were finite; after a NaN or inf, False for ``_PATIENCE`` calls."""
        if self._waits == 0 and math.isnan(self._host_sum):
            self._waits = _PATIENCE
            self._sum.zero_()
            self._host_sum.zero_()
        if self._waits > 0:
            self._waits -= 1
            return False
        self._checks += 1
        if self._checks % _EVERY == 0:
            self._host_sum.copy_(self._sum, non_blocking=True)
        return True


_EVERY, _PATIENCE = 16, 256  # checks
_watches: dict[int, _FiniteWatch] = {}  # by the index of the GPU
