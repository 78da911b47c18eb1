"""Indices as callers give them, and what a step asks the host: which environments, and whether a number is one."""

from __future__ import annotations

import math
import threading
from collections.abc import Sequence

import torch

Columns = torch.Tensor | Sequence[int] | slice | None
EnvIds = torch.Tensor | Sequence[int] | slice | None
_ALL = slice(None)


def ids_where(mask: torch.Tensor) -> torch.Tensor:
    """Return the indices at which a mask (N,) holds, (n,).

    How many there are is known to the host, which on a GPU waits for it; whatever else a step decides, it decides in
    whole tensors.
    """
    return mask.nonzero().squeeze(1)


def ids_where_also(mask: torch.Tensor, within: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the indices at which a mask (N,) holds, and those at which another does that holds nowhere else.

    The host waits for a GPU once.
    """
    if not mask.is_cuda:
        found = ids_where(mask)
        return found, ids_where(within) if len(found) else found
    key = mask.device, len(mask), torch.cuda.current_stream(mask.device).cuda_stream, threading.get_ident()
    if key not in _readers:
        _readers[key] = _Reader(len(mask), mask.device)
    return _readers[key].ids(mask, within)


class _Reader:
    """Brings masks to the host and their indices back by memory that a GPU reaches by itself.

    Args:
        count: the length of a mask, N.
        device: the GPU.
    """

    def __init__(self, count: int, device: torch.device) -> None:
        self._device = device
        with torch.inference_mode(False):
            self._masks = torch.empty(2, count, dtype=torch.bool, device="cpu", pin_memory=True)
            self._ids = torch.empty(2, count, dtype=torch.long, device="cpu", pin_memory=True)

    def ids(self, outer: torch.Tensor, inner: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the indices at which each of two masks holds. The last call's are on the device by then."""
        self._masks[0].copy_(outer, non_blocking=True)
        self._masks[1].copy_(inner, non_blocking=True)
        torch.cuda.current_stream(self._device).synchronize()
        return self._brought(self._masks[0], self._ids[0]), self._brought(self._masks[1], self._ids[1])

    def _brought(self, mask: torch.Tensor, into: torch.Tensor) -> torch.Tensor:
        found = ids_where(mask)
        return into[: len(found)].copy_(found).to(self._device, non_blocking=True)


_readers: dict[tuple[torch.device, int, int, int], _Reader] = {}  # also by stream and thread


def is_finite(total: torch.Tensor) -> bool:
    """Return whether a number (a tensor of one) is finite.

    A GPU is not waited for: there a number that is none is noticed some checks later, and from then on every check
    waits, until ``_PATIENCE`` of them have found none.
    """
    if not total.is_cuda:
        return math.isfinite(float(total))
    if total.device not in _watches:
        _watches[total.device] = _Watch(total.device)
    return _watches[total.device].is_finite(total)


class _Watch:
    """Takes note of numbers on a GPU that are none, and looks at the note when it has come."""

    def __init__(self, device: torch.device) -> None:
        with torch.inference_mode(False):
            self._found = torch.zeros((), dtype=torch.bool, device=device)
        self._told = torch.zeros((), dtype=torch.bool, device="cpu", pin_memory=True)
        self._checks, self._waits = 0, 0

    def is_finite(self, total: torch.Tensor) -> bool:
        if self._waits == 0 and self._told:
            self._waits = _PATIENCE
            self._found.zero_()
            self._told.zero_()
        if self._waits > 0:
            self._waits -= 1
            return math.isfinite(float(total))
        self._found |= ~total.isfinite()
        self._checks += 1
        if self._checks % _EVERY == 0:
            self._told.copy_(self._found, non_blocking=True)
        return True


_EVERY, _PATIENCE = 16, 256  # checks
_watches: dict[torch.device, _Watch] = {}


def chosen(ids: Columns, everything: torch.Tensor) -> torch.Tensor:
    """Return indices that a caller gave, as a tensor (n,): None is all, slices and lists are as well taken.

    Args:
        ids: the indices.
        everything: all there are, (N,).
    """
    if ids is None:
        return everything
    if isinstance(ids, torch.Tensor):
        return ids
    return everything[ids] if isinstance(ids, slice) else torch.tensor(list(ids), device=everything.device)


def not_finite(values: torch.Tensor) -> torch.Tensor:
    """Return where numbers are not finite: their difference from themselves is none then."""
    return values - values != 0.0


def picked(values: torch.Tensor, ids: torch.Tensor | Sequence[int] | slice) -> torch.Tensor:
    """Return some columns (N, k, ...) of values (N, K, ...): what ``values[:, ids]`` is, several times as fast."""
    if isinstance(ids, torch.Tensor) and ids.dtype is torch.int64:  # no mask
        return values.index_select(1, ids)
    return values if isinstance(ids, slice) and ids == _ALL else values[:, ids]


def fill_rows(values: torch.Tensor, ids: EnvIds, number: float) -> None:
    """Set rows of values (N, ...) to a number. ``values[ids] = number`` copies it from the host: no CUDA graph can."""
    if isinstance(ids, torch.Tensor) and ids.dtype is torch.int64:
        values.index_fill_(0, ids, number)
    else:
        values[ids] = number


def columns(ids: Columns, device: torch.device) -> torch.Tensor | slice:
    """Return what indexes a dimension by itself: None is all."""
    if ids is None:
        return slice(None)
    return ids if isinstance(ids, (torch.Tensor, slice)) else torch.tensor(list(ids), device=device)


def narrowed(indices: Sequence[int], device: torch.device | None) -> torch.Tensor | slice:
    """Return indices of columns in the form that is read fastest: a slice where they follow one another."""
    first = indices[0] if indices else 0
    if list(indices) == list(range(first, first + len(indices))):
        return slice(first, first + len(indices))
    return torch.tensor(indices, dtype=torch.long, device=device)
