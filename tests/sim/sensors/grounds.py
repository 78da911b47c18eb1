"""Grounds for the tests of sensors that look at them."""

from __future__ import annotations

import math

import mujoco
import torch

from wheelleg_exp.sim.terrain import TerrainBase


class Slope(TerrainBase):
    """A plane that rises along x."""

    def __init__(self, angle: float) -> None:
        super().__init__(0.5, 0.5, 0.0)
        self._quat = [math.cos(angle / 2), 0.0, -math.sin(angle / 2), 0.0]

    def add_to(self, spec: mujoco.MjSpec) -> None:
        spec.worldbody.add_geom(name="ground", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 0.1], quat=self._quat)


class Roof(TerrainBase):
    """The same to both sides of y = 0: it falls to the sides, and more so where x is greater; a formula alone."""

    def add_to(self, spec: mujoco.MjSpec) -> None:
        spec.worldbody.add_geom(name="ground", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 0.1], pos=[0, 0, -9])

    def height_at(self, xy: torch.Tensor) -> torch.Tensor:
        return -0.3 * xy[..., 1].abs() * (1.0 + 0.5 * xy[..., 0].sin())
