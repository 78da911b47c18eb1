"""A plane: the simplest ground."""

from __future__ import annotations

import mujoco
import torch

from wheelleg_exp.sim.terrain.base import GROUND, TerrainBase


class Plane(TerrainBase):
    """An infinite plane at height 0. Its friction and restitution are those of ``TerrainBase``."""

    def add_to(self, spec: mujoco.MjSpec) -> None:
        """Add the plane to the scene's spec."""
        spec.worldbody.add_geom(
            name=GROUND,
            type=mujoco.mjtGeom.mjGEOM_PLANE,
            size=[0, 0, 0.05],
            friction=[self.dynamic_friction, 0.005, 0.0001],
            rgba=[0.35, 0.38, 0.42, 1],
        )

    def height_at(self, xy: torch.Tensor) -> torch.Tensor:
        """Return zeros (...) for points (..., 2)."""
        return torch.zeros_like(xy[..., 0])
