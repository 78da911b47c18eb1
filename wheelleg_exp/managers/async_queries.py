"""Copy masks and the results of checks for NaN and inf from a GPU to the host asynchronously."""

from __future__ import annotations

import math

import numpy as np
import torch
from numpy.typing import NDArray


class AsyncMaskQuery:
    """Converts GPU masks (N,) of ended and failed environments to indices, with asynchronous copies to the host.

    In each control step, callers must call ``start``, then ``ids``, then ``late``.
    """

    def __init__(self, count: int, device: torch.device) -> None:
        self._device, on_gpu = device, device.type == "cuda"
        self.answers_late = on_gpu  # whether ``ids`` can omit failed environments, which ``late`` returns
        with torch.inference_mode(False):
            self._masks = torch.zeros(3, count, dtype=torch.bool, device="cpu", pin_memory=on_gpu)
            self._ids = torch.empty(4, count if on_gpu else 0, dtype=torch.long, device="cpu", pin_memory=on_gpu)
            self._none = torch.zeros(0, dtype=torch.long, device=device)
        # NumPy finds the true elements of a small mask ten times as fast as torch does.
        self._host_masks, self._host_ids = self._masks.numpy(), self._ids.numpy()
        self._copied = [torch.cuda.Event(), torch.cuda.Event()] if on_gpu else []
        self._has_late = False

    def start(self, ended: torch.Tensor, failed: torch.Tensor) -> None:
        """Start to copy the masks ``ended`` and ``failed`` (N,) to the host; each failed environment is also ended."""
        self._masks[0].copy_(ended, non_blocking=True)
        self._masks[1].copy_(failed, non_blocking=True)
        self._record(0)

    def ids(self, also_failed: torch.Tensor, *, at_once: bool) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the indices of the environments whose episode ended, and of the environments that failed.

        ``also_failed`` (N,) marks further failed environments. On a GPU without ``at_once``, only ``late`` returns
        them.
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
        """Return two index tensors of the failed environments that ``ids`` omitted: all, and those not in ``ended``."""
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

    def _to_device(self, mask: NDArray[np.bool_], row: int) -> torch.Tensor:
        (found,) = mask.nonzero()
        if not len(found):
            return self._none
        if not self._copied:
            return torch.from_numpy(found)
        self._host_ids[row, : len(found)] = found
        return self._ids[row, : len(found)].to(self._device, non_blocking=True)


def is_finite(total: torch.Tensor) -> bool:
    """Return whether a number (a tensor with one element) is finite.

    On a GPU, it usually returns True without waiting. After NaN or inf, the next 256 calls wait and are exact.
    """
    if not total.is_cuda:
        return math.isfinite(float(total))
    watch = finite_watch(total.device)
    if not torch.cuda.is_current_stream_capturing() and not watch.is_calm():
        return math.isfinite(float(total))
    watch.note(total)
    return True


def finite_watch(device: torch.device) -> FiniteWatch:
    """Return the object that detects NaN and inf in tensors on a GPU; each GPU has one."""
    index = torch.cuda.current_device() if device.index is None else device.index
    if index not in _watches:
        _watches[index] = FiniteWatch(torch.device("cuda", index))
    return _watches[index]


class FiniteWatch:
    """Detects NaN and inf in GPU tensors without waiting for the GPU."""

    def __init__(self, device: torch.device) -> None:
        with torch.inference_mode(False):
            self._sum, self._zero = torch.zeros(2, device=device).unbind()
        self._host_sum = torch.zeros((), device="cpu", pin_memory=True)
        self._checks, self._waits = 0, 0

    def note(self, total: torch.Tensor) -> None:
        """Add ``total * 0`` to a sum on the GPU: NaN if ``total`` is NaN or inf, otherwise 0."""
        self._sum.addcmul_(total, self._zero)  # a single kernel

    def is_calm(self) -> bool:
        """Return False in the first ``_PATIENCE`` calls after NaN or inf was found on the GPU, otherwise True."""
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
_watches: dict[int, FiniteWatch] = {}  # by GPU index
