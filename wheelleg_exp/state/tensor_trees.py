"""Merge two saved states of N environments, and copy tensors to host memory."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch


def merged(before: Any, after: Any, rows: torch.Tensor) -> Any:
    """Merge two state dicts of one object: environments ``rows`` (N,) bool from ``after``, the others from ``before``.

    All values without one row per environment, such as plain numbers, come from the state dict ``after``.
    """
    if isinstance(after, Mapping):
        return {name: merged(before.get(name), item, rows) for name, item in after.items()}
    if isinstance(after, (list, tuple)) and isinstance(before, (list, tuple)) and len(before) == len(after):
        return type(after)(merged(old, new, rows) for old, new in zip(before, after, strict=True))
    if not isinstance(after, torch.Tensor) or not isinstance(before, torch.Tensor):
        return after
    if before.shape != after.shape or after.shape[:1] != rows.shape:
        return after
    return torch.where(rows.view(-1, *[1] * (after.ndim - 1)), after, before)


def host_copy(tensor: torch.Tensor) -> np.ndarray[Any, Any]:
    """Return a copy of a tensor in host memory, which later simulation steps do not change."""
    return tensor.detach().cpu().numpy().copy()
