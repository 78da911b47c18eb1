"""The states of some environments put together with those of the others."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch


def merged(before: Any, after: Any, rows: torch.Tensor) -> Any:
    """Return a state dict that is ``after`` in some environments' rows and ``before`` in the others'.

    Args:
        before: a state dict, in which tensors (N, ...) have a row an environment.
        after: a later one of the same object; of what has no rows, this is returned.
        rows: environments, (N,) bool.
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
