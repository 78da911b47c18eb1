"""Actuator models: what turns joint targets into MuJoCo controls, before each physics step."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import mujoco
import torch

from wheelleg_exp.errors import ConfigError
from wheelleg_exp.sim.names import match_names, values_by_name
from wheelleg_exp.sim.state import Stateful

if TYPE_CHECKING:
    from wheelleg_exp.sim.data import RobotData

PerJoint = float | Mapping[str, float]


class ActuatorBase(Stateful):
    """A group of joints driven by one model. What a model remembers are its attributes (``sim.state``).

    Each number is a scalar or a mapping of joint expressions to values.

    Args:
        joint_names_expr: expressions of the joints in the group.
        stiffness: kp, N·m/rad.
        damping: kd, N·m·s/rad.
        effort_limit: largest torque, N·m.
        velocity_limit: largest joint speed, rad/s. MuJoCo cannot limit a joint's speed: velocity targets are
            clipped to it, and joints beyond it are reported.
        armature: reflected rotor inertia, kg·m^2; null keeps the asset's.
    """

    settings = ("joint_ids", "stiffness", "damping", "effort_limit", "velocity_limit")

    def __init__(
        self,
        joint_names_expr: Sequence[str],
        stiffness: PerJoint,
        damping: PerJoint,
        effort_limit: PerJoint,
        velocity_limit: PerJoint,
        armature: PerJoint | None = None,
    ) -> None:
        self.joint_names_expr = list(joint_names_expr)
        self._config: dict[str, Any] = {
            "stiffness": stiffness,
            "damping": damping,
            "effort_limit": effort_limit,
            "velocity_limit": velocity_limit,
            "armature": armature,
        }

    def resolve(self, joint_names: Sequence[str], key: str) -> None:
        """Find the group's joints among ``joint_names`` and spread each number over them.

        Raises:
            ConfigError: an expression matches nothing, or a gain is negative.
        """
        indices, self.joint_names = match_names(
            self.joint_names_expr, joint_names, key=f"{key}.joint_names_expr", what="joint"
        )
        self.joint_ids = torch.tensor(indices)
        per_joint: dict[str, list[Any]] = {}
        for name, values in self._config.items():
            spread = values_by_name(values, self.joint_names, None, key=f"{key}.{name}", what="joint")
            missing = [j for j, v in zip(self.joint_names, spread, strict=True) if v is None]
            if missing and name != "armature":
                raise ConfigError(f"no value for joint '{missing[0]}'", key=f"{key}.{name}", expected="a value a joint")
            if any(v is not None and v < 0 for v in spread):
                raise ConfigError("must not be negative", key=f"{key}.{name}", expected="a number >= 0")
            per_joint[name] = spread
        self.stiffness, self.damping, self.effort_limit, self.velocity_limit = (
            torch.tensor(per_joint[name], dtype=torch.float32)
            for name in ("stiffness", "damping", "effort_limit", "velocity_limit")
        )
        self._per_joint = per_joint

    def add_to(self, spec: mujoco.MjSpec) -> None:
        """Write the group's armatures into the spec and add one MuJoCo actuator a joint, named after it."""
        for index, name in enumerate(self.joint_names):
            armature = self._per_joint["armature"][index]
            if armature is not None:
                spec.joint(name).armature = armature
            actuator = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
            self._shape(actuator, index)

    def _shape(self, actuator: Any, index: int) -> None:
        raise NotImplementedError

    def control(self, data: RobotData) -> torch.Tensor:
        """Return the MuJoCo controls (N, joints of the group) for the present targets and state."""
        raise NotImplementedError

    def computed_torque(self, data: RobotData, joint_pos: torch.Tensor, joint_vel: torch.Tensor) -> torch.Tensor:
        """Return kp (q* - q) + kd (qd* - qd) + tau_ff, N·m, unclipped, for a given state (N, joints)."""
        ids = self.joint_ids
        return (
            self.stiffness * (data.joint_pos_target[:, ids] - joint_pos)
            + self.damping * (data.joint_vel_target[:, ids] - joint_vel)
            + data.joint_effort_target[:, ids]
        )


class ImplicitActuator(ActuatorBase):
    """PD drive inside the solver: implicit in velocity with ``implicitfast``, as PhysX's joint drive.

    One ``general`` actuator a joint: gain 1, affine bias (0, -kp, -kd), ctrl = kp q* + kd qd* + tau_ff.
    """

    def _shape(self, actuator: Any, index: int) -> None:
        limit = self._per_joint["effort_limit"][index]
        actuator.gaintype = mujoco.mjtGain.mjGAIN_FIXED
        actuator.biastype = mujoco.mjtBias.mjBIAS_AFFINE
        actuator.gainprm[0] = 1.0
        actuator.biasprm[1] = -self._per_joint["stiffness"][index]
        actuator.biasprm[2] = -self._per_joint["damping"][index]
        actuator.forcelimited = True
        actuator.forcerange = (-limit, limit)

    def control(self, data: RobotData) -> torch.Tensor:
        """Return kp q* + kd qd* + tau_ff; the drive subtracts kp q + kd qd itself."""
        ids = self.joint_ids
        control = self.stiffness * data.joint_pos_target[:, ids]
        control += self.damping * data.joint_vel_target[:, ids]
        return control.add_(data.joint_effort_target[:, ids])


class IdealPDActuator(ActuatorBase):
    """Explicit PD: the clipped torque of the state before each physics step, applied as an effort."""

    def _shape(self, actuator: Any, index: int) -> None:
        del index  # the torque is computed and clipped here, not in the engine
        actuator.gaintype = mujoco.mjtGain.mjGAIN_FIXED
        actuator.biastype = mujoco.mjtBias.mjBIAS_NONE
        actuator.gainprm[0] = 1.0

    def control(self, data: RobotData) -> torch.Tensor:
        """Return clip(kp (q* - q) + kd (qd* - qd) + tau_ff, ±effort_limit)."""
        ids = self.joint_ids
        torque = self.computed_torque(data, data.joint_pos[:, ids], data.joint_vel[:, ids])
        return torch.clamp(torque, -self.effort_limit, self.effort_limit)
