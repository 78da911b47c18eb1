"""PD actuators inside and outside of MuJoCo's solver, and motors whose torque limit depends on speed or position."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from typing import TYPE_CHECKING, Annotated

import mujoco
import torch

from wheelleg_exp.constraints import Broken, Length, Names, Natural, Positive, relation
from wheelleg_exp.sim.actuators.actuator_base import ActuatorBase, Delay, LimitPerJoint, PerJoint, Stream
from wheelleg_exp.sim.robot_model import JointTargets

if TYPE_CHECKING:
    from wheelleg_exp.sim.articulation_data import ArticulationData


class ImplicitActuator(ActuatorBase):
    """PD drive inside the solver: implicit in velocity with ``implicitfast``, like PhysX's joint drive.

    One ``general`` actuator per joint: gain 1, affine bias (0, -kp, -kd), ctrl = kp q* + kd qd* + tau_ff.
    """

    reads_state = False

    def _shape(self, actuator: mujoco.MjsActuator, index: int) -> None:
        kp, kd, limit = (self._per_joint[name][index] for name in ("stiffness", "damping", "effort_limit"))
        actuator.gaintype, actuator.biastype = mujoco.mjtGain.mjGAIN_FIXED, mujoco.mjtBias.mjBIAS_AFFINE
        actuator.gainprm[0], actuator.biasprm[1], actuator.biasprm[2] = 1.0, -kp, -kd
        actuator.forcelimited, actuator.forcerange = True, (-limit, limit)

    def control(self, targets: JointTargets, data: ArticulationData) -> torch.Tensor:
        del data  # MuJoCo's solver itself adds the feedback -kp q - kd qd of joint positions q and velocities qd.
        ids = self._columns
        control = self.stiffness * targets.pos[:, ids]
        control += self.damping * targets.vel[:, ids]
        return control.add_(targets.effort[:, ids])

    def computed_torque(self, targets: JointTargets, data: ArticulationData) -> torch.Tensor:
        return self._drive(targets, data.joint_pos_before, data.joint_vel_before)


class IdealPDActuator(ActuatorBase):
    """Explicit PD: a torque that is computed from the state before each physics step, clipped, and applied."""

    def _shape(self, actuator: mujoco.MjsActuator, index: int) -> None:
        del index
        actuator.gaintype, actuator.biastype = mujoco.mjtGain.mjGAIN_FIXED, mujoco.mjtBias.mjBIAS_NONE
        actuator.gainprm[0] = 1.0

    def connect(self, num_envs: int, dt: float, stream: Stream) -> None:
        super().connect(num_envs, dt, stream)
        torque = torch.zeros(num_envs, len(self.joint_names), device=self.joint_ids.device)
        self._computed = self.buffer("_computed", torque)

    def control(self, targets: JointTargets, data: ArticulationData) -> torch.Tensor:
        self._computed = self._torque(targets, data)
        return self._clipped(self._computed, data)

    def _torque(self, targets: JointTargets, data: ArticulationData) -> torch.Tensor:
        return self._drive(targets, data.joint_pos, data.joint_vel)

    def _clipped(self, torque: torch.Tensor, data: ArticulationData) -> torch.Tensor:
        del data
        return torch.clamp(torque, -self.effort_limit, self.effort_limit)

    def computed_torque(self, targets: JointTargets, data: ArticulationData) -> torch.Tensor:
        del targets, data
        return self._computed


LookupRow = Annotated[Sequence[float], Length(3)]


class DCMotor(IdealPDActuator):
    """A PD actuator whose torque limit is that of a direct-current motor at the joint's present speed.

    The line from the stall torque ``saturation_effort`` to the no-load speed ``velocity_limit`` and the constant
    ``effort_limit`` bound the torque:

        v = clip(qd, ±velocity_limit (1 + effort_limit / saturation_effort))
        tau <= min(saturation_effort (1 - v / velocity_limit), effort_limit)
        tau >= max(saturation_effort (-1 - v / velocity_limit), -effort_limit)

    At high speeds, where the torque-speed line is below ``-effort_limit``, the motor brakes with ``effort_limit``.

    Args:
        effort_limit: largest torque at any speed, N·m.
        velocity_limit: speed at which the motor has no torque, rad/s.
        saturation_effort: stall torque of the motor's line, N·m; a number, or one by joint expression.
    """

    def __init__(
        self,
        joint_names_expr: Names,
        stiffness: PerJoint,
        damping: PerJoint,
        effort_limit: LimitPerJoint,
        velocity_limit: LimitPerJoint,
        saturation_effort: Positive | Mapping[str, Positive],
        armature: PerJoint | None = None,
        delay: Delay | None = None,
        friction: PerJoint | None = None,
        viscous_friction: PerJoint | None = None,
    ) -> None:
        limits = (effort_limit, velocity_limit)
        super().__init__(joint_names_expr, stiffness, damping, *limits, armature, delay, friction, viscous_friction)
        self._config["saturation_effort"] = saturation_effort

    def resolve(self, joint_names: Sequence[str], key: str, device: torch.device | None = None) -> None:
        super().resolve(joint_names, key, device)
        self._saturation = torch.tensor(self._per_joint["saturation_effort"], dtype=torch.float32, device=device)

    def _clipped(self, torque: torch.Tensor, data: ArticulationData) -> torch.Tensor:
        beyond = self.velocity_limit * (1 + self.effort_limit / self._saturation)
        speed = torch.clamp(data.joint_vel[:, self.joint_ids], -beyond, beyond) / self.velocity_limit
        top = torch.minimum(self._saturation * (1 - speed), self.effort_limit)
        bottom = torch.maximum(self._saturation * (-1 - speed), -self.effort_limit)
        return torch.clamp(torque, bottom, top)


def _delays_in_order(min_delay: int, max_delay: int) -> Iterator[Broken]:
    if min_delay > max_delay:
        yield Broken("min_delay", f"{min_delay} is more than max_delay, {max_delay}", "at most max_delay")


@relation(_delays_in_order)
class DelayedPDActuator(IdealPDActuator):
    """An ``IdealPDActuator`` with delayed joint targets; each reset draws a new delay for each environment.

    Args:
        min_delay: shortest delay, physics steps.
        max_delay: longest delay, physics steps.
    """

    def __init__(
        self,
        joint_names_expr: Names,
        stiffness: PerJoint,
        damping: PerJoint,
        effort_limit: LimitPerJoint,
        velocity_limit: LimitPerJoint,
        armature: PerJoint | None = None,
        min_delay: Natural = 0,
        max_delay: Natural = 0,
        friction: PerJoint | None = None,
        viscous_friction: PerJoint | None = None,
    ) -> None:
        others = (effort_limit, velocity_limit, armature, (min_delay, max_delay), friction, viscous_friction)
        super().__init__(joint_names_expr, stiffness, damping, *others)


def _angles_rise(joint_parameter_lookup: Sequence[LookupRow]) -> Iterator[Broken]:
    name, angles = "joint_parameter_lookup", [row[0] for row in joint_parameter_lookup]
    if len(angles) < 2:
        yield Broken(name, f"has {len(angles)} rows", "at least 2 rows")
    if any(low >= high for low, high in pairwise(angles)):
        yield Broken(name, f"its angles are {angles}", "rows sorted by angle, without repetition")
    if any(row[2] < 0 for row in joint_parameter_lookup):
        yield Broken(name, "a largest torque is negative", "torques of at least 0")


@relation(_angles_rise)
class RemotizedPDActuator(DelayedPDActuator):
    """A ``DelayedPDActuator`` whose largest torque depends on the joint's position, for example due to a linkage.

    The largest torque is interpolated linearly between the rows, and constant outside of the table.

    Args:
        joint_parameter_lookup: rows [joint position, rad; transmission ratio, ignored; largest torque, N·m].
    """

    def __init__(
        self,
        joint_names_expr: Names,
        stiffness: PerJoint,
        damping: PerJoint,
        joint_parameter_lookup: Sequence[LookupRow],
        armature: PerJoint | None = None,
        min_delay: Natural = 0,
        max_delay: Natural = 0,
        friction: PerJoint | None = None,
        viscous_friction: PerJoint | None = None,
    ) -> None:
        others = (torch.inf, torch.inf, armature, min_delay, max_delay, friction, viscous_friction)
        super().__init__(joint_names_expr, stiffness, damping, *others)
        self._table = [list(map(float, row)) for row in joint_parameter_lookup]

    def resolve(self, joint_names: Sequence[str], key: str, device: torch.device | None = None) -> None:
        super().resolve(joint_names, key, device)
        self._angles, _, self._largest = torch.tensor(self._table, device=device).T.contiguous()

    def _clipped(self, torque: torch.Tensor, data: ArticulationData) -> torch.Tensor:
        position = data.joint_pos[:, self.joint_ids]
        above = torch.bucketize(position, self._angles).clamp(1, len(self._angles) - 1)
        low, high = self._angles[above - 1], self._angles[above]
        share = ((position - low) / (high - low)).clamp(0.0, 1.0)
        largest = torch.lerp(self._largest[above - 1], self._largest[above], share)
        return torch.clamp(torque, -largest, largest)
