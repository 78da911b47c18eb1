"""The door out: what others read of the environment, in the host's memory and theirs to keep."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch


def host_copy(tensor: torch.Tensor) -> np.ndarray[Any, Any]:
    """Return a copy of a tensor in the host's memory, whatever device it is on; later steps do not change it."""
    return tensor.detach().cpu().numpy().copy()
