"""PD drives: in the solver, and computed before each physics step."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import mujoco
import torch

from wheelleg_exp.sim.actuators.base import ActuatorBase, Stream
from wheelleg_exp.sim.layout import JointTargets

if TYPE_CHECKING:
    from wheelleg_exp.sim.data import RobotData


class ImplicitActuator(ActuatorBase):
    """PD drive inside the solver: implicit in velocity with ``implicitfast``, as PhysX's joint drive.

    One ``general`` actuator a joint: gain 1, affine bias (0, -kp, -kd), ctrl = kp q* + kd qd* + tau_ff.
    """

    reads_state = False

    def _shape(self, actuator: Any, index: int) -> None:
        limit = self._per_joint["effort_limit"][index]
        actuator.gaintype = mujoco.mjtGain.mjGAIN_FIXED
        actuator.biastype = mujoco.mjtBias.mjBIAS_AFFINE
        actuator.gainprm[0] = 1.0
        actuator.biasprm[1] = -self._per_joint["stiffness"][index]
        actuator.biasprm[2] = -self._per_joint["damping"][index]
        actuator.forcelimited = True
        actuator.forcerange = (-limit, limit)

    def control(self, targets: JointTargets, data: RobotData) -> torch.Tensor:
        """Return kp q* + kd qd* + tau_ff; the drive subtracts kp q + kd qd itself."""
        del data
        ids = self._columns
        control = self.stiffness * targets.pos[:, ids]
        control += self.damping * targets.vel[:, ids]
        return control.add_(targets.effort[:, ids])

    def computed_torque(self, targets: JointTargets, data: RobotData) -> torch.Tensor:
        """Return the drive's torque, which follows from the targets and the state before the step."""
        return self._drive(targets, data.joint_pos_before, data.joint_vel_before)


class IdealPDActuator(ActuatorBase):
    """Explicit PD: the clipped torque of the state before each physics step, applied as an effort."""

    def _shape(self, actuator: Any, index: int) -> None:
        del index  # the torque is computed and clipped here, not in the engine
        actuator.gaintype = mujoco.mjtGain.mjGAIN_FIXED
        actuator.biastype = mujoco.mjtBias.mjBIAS_NONE
        actuator.gainprm[0] = 1.0

    def connect(self, num_envs: int, dt: float, stream: Stream) -> None:
        """Allocate the computed torque."""
        super().connect(num_envs, dt, stream)
        self._computed = torch.zeros(num_envs, len(self.joint_names), device=self.joint_ids.device)

    def control(self, targets: JointTargets, data: RobotData) -> torch.Tensor:
        """Return the torque that is asked for, clipped."""
        self._computed = self._torque(targets, data)
        return self._clipped(self._computed, data)

    def _torque(self, targets: JointTargets, data: RobotData) -> torch.Tensor:
        """Return kp (q* - q) + kd (qd* - qd) + tau_ff, N·m."""
        return self._drive(targets, data.joint_pos, data.joint_vel)

    def _clipped(self, torque: torch.Tensor, data: RobotData) -> torch.Tensor:
        """Return clip(torque, ±effort_limit)."""
        del data
        return torch.clamp(torque, -self.effort_limit, self.effort_limit)

    def computed_torque(self, targets: JointTargets, data: RobotData) -> torch.Tensor:
        """Return the torque as it was computed before the step."""
        del targets, data
        return self._computed
