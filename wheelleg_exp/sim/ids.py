"""What a step asks the host: which environments, and whether a number is one."""

from __future__ import annotations

import math

import torch


def ids_where(mask: torch.Tensor) -> torch.Tensor:
    """Return the indices at which a mask (N,) holds, (n,).

    How many there are is known to the host, which on a GPU waits for it; whatever else a step decides, it decides in
    whole tensors.
    """
    return mask.nonzero().squeeze(1)


def is_finite(total: torch.Tensor) -> bool:
    """Return whether a number (a tensor of one) is finite."""
    return math.isfinite(float(total))
