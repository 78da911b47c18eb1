"""Indices of environments, joints, and bodies in the forms that callers pass: tensor, list, slice, or None for all."""

from __future__ import annotations

from collections.abc import Sequence

import torch

Columns = torch.Tensor | Sequence[int] | slice | None
EnvIds = torch.Tensor | Sequence[int] | slice | None
_ALL = slice(None)


def ids_where(mask: torch.Tensor) -> torch.Tensor:
    """Return the indices (n,) at which a mask (N,) is True.

    On a GPU the host waits for the count n. Other decisions within a step use whole tensors and do not wait.
    """
    return mask.nonzero().squeeze(1)


def chosen(ids: Columns, everything: torch.Tensor) -> torch.Tensor:
    """Return a caller's indices as a tensor (n,).

    Args:
        ids: the indices; None means all.
        everything: all indices, (N,).
    """
    if ids is None:
        return everything
    if isinstance(ids, torch.Tensor):
        return ids
    return everything[ids] if isinstance(ids, slice) else torch.tensor(list(ids), device=everything.device)


def not_finite(values: torch.Tensor) -> torch.Tensor:
    """Return where values are NaN or inf: there, and only there, ``x - x`` is NaN."""
    return values - values != 0.0


def picked(values: torch.Tensor, ids: torch.Tensor | Sequence[int] | slice) -> torch.Tensor:
    """Return columns (N, k, ...) of values (N, K, ...), as ``values[:, ids]`` does, but several times as fast."""
    if isinstance(ids, torch.Tensor) and ids.dtype is torch.int64:  # not a mask
        return values.index_select(1, ids)
    return values if isinstance(ids, slice) and ids == _ALL else values[:, ids]


def fill_rows(values: torch.Tensor, ids: EnvIds, number: float) -> None:
    """Set rows of values (N, ...) to a number.

    ``values[ids] = number`` would copy the number from the host, which a CUDA graph cannot do.
    """
    if isinstance(ids, torch.Tensor) and ids.dtype is torch.int64:
        values.index_fill_(0, ids, number)
    else:
        values[ids] = number


def columns(ids: Columns, device: torch.device) -> torch.Tensor | slice:
    """Return a caller's indices as a tensor or slice for one dimension; None means all."""
    if ids is None:
        return slice(None)
    return ids if isinstance(ids, (torch.Tensor, slice)) else torch.tensor(list(ids), device=device)


def narrowed(indices: Sequence[int], device: torch.device | None) -> torch.Tensor | slice:
    """Return indices of columns in the form that is fastest to read: a slice if they are consecutive."""
    first = indices[0] if indices else 0
    if list(indices) == list(range(first, first + len(indices))):
        return slice(first, first + len(indices))
    return torch.tensor(indices, dtype=torch.long, device=device)
