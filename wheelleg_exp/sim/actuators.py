"""Actuator models: what turns joint targets into MuJoCo controls, before each physics step."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Annotated, Any

import mujoco
import torch

from wheelleg_exp.constraints import Above, MayBeInfinite, Names, NonNegative
from wheelleg_exp.sim.layout import JointTargets
from wheelleg_exp.sim.names import match_names, valueless_errors, values_by_name
from wheelleg_exp.state import Stateful

if TYPE_CHECKING:
    from wheelleg_exp.sim.data import RobotData

PerJoint = NonNegative | Mapping[str, NonNegative]
NEEDED = ("stiffness", "damping", "effort_limit", "velocity_limit")  # of every joint of a group
ONE_GROUP = "each joint in one actuator group"
Limit = Annotated[float, Above(0), MayBeInfinite()]
LimitPerJoint = Limit | Mapping[str, Limit]
Stream = Callable[[], torch.Generator]


class ActuatorBase(Stateful):
    """A group of joints driven by one model. What a model remembers are its attributes (``state``).

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
        joint_names_expr: Names,
        stiffness: PerJoint,
        damping: PerJoint,
        effort_limit: LimitPerJoint,
        velocity_limit: LimitPerJoint,
        armature: PerJoint | None = None,
    ) -> None:
        self.joint_names_expr = [joint_names_expr] if isinstance(joint_names_expr, str) else list(joint_names_expr)
        self._config: dict[str, Any] = {
            "stiffness": stiffness,
            "damping": damping,
            "effort_limit": effort_limit,
            "velocity_limit": velocity_limit,
            "armature": armature,
        }

    def resolve(self, joint_names: Sequence[str], key: str, device: torch.device | None = None) -> None:
        """Find the group's joints among ``joint_names`` and spread each number over them, as tensors on ``device``.

        Raises:
            ConfigError: an expression matches nothing, or a joint has no value.
        """
        indices, self.joint_names = match_names(
            self.joint_names_expr, joint_names, key=f"{key}.joint_names_expr", what="joint"
        )
        self.joint_ids = torch.tensor(indices, device=device)
        per_joint: dict[str, list[Any]] = {}
        for name, values in self._config.items():
            spread = values_by_name(values, self.joint_names, None, key=f"{key}.{name}", what="joint")
            for error in valueless_errors(values, self.joint_names, f"{key}.{name}") if name in NEEDED else ():
                raise error
            per_joint[name] = spread
        self.stiffness, self.damping, self.effort_limit, self.velocity_limit = (
            torch.tensor(per_joint[name], dtype=torch.float32, device=device)
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

    def connect(self, num_envs: int, dt: float, stream: Stream) -> None:
        """Allocate what the model remembers; called once, before the first step.

        Args:
            num_envs: number of environments, N.
            dt: physics step, s.
            stream: returns the group's random stream; a group that draws nothing does not ask for it.
        """

    def reset(self, env_ids: torch.Tensor) -> None:
        """Forget what the model remembers of ``env_ids``."""

    def control(self, targets: JointTargets, data: RobotData) -> torch.Tensor:
        """Return the MuJoCo controls (N, joints of the group), before each physics step.

        Args:
            targets: the targets of all joints.
            data: the robot's state from which the step will start.
        """
        raise NotImplementedError

    def computed_torque(self, targets: JointTargets, data: RobotData) -> torch.Tensor:
        """Return the unclipped torque (N, joints of the group) that acted at the start of the last step, N·m."""
        raise NotImplementedError

    def _drive(self, targets: JointTargets, joint_pos: torch.Tensor, joint_vel: torch.Tensor) -> torch.Tensor:
        """Return kp (q* - q) + kd (qd* - qd) + tau_ff, N·m, for joints (N, J) of the robot."""
        ids = self.joint_ids
        return (
            self.stiffness * (targets.pos[:, ids] - joint_pos[:, ids])
            + self.damping * (targets.vel[:, ids] - joint_vel[:, ids])
            + targets.effort[:, ids]
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

    def control(self, targets: JointTargets, data: RobotData) -> torch.Tensor:
        """Return kp q* + kd qd* + tau_ff; the drive subtracts kp q + kd qd itself."""
        del data
        ids = self.joint_ids
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
        """Return clip(kp (q* - q) + kd (qd* - qd) + tau_ff, ±effort_limit)."""
        self._computed = self._drive(targets, data.joint_pos, data.joint_vel)
        return torch.clamp(self._computed, -self.effort_limit, self.effort_limit)

    def computed_torque(self, targets: JointTargets, data: RobotData) -> torch.Tensor:
        """Return the torque as it was computed before the step."""
        del targets, data
        return self._computed
