"""Grounds for the tests of sensors."""

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
    """A roof with its ridge at y = 0, whose slope grows with x. Only its formula describes it."""

    def add_to(self, spec: mujoco.MjSpec) -> None:
        spec.worldbody.add_geom(name="ground", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 0.1], pos=[0, 0, -9])

    def height_at(self, xy: torch.Tensor) -> torch.Tensor:
        return -0.3 * xy[..., 1].abs() * (1.0 + 0.5 * xy[..., 0].sin())


STEP = {
    "_target_": "managers.spies.Step",  # a box from x = 4 to 6, y = -1 to 1
    "height": 0.25,
    "static_friction": 0.5,
    "dynamic_friction": 0.5,
    "restitution": 0.0,
}
