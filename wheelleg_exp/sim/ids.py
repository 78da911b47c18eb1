"""Indices as callers give them, and what a step asks the host: which environments, and whether a number is one."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch

Columns = torch.Tensor | Sequence[int] | slice | None
EnvIds = torch.Tensor | Sequence[int] | slice | None


def ids_where(mask: torch.Tensor) -> torch.Tensor:
    """Return the indices at which a mask (N,) holds, (n,).

    How many there are is known to the host, which on a GPU waits for it; whatever else a step decides, it decides in
    whole tensors.
    """
    return mask.nonzero().squeeze(1)


def is_finite(total: torch.Tensor) -> bool:
    """Return whether a number (a tensor of one) is finite."""
    return math.isfinite(float(total))


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
