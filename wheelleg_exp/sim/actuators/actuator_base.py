"""The base class of actuators: a group of joints, gains and limits per joint, and the delay of targets."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

import mujoco
import torch

from wheelleg_exp.constraints import Above, MayBeInfinite, Names, Natural, NonNegative, Ordered
from wheelleg_exp.errors import ConfigError
from wheelleg_exp.sim.delay import TargetDelay
from wheelleg_exp.sim.ids import narrowed
from wheelleg_exp.sim.names import match_names, valueless_errors, values_by_name
from wheelleg_exp.sim.robot_model import JointTargets
from wheelleg_exp.state import Stateful
from wheelleg_exp.terms.term_errors import code_place, described, dotted_name

if TYPE_CHECKING:
    from wheelleg_exp.sim.articulation_data import ArticulationData


PerJoint = NonNegative | Mapping[str, NonNegative]
# The config of an actuator group must set each parameter in ``NEEDED`` for every joint of the group.
NEEDED = ("stiffness", "damping", "effort_limit", "velocity_limit")
_MECHANICAL = ("armature", "friction", "viscous_friction")  # Properties of a joint that its actuator group can set.
ONE_GROUP = "each joint in one actuator group"
Limit = Annotated[float, Above(0), MayBeInfinite()]
LimitPerJoint = Limit | Mapping[str, Limit]
Delay = Annotated[Sequence[Natural], Ordered()]
Stream = Callable[[], torch.Generator]


class ActuatorBase(Stateful):
    """Base class of actuator models; each actuator model drives one group of joints.

    Each parameter is one number for all joints, or a mapping from expressions of joint names to numbers. ``start``
    converts ``stiffness``, ``damping``, ``effort_limit`` and ``velocity_limit`` to tensors (N, joints of the group).

    Args:
        joint_names_expr: expressions of the joints in the group.
        stiffness: kp, N·m/rad.
        damping: kd, N·m·s/rad.
        effort_limit: largest torque, N·m.
        velocity_limit: largest joint speed, rad/s. MuJoCo cannot enforce it: velocity targets are clipped to it, and
            faster joints are reported.
        armature: reflected rotor inertia, kg·m^2; null keeps the asset's value.
        friction: Coulomb friction of the joint, N·m; null keeps the asset's value.
        viscous_friction: viscous friction of the joint, N·m·s/rad; null keeps the asset's value.
        delay: shortest and longest delay of the targets in physics steps, drawn at each reset; null means no delay.
    """

    reads_state: ClassVar[bool] = True  # ``reads_state`` is False if controls depend only on joint targets.

    def __init__(
        self,
        joint_names_expr: Names,
        stiffness: PerJoint,
        damping: PerJoint,
        effort_limit: LimitPerJoint,
        velocity_limit: LimitPerJoint,
        armature: PerJoint | None = None,
        delay: Delay | None = None,
        friction: PerJoint | None = None,
        viscous_friction: PerJoint | None = None,
    ) -> None:
        self.joint_names_expr = [joint_names_expr] if isinstance(joint_names_expr, str) else list(joint_names_expr)
        values = (stiffness, damping, effort_limit, velocity_limit, armature, friction, viscous_friction)
        self._config: dict[str, PerJoint | None] = dict(zip((*NEEDED, *_MECHANICAL), values, strict=True))
        self._delay_bounds = delay
        self.delay: TargetDelay | None = self.child("delay", None)

    def read_files(self, folder: Path, key: str, device: torch.device) -> None:
        """Read the model's files from the robot's folder, before all other calls; ``key`` is the group's config key."""

    def resolve(self, joint_names: Sequence[str], key: str, device: torch.device | None = None) -> None:
        """Find the actuator group's joints, and make parameter tensors; raise ConfigError if a parameter is missing."""
        expressions = f"{key}.joint_names_expr"
        indices, self.joint_names = match_names(self.joint_names_expr, joint_names, key=expressions, what="joint")
        self.joint_ids = torch.tensor(indices, device=device)
        self._columns = narrowed(indices, device)
        per_joint: dict[str, list[Any]] = {}
        for name, values in self._config.items():
            given = {} if values is None else values
            per_joint[name] = values_by_name(given, self.joint_names, None, key=f"{key}.{name}", what="joint")
            for error in valueless_errors(values, self.joint_names, f"{key}.{name}") if name not in _MECHANICAL else ():
                raise error
        self.stiffness, self.damping, self.effort_limit, self.velocity_limit = (
            torch.tensor(per_joint[name], dtype=torch.float32, device=device) for name in NEEDED
        )
        self._per_joint = per_joint

    def add_to(self, spec: mujoco.MjSpec) -> None:
        """Write the joints' armatures and frictions to the MuJoCo spec, and add an actuator named after each joint."""
        for index, name in enumerate(self.joint_names):
            armature, friction, viscous_friction = (self._per_joint[key][index] for key in _MECHANICAL)
            joint = spec.joint(name)
            if armature is not None:
                joint.armature = armature
            if friction is not None:
                joint.frictionloss = friction
            if viscous_friction is not None:
                joint.damping = [viscous_friction, 0.0, 0.0]  # The damping torque is a polynomial of the joint speed.
            self._shape(spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT), index)

    def _shape(self, actuator: mujoco.MjsActuator, index: int) -> None:
        """Set the gains of one joint's MuJoCo actuator; ``index`` is the joint's index in the actuator group."""
        raise NotImplementedError

    def start(self, shape: tuple[int, int], dt: float, stream: Stream) -> None:
        """Expand the parameters to (N, J) and allocate the actuator model's memory; ``dt`` is the physics step, s."""
        for name in NEEDED:
            self.setting(name, getattr(self, name).expand(shape[0], -1).clone())
        if self._delay_bounds is not None:
            self.delay = TargetDelay(self._delay_bounds, self.joint_ids, shape, stream())
        self.connect(shape[0], dt, stream)

    def connect(self, num_envs: int, dt: float, stream: Stream) -> None:
        """Allocate memory for N environments and steps of ``dt``, s; call ``stream`` only if you need a generator."""

    def begin(self, env_ids: torch.Tensor) -> None:
        """Start the episodes of ``env_ids``: draw the delays of their targets, and reset the model."""
        if self.delay is not None:
            self.delay.reset(env_ids)
        self.reset(env_ids)

    def reset(self, env_ids: torch.Tensor) -> None:
        """Clear the actuator model's memory in the environments ``env_ids``; by default, fill its buffers."""
        self.reset_rows(env_ids)

    def act(self, targets: JointTargets, data: ArticulationData) -> torch.Tensor:
        """Delay the joint targets, and return the resulting MuJoCo controls of the actuator group, (N, joints)."""
        delayed = targets if self.delay is None else self.delay.push(targets)
        return self._of_joints(self.control(delayed, data), "control")

    def torque_asked(self, targets: JointTargets, data: ArticulationData) -> torch.Tensor:
        """Compute the unclipped torques, N·m, (N, joints), from the delayed joint targets of the last physics step."""
        torque = self.computed_torque(targets if self.delay is None else self.delay.targets, data)
        return self._of_joints(torque, "computed_torque")

    def _of_joints(self, value: torch.Tensor, method: str) -> torch.Tensor:
        shape = self.stiffness.shape
        if getattr(value, "shape", None) != shape:
            message = f"'{dotted_name(self)}.{method}' returns {described(value)}"
            expected = f"a tensor of shape {tuple(shape)}: environments, joints of the group"
            raise ConfigError(message, where=code_place(getattr(self, method)), expected=expected)
        return value

    def control(self, targets: JointTargets, data: ArticulationData) -> torch.Tensor:
        """Return the MuJoCo controls (N, joints of the actuator group) for the given joint targets and robot state."""
        raise NotImplementedError("an actuator model must define the method 'control(targets, data)'")

    def computed_torque(self, targets: JointTargets, data: ArticulationData) -> torch.Tensor:
        """Return the actuator group's unclipped torques at the start of the last physics step, N·m, (N, joints)."""
        raise NotImplementedError("an actuator model must define the method 'computed_torque(targets, data)'")

    def _drive(self, targets: JointTargets, joint_pos: torch.Tensor, joint_vel: torch.Tensor) -> torch.Tensor:
        """Return the torques kp (q* - q) + kd (qd* - qd) + tau_ff of the robot's J joints, N·m, (N, J)."""
        ids = self._columns
        feedback = self.stiffness * (targets.pos[:, ids] - joint_pos[:, ids])
        return feedback + self.damping * (targets.vel[:, ids] - joint_vel[:, ids]) + targets.effort[:, ids]
