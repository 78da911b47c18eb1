"""Indices as callers give them."""

from __future__ import annotations

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
