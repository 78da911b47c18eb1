"""Indices of environments, joints, and bodies in the forms that callers pass: tensor, list, slice, or None for all."""

from __future__ import annotations

from collections.abc import Sequence

import torch

Ids = torch.Tensor | Sequence[int] | slice | None
_ALL = slice(None)


def ids_where(mask: torch.Tensor) -> torch.Tensor:
    """Return the indices (n,) at which a mask (N,) is True; if the mask is on a GPU, the host waits for the indices."""
    return mask.nonzero().squeeze(1)


def chosen(ids: Ids, everything: torch.Tensor) -> torch.Tensor:
    """Return indices as a tensor (n,); the argument None stands for all indices, which are in ``everything`` (N,)."""
    if ids is None or isinstance(ids, torch.Tensor):
        return everything if ids is None else ids
    return everything[ids] if isinstance(ids, slice) else torch.tensor(list(ids), device=everything.device)


def not_finite(values: torch.Tensor) -> torch.Tensor:
    """Return a mask of the values that are NaN or inf; for all other values x, ``x - x`` is 0."""
    return values - values != 0.0


def picked(values: torch.Tensor, ids: torch.Tensor | Sequence[int] | slice) -> torch.Tensor:
    """Return the columns ``values[:, ids]``, (N, k, ...), several times faster than torch's indexing returns them."""
    if isinstance(ids, torch.Tensor) and ids.dtype is torch.int64:
        return values.index_select(1, ids)
    return values if isinstance(ids, slice) and ids == _ALL else values[:, ids]


def fill_rows(values: torch.Tensor, ids: Ids, number: float) -> None:
    """Set the rows ``ids`` of a tensor (N, ...) to a number; CUDA graphs cannot contain ``values[ids] = number``."""
    if isinstance(ids, torch.Tensor) and ids.dtype is torch.int64:
        values.index_fill_(0, ids, number)
    else:
        values[ids] = number


def columns(ids: Ids, device: torch.device) -> torch.Tensor | slice:
    """Return indices along one dimension of a tensor as a tensor or a slice; None stands for all indices."""
    if ids is None:
        return slice(None)
    return ids if isinstance(ids, (torch.Tensor, slice)) else torch.tensor(list(ids), device=device)


def narrowed(indices: Sequence[int], device: torch.device | None) -> torch.Tensor | slice:
    """Return indices of columns in the form that is fastest to read: a slice if they are consecutive."""
    first = indices[0] if indices else 0
    if list(indices) == list(range(first, first + len(indices))):
        return slice(first, first + len(indices))
    return torch.tensor(indices, dtype=torch.long, device=device)
