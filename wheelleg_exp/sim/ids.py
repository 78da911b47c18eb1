"""Which environments: the one question that a step asks the host."""

from __future__ import annotations

import torch


def ids_where(mask: torch.Tensor) -> torch.Tensor:
    """Return the indices at which a mask (N,) holds, (n,).

    How many there are is known to the host, which on a GPU waits for it; whatever else a step decides, it decides in
    whole tensors.
    """
    return mask.nonzero().squeeze(1)
