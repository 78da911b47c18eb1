import mujoco
import torch

from wheelleg_exp.sim.terrain import TerrainBase


class Roof(TerrainBase):
    """A roof-shaped ground, given by a formula, with its ridge at y = 0 and a slope that increases with x."""

    def add_to(self, spec: mujoco.MjSpec) -> None:
        spec.worldbody.add_geom(name="ground", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 0.1], pos=[0, 0, -9])

    def height_at(self, xy: torch.Tensor) -> torch.Tensor:
        return -0.3 * xy[..., 1].abs() * (1.0 + 0.5 * xy[..., 0].sin())


# The box extends from x = 4 m to 6 m and from y = -1 m to 1 m.
STEP = {"_target_": "managers.spies.Step", "height": 0.25, "static_friction": 0.5, "dynamic_friction": 0.5}
STEP["restitution"] = 0.0
