"""Heights above the ground."""

from __future__ import annotations

import torch

from wheelleg_exp.managers import Env


def height_over_ground(env: Env, positions: torch.Tensor) -> torch.Tensor:
    """Return how far places of the world (N, ..., 3) are above the ground straight below them, m, (N, ...)."""
    height: torch.Tensor = positions[..., 2] - env.scene.terrain.height_at(positions[..., :2])
    return height
