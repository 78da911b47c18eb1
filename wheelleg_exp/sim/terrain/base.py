"""What every ground has: geoms in the scene, a material, and the places where environments begin."""

from __future__ import annotations

import math
from typing import Any

import mujoco
import torch

from wheelleg_exp.constraints import NonNegative, Share
from wheelleg_exp.state import Kept

GROUND = "ground"
GROUND_GROUP = 0  # MuJoCo's geom group that holds the ground and nothing else


class TerrainBase(Kept):
    """The ground (``env.scene.terrain``); one YAML node, from this package or a user's own.

    Restitution has no counterpart in MuJoCo, and one of the two frictions is used (``env.robot.friction_source``).

    Args:
        static_friction: the ground's coefficient at rest.
        dynamic_friction: the ground's coefficient in motion.
        restitution: the ground's coefficient of restitution.
    """

    def __init__(self, static_friction: NonNegative, dynamic_friction: NonNegative, restitution: Share) -> None:
        self.static_friction = static_friction
        self.dynamic_friction = dynamic_friction
        self.restitution = restitution

    def add_to(self, spec: mujoco.MjSpec) -> None:
        """Add the ground's geoms, whose names begin with ``ground``, to the scene's spec."""
        raise NotImplementedError

    def friction(self, source: str) -> float:
        """Return the ``static`` or the ``dynamic`` coefficient."""
        return self.static_friction if source == "static" else self.dynamic_friction

    def origins(self, num_envs: int, spacing: float, device: torch.device) -> torch.Tensor:
        """Return where the environments begin, m, (N, 3): a square grid, unless the ground has its own places."""
        return grid_origins(num_envs, spacing, device)

    def state_dict(self) -> dict[str, Any]:
        """Return what a curriculum has changed; nothing for a ground that stays as it is."""
        return {}

    def load_state_dict(self, saved: dict[str, Any]) -> None:
        """Restore what ``state_dict`` returned."""


def is_ground(name: str) -> bool:
    """Return whether a geom of the scene belongs to the ground."""
    return name == GROUND or name.startswith(f"{GROUND}/")


def grid_origins(num_envs: int, spacing: float, device: torch.device | None = None) -> torch.Tensor:
    """Return the origins (N, 3) of environments on a square grid around the world's origin, row by row.

    Layout as in Isaac Lab: ``rows = ceil(N / floor(sqrt(N)))``, x falls with the row, y grows with the column
    mirrored about the centre.
    """
    rows = math.ceil(num_envs / math.floor(math.sqrt(num_envs)))
    cols = math.ceil(num_envs / rows)
    i, j = torch.meshgrid(torch.arange(rows, device=device), torch.arange(cols, device=device), indexing="ij")
    origins = torch.zeros(num_envs, 3, device=device)
    origins[:, 0] = (-(i.flatten()[:num_envs] - (rows - 1) / 2)) * spacing
    origins[:, 1] = (j.flatten()[:num_envs] - (cols - 1) / 2) * spacing
    return origins
