"""All that Isaac Lab's ``ArticulationData`` has, as far as MuJoCo has it."""

from __future__ import annotations

import torch

from wheelleg_exp.sim.data_bodies import BodyData
from wheelleg_exp.sim.data_joints import JointData
from wheelleg_exp.sim.data_root import RootData


class ArticulationData(BodyData, JointData, RootData):
    """The robot's state and parameters: float32, N environments, joints and bodies in the robot's order.

    ``_w`` is world axes, ``_b`` axes of the link. ``root_``, ``body_`` velocities are of centres of mass unless the
    name says ``link``; poses are of link frames unless the name says ``com``. Quaternions are (w, x, y, z).
    """

    @property
    def device(self) -> torch.device:
        """Where the tensors are."""
        return self._sim.device

    def update(self, dt: float) -> None:
        """Do nothing: what is asked for is worked out of the present state."""
        del dt
