"""The robot's state and parameters, with the attribute names of Isaac Lab's ``ArticulationData``."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import torch

from wheelleg_exp.sim import rotation
from wheelleg_exp.sim.class_members import TensorProperty, alias_of, cached_until_change, declare_unsupported, joined
from wheelleg_exp.sim.engine import Engine
from wheelleg_exp.sim.ids import fill_rows, narrowed, picked
from wheelleg_exp.sim.robot_model import JointTargets, RobotLayout
from wheelleg_exp.state import Stateful

_ONE_FRICTION = "MuJoCo has one friction of a joint at rest and in motion, joint_friction_coeff"
_TENDONS = "a robot's tendons are not read here; env.scene.model has MuJoCo's"
_FIXED = ("stiffness", "damping", "limit_stiffness", "rest_length", "offset", "pos_limits")
_SPATIAL = ("stiffness", "damping", "limit_stiffness", "offset")
_UNSUPPORTED = {
    "joint_dynamic_friction_coeff": _ONE_FRICTION,
    "default_joint_dynamic_friction_coeff": _ONE_FRICTION,
    "fixed_tendon_limit": _TENDONS,
    "default_fixed_tendon_limit": _TENDONS,
    "body_incoming_joint_wrench_b": "MuJoCo computes the wrench between links only for force and torque sensors"
    " of the model; applied_torque has the torque that the actuators apply",
}
_UNSUPPORTED |= {f"{start}fixed_tendon_{name}": _TENDONS for start in ("", "default_") for name in _FIXED}
_UNSUPPORTED |= {f"{start}spatial_tendon_{name}": _TENDONS for start in ("", "default_") for name in _SPATIAL}


def _of_joints(field: str, doc: str) -> TensorProperty:
    """Make a property of a field of MuJoCo's model that has one value for each degree of freedom."""
    return TensorProperty(lambda data: data._model(field)[:, data._dof_ids].float(), doc=doc)


@declare_unsupported(_UNSUPPORTED)
class ArticulationData(Stateful):
    """The robot's state and parameters: float32, N environments, joints and bodies in the robot's order; always fresh.

    Each quantity is computed at its first read after a change of the state. The suffix ``_w`` means world axes, ``_b``
    the axes of a link. Velocities refer to centres of mass (CoM), unless the name contains ``link``; poses refer to
    link frames, unless it contains ``com``. A pose is a position, m, and a quaternion (w, x, y, z); a velocity is
    linear, m/s, then angular, rad/s; a state, such as ``root_state_w``, is a pose followed by a velocity.
    ``computed_torque`` (N, J) contains the actuators' unclipped torques in the last physics step.

    Attributes:
        encoder_bias: encoder reading minus joint position, rad, (N, J).
        imu_tilt: orientation of the IMU in the axes of the root link, as rotation matrices, (N, 3, 3).
        gyro_bias: reading of the IMU's gyroscope at rest, rad/s, (N, 3).
        gravity_dir_w: unit vector of gravity in world axes, (N, 3); tilted if an event tilts the ground.
        has_imu_errors: whether some term sets ``imu_tilt``, ``gyro_bias``, or ``gravity_dir_w``.
        GRAVITY_VEC_W: unit vector of gravity, world axes, (N, 3).
        FORWARD_VEC_B: the link's x axis, link axes, (N, 3).
        default_root_state: state at a reset: pose of the link relative to the environment's origin, velocity, (N, 13).
        default_joint_stiffness: kp of the config, N·m/rad, (N, J).
        default_joint_damping: kd of the config, N·m·s/rad, (N, J).
        default_joint_armature: reflected rotor inertia of the model, kg·m^2, (N, J).
        default_joint_friction_coeff: friction loss of the model, N·m, (N, J).
        default_joint_viscous_friction_coeff: passive damping of the model, N·m·s/rad, (N, J).
        default_joint_pos_limits: limits of the model, rad, (N, J, 2).
        gear_ratio: 1, because actuators act on the joints directly, (N, J).
        default_mass: mass of each body in the model, kg, (N, B).
        default_inertia: inertia about each body's centre of mass, link axes, row by row, kg·m^2, (N, B, 9).
    """

    def __init__(
        self,
        sim: Engine,
        layout: RobotLayout,
        targets: JointTargets,
        computed_torque: Callable[[ArticulationData], torch.Tensor],
        gains: Callable[[str, bool], torch.Tensor],
    ) -> None:
        n, joints, device = sim.num_envs, len(layout.joint_names), sim.device
        self._sim = sim
        self._targets = targets
        self._compute_torque, self._gains = computed_torque, gains
        self._layout = layout
        self._cache: dict[str, torch.Tensor] = self.buffer("_cache", {}, saved=False)
        self._shows_outputs = self.number("_shows_outputs", False, saved=False)
        self._constants: dict[str, torch.Tensor] = {}
        self._root_id = int(layout.body_ids[0])
        self._floating = layout.floating
        self._qpos, self._qvel = sim.view("qpos"), sim.view("qvel")
        self._qpos_ids, self._dof_ids = layout.qpos_ids, layout.dof_ids
        self.motion_at_start = self.buffer("motion_at_start", sim.motion.clone(), saved=False)
        self._motion_before = self.buffer("_motion_before", torch.zeros_like(self.motion_at_start))
        nq = self._qpos.shape[1]
        self._qpos_before, self._qvel_before = self._motion_before[:, :nq], self._motion_before[:, nq:]
        self._body_ids = layout.body_ids
        self._actuated = layout.actuated_ids
        every = len(self._actuated) == joints
        self._of_actuator = narrowed(torch.argsort(self._actuated).tolist(), device) if every else None
        self._dt = float(sim.model.opt.timestep)
        self.com_b = self.setting("com_b", sim.constant("body_ipos")[self._root_id].float().repeat(n, 1))
        self.default_joint_pos = self.setting("default_joint_pos", layout.default_joint_pos.repeat(n, 1))
        self.default_joint_vel = self.setting("default_joint_vel", layout.default_joint_vel.repeat(n, 1))
        self.joint_pos_limits = self.setting("joint_pos_limits", layout.joint_pos_limits.repeat(n, 1, 1))
        self.soft_joint_pos_limits = self.setting("soft_joint_pos_limits", layout.soft_joint_pos_limits.repeat(n, 1, 1))
        self.soft_joint_vel_limits = self.setting("soft_joint_vel_limits", layout.velocity_limits.repeat(n, 1))
        self.joint_effort_limits = self.setting("joint_effort_limits", layout.effort_limits.repeat(n, 1))
        self.encoder_bias = self.setting("encoder_bias", torch.zeros(n, joints, device=device))
        self.has_encoder_bias = False
        gravity = torch.tensor(sim.model.opt.gravity.tolist(), dtype=torch.float32, device=device)
        self._gravity_dir = torch.nn.functional.normalize(gravity, dim=0)
        self.imu_tilt = self.setting("imu_tilt", torch.eye(3, device=device).expand(n, 3, 3).clone())
        self.gyro_bias = self.setting("gyro_bias", torch.zeros(n, 3, device=device))
        self.gravity_dir_w = self.setting("gravity_dir_w", self._gravity_dir.expand(n, 3).clone())
        self.has_imu_errors = False
        self._torque_valid = self.buffer("_torque_valid", torch.zeros(n, 1, device=device))
        self._all_valid = self.number("_all_valid", False, saved=False)
        self._applied_torque = self.buffer("_applied_torque", torch.zeros(n, joints, device=device))
        # Call ``view`` before the first physics step, because a new view contains zeros until the next physics step.
        sim.view("actuator_force")
        self.GRAVITY_VEC_W = self._gravity_dir.repeat(n, 1)
        self.FORWARD_VEC_B = torch.tensor([1.0, 0.0, 0.0], device=device).repeat(n, 1)
        start = torch.cat((layout.default_root_pos, layout.default_root_quat, torch.zeros(6, device=device)))
        self.default_root_state = self.setting("default_root_state", start.repeat(n, 1))
        self.default_joint_stiffness = gains("stiffness", False)
        self.default_joint_damping = gains("damping", False)
        self.default_joint_armature = self.joint_armature.clone()
        self.default_joint_friction_coeff = self.joint_friction_coeff.clone()
        self.default_joint_viscous_friction_coeff = self.joint_viscous_friction_coeff.clone()
        self.default_joint_pos_limits = self.joint_pos_limits.clone()
        self.gear_ratio = torch.ones_like(self.default_joint_pos)
        self.default_mass = self._of_bodies("body_mass").clone()
        axes = rotation.quat_to_matrix(self._of_bodies("body_iquat")[0])
        inertia = axes @ torch.diag_embed(self._of_bodies("body_inertia")[0]) @ axes.mT
        self.default_inertia = inertia.reshape(1, -1, 9).repeat(n, 1, 1)
        # ``_vel_before`` stores the bodies' velocities before the last physics step; None until accelerations are read.
        self._vel_before: torch.Tensor | None = self.buffer("_vel_before", None)
        self._acc_valid = self.buffer("_acc_valid", torch.zeros(n, 1, 1, device=device))

    def invalidate(self) -> None:
        """Clear the cache of the robot's derived quantities; called after each change of the robot's state."""
        self._cache.clear()
        self._shows_outputs = False

    def outputs_refreshed(self) -> None:
        """Clear the cache if it contains results of the engine, such as link poses, which were just recomputed."""
        if self._shows_outputs:
            self.invalidate()

    def _output(self, name: str) -> torch.Tensor:
        """Return the engine's result ``name``, such as ``xpos``; call ``Scene.refresh`` first after a state write."""
        self._shows_outputs = True
        return self._sim.derived(name)

    def before_step(self) -> None:
        """Store the present positions and velocities, from which the next physics step starts."""
        self._motion_before.copy_(self._sim.motion)
        if self._vel_before is not None:
            self._vel_before = self.body_com_vel_w

    def set_velocity_before(self, ids: torch.Tensor, joint_ids: torch.Tensor | slice, vel: torch.Tensor) -> None:
        """Store joint velocities (n, k), rad/s, as those before the last physics step; this sets ``joint_acc`` to 0."""
        self._qvel_before[ids.unsqueeze(1), self._dof_ids[joint_ids]] = vel.to(self._qvel_before.dtype)

    def mark_stepped(self) -> None:
        """Store the actuator torques of a physics step, and clear the cached quantities."""
        if not self._all_valid:
            self._torque_valid.fill_(1.0)
            self._all_valid = True
        torque = self._sim.view("actuator_force")
        if self._of_actuator is not None:
            self._applied_torque = picked(torque, self._of_actuator).float()
        else:
            self._applied_torque[:, self._actuated] = torque.float()
        self.invalidate()
        if self._vel_before is not None:
            self._acc_valid.fill_(1.0)

    def reset(self, ids: torch.Tensor) -> None:
        """Set joint torques and accelerations of the environments ``ids`` to zero until the next physics step."""
        self._torque_valid.index_fill_(0, ids, 0.0)
        self._all_valid = False
        self._applied_torque = self._applied_torque.index_fill(0, ids, 0.0)
        self.invalidate()
        self.forget_accelerations(ids)

    def _model(self, name: str) -> torch.Tensor:
        """Return the present values of a model field in each simulation, (N, ...), read-only."""
        if name in self._sim.expanded:
            return self._sim.expanded[name]
        if name not in self._constants:
            self._constants[name] = self._sim.constant(name)
        constant = self._constants[name]
        return constant.expand(self._sim.num_envs, *constant.shape)

    def _of_bodies(self, name: str) -> torch.Tensor:
        return self._model(name)[:, self._body_ids].float()

    def load_state_dict(self, saved: Mapping[str, object]) -> None:
        super().load_state_dict(saved)
        self._all_valid = bool(self._torque_valid.all())
        self.invalidate()

    joint_pos_target = alias_of("_targets.pos", "Position targets, rad, (N, J).")
    joint_vel_target = alias_of("_targets.vel", "Velocity targets, rad/s, (N, J).")
    joint_effort_target = alias_of("_targets.effort", "Feed-forward efforts, N·m, (N, J).")
    joint_vel_limits = alias_of("soft_joint_vel_limits", "The actuators' velocity limits, rad/s, (N, J).")

    @cached_until_change
    def _motion(self) -> torch.Tensor:
        return self._sim.motion.float()

    @cached_until_change
    def _positions(self) -> torch.Tensor:
        return self._motion[:, : self._qpos.shape[1]]

    @cached_until_change
    def _velocities(self) -> torch.Tensor:
        return self._motion[:, self._qpos.shape[1] :]

    @cached_until_change
    def root_pos_w(self) -> torch.Tensor:
        """Position of the root link, m, (N, 3)."""
        return self._positions[:, 0:3] if self._floating else self.body_pos_w[:, 0]

    @cached_until_change
    def root_quat_w(self) -> torch.Tensor:
        """Orientation of the root link in the world, as quaternions (w, x, y, z), (N, 4)."""
        # MuJoCo normalises the root's quaternion in each physics step.
        return self._positions[:, 3:7] if self._floating else self.body_quat_w[:, 0]

    @cached_until_change
    def root_rot_w(self) -> torch.Tensor:
        """Rotation matrices from the axes of the root link to world axes, (N, 3, 3)."""
        return rotation.quat_to_matrix(self.root_quat_w)

    @cached_until_change
    def root_link_lin_vel_w(self) -> torch.Tensor:
        """Velocity of the root link's origin in world axes, m/s, (N, 3)."""
        n, device = self._sim.num_envs, self._sim.device
        return self._velocities[:, 0:3] if self._floating else torch.zeros(n, 3, device=device)

    @cached_until_change
    def root_ang_vel_b(self) -> torch.Tensor:
        """Angular velocity of the root link in its own axes, rad/s, (N, 3)."""
        n, device = self._sim.num_envs, self._sim.device
        return self._velocities[:, 3:6] if self._floating else torch.zeros(n, 3, device=device)

    @cached_until_change
    def root_ang_vel_w(self) -> torch.Tensor:
        """Angular velocity of the root link in world axes, rad/s, (N, 3)."""
        return rotation.rotate(self.root_rot_w, self.root_ang_vel_b)

    @cached_until_change
    def root_link_lin_vel_b(self) -> torch.Tensor:
        """Velocity of the root link's origin in the axes of the root link, m/s, (N, 3)."""
        return rotation.rotate_inverse(self.root_rot_w, self.root_link_lin_vel_w)

    @cached_until_change
    def root_lin_vel_b(self) -> torch.Tensor:
        """Velocity of the root body's centre of mass in link axes, m/s, (N, 3): v_link + omega x c."""
        return self.root_link_lin_vel_b + torch.cross(self.root_ang_vel_b, self.com_b, dim=-1)

    @cached_until_change
    def root_lin_vel_w(self) -> torch.Tensor:
        """Velocity of the root body's centre of mass in world axes, m/s, (N, 3)."""
        return rotation.rotate(self.root_rot_w, self.root_lin_vel_b)

    @cached_until_change
    def projected_gravity_b(self) -> torch.Tensor:
        """Unit vector of gravity in the axes of the root link, (N, 3); (0, 0, -1) for an upright robot."""
        return rotation.rotate_inverse(self.root_rot_w, self._gravity_dir.unsqueeze(0))

    @cached_until_change
    def root_ang_vel_measured(self) -> torch.Tensor:
        """Angular velocity that the root link's IMU measures, in the axes of the IMU, with its bias, rad/s, (N, 3)."""
        if not self.has_imu_errors:
            return self.root_ang_vel_b
        return rotation.rotate_inverse(self.imu_tilt, self.root_ang_vel_b) + self.gyro_bias

    @cached_until_change
    def projected_gravity_measured(self) -> torch.Tensor:
        """Unit vector of gravity in the axes of the root link's IMU, (N, 3)."""
        if not self.has_imu_errors:
            return self.projected_gravity_b
        return rotation.rotate_inverse(self.imu_tilt, rotation.rotate_inverse(self.root_rot_w, self.gravity_dir_w))

    @cached_until_change
    def heading_w(self) -> torch.Tensor:
        """Yaw of the root link's x axis, rad, (N,)."""
        cosine, sine = self.root_rot_w[:, :2, 0].contiguous().unbind(dim=1)
        return torch.atan2(sine, cosine)

    @cached_until_change
    def joint_pos(self) -> torch.Tensor:
        """Joint positions, rad, (N, J)."""
        return self._positions.index_select(1, self._qpos_ids)

    @property
    def joint_pos_measured(self) -> torch.Tensor:
        """Readings of the joints' encoders, each a joint position plus an encoder bias, rad, (N, J)."""
        return self.joint_pos + self.encoder_bias if self.has_encoder_bias else self.joint_pos

    @cached_until_change
    def joint_vel(self) -> torch.Tensor:
        """Joint velocities, rad/s, (N, J)."""
        return self._velocities.index_select(1, self._dof_ids)

    @cached_until_change
    def joint_acc(self) -> torch.Tensor:
        """Joint accelerations as finite differences over the last physics step, rad/s^2, (N, J)."""
        return (self.joint_vel - self.joint_vel_before) / self._dt * self._torque_valid

    @cached_until_change
    def joint_pos_before(self) -> torch.Tensor:
        """Joint positions from which the last physics step started, rad, (N, J)."""
        return self._qpos_before.index_select(1, self._qpos_ids).float()

    @cached_until_change
    def joint_vel_before(self) -> torch.Tensor:
        """Joint velocities from which the last physics step started, rad/s, (N, J)."""
        return self._qvel_before.index_select(1, self._dof_ids).float()

    applied_torque = alias_of("_applied_torque", "Clipped torque of the last physics step, N·m, (N, J); 0 at a reset.")

    @cached_until_change
    def computed_torque(self) -> torch.Tensor:
        """Unclipped actuator torques at the start of the last physics step, N·m, (N, J); 0 right after a reset."""
        return self._compute_torque(self) * self._torque_valid

    @cached_until_change
    def body_pos_w(self) -> torch.Tensor:
        """Positions of the frames of the robot's links in the world, m, (N, B, 3)."""
        return self._output("xpos")[:, self._body_ids].float()

    @cached_until_change
    def body_quat_w(self) -> torch.Tensor:
        """Orientations of the frames of the robot's links, as quaternions (w, x, y, z), (N, B, 4)."""
        return self._output("xquat")[:, self._body_ids].float()

    @cached_until_change
    def body_rot_w(self) -> torch.Tensor:
        """Rotation matrices from the axes of the robot's links to world axes, (N, B, 3, 3)."""
        return self._output("xmat")[:, self._body_ids].float().view(self._sim.num_envs, -1, 3, 3)

    @cached_until_change
    def body_ang_vel_w(self) -> torch.Tensor:
        """Angular velocities of the robot's links, rad/s, (N, B, 3)."""
        return self._output("cvel")[:, self._body_ids, 0:3].float()

    @cached_until_change
    def body_lin_vel_w(self) -> torch.Tensor:
        """Velocities of the centres of mass of the robot's links, m/s, (N, B, 3)."""
        # Shift MuJoCo's cvel, which refers to the whole robot's centre of mass, to each link's centre of mass.
        velocity = self._output("cvel")[:, self._body_ids]
        tree_com = self._output("subtree_com")[:, self._root_id].unsqueeze(1)
        offset = self._output("xipos")[:, self._body_ids] - tree_com
        return (velocity[..., 3:6] + torch.cross(velocity[..., 0:3], offset, dim=-1)).float()

    device = alias_of("_sim.device", "Device of the tensors.")

    def update(self, dt: float) -> None:
        """Do nothing, because properties such as ``root_pos_w`` compute their values when code reads them."""
        del dt

    @cached_until_change
    def root_com_pos_w(self) -> torch.Tensor:
        """Position of the root body's centre of mass, m, (N, 3)."""
        return self.root_pos_w + rotation.rotate(self.root_rot_w, self.com_b)

    @cached_until_change
    def root_com_quat_w(self) -> torch.Tensor:
        """Orientation of the root body's principal axes of inertia, as quaternions (w, x, y, z), (N, 4)."""
        return rotation.quat_mul(self.root_quat_w, self._of_bodies("body_iquat")[:, 0])

    root_link_pose_w = joined("root_pos_w", "root_quat_w", "Pose of the root link, m and (w, x, y, z), (N, 7).")
    root_link_vel_w = joined("root_link_lin_vel_w", "root_ang_vel_w", "Velocity of the root link's origin, (N, 6).")
    root_com_pose_w = joined("root_com_pos_w", "root_com_quat_w", "Pose of the root body's centre of mass, (N, 7).")
    root_com_vel_w = joined("root_lin_vel_w", "root_ang_vel_w", "Velocity of the root body's centre of mass, (N, 6).")
    root_state_w = joined("root_link_pose_w", "root_com_vel_w", "Pose of the root link, velocity of its CoM, (N, 13).")
    root_link_state_w = joined("root_link_pose_w", "root_link_vel_w", "State of the root link's origin, (N, 13).")
    root_com_state_w = joined("root_com_pose_w", "root_com_vel_w", "State of the root body's CoM, (N, 13).")
    root_pose_w = alias_of("root_link_pose_w")
    root_vel_w = alias_of("root_com_vel_w")
    root_link_pos_w = alias_of("root_pos_w")
    root_link_quat_w = alias_of("root_quat_w")
    root_link_ang_vel_w = alias_of("root_ang_vel_w")
    root_link_ang_vel_b = alias_of("root_ang_vel_b")
    root_com_lin_vel_w = alias_of("root_lin_vel_w")
    root_com_ang_vel_w = alias_of("root_ang_vel_w")
    root_com_lin_vel_b = alias_of("root_lin_vel_b")
    root_com_ang_vel_b = alias_of("root_ang_vel_b")

    joint_names = alias_of("_layout.joint_names", "Names of the joints in the order that terms see.")

    @property
    def joint_stiffness(self) -> torch.Tensor:
        """Stiffness of implicit actuators, which MuJoCo's solver computes, N·m/rad, (N, J); 0 for other actuators."""
        return self._gains("stiffness", True)

    @property
    def joint_damping(self) -> torch.Tensor:
        """Damping of implicit actuators, which MuJoCo's solver computes, N·m·s/rad, (N, J); 0 for other actuators."""
        return self._gains("damping", True)

    joint_armature = _of_joints("dof_armature", "Reflected rotor inertia of each joint's drive, kg·m^2, (N, J).")
    joint_friction_coeff = _of_joints("dof_frictionloss", "Friction loss, N·m, (N, J).")
    joint_viscous_friction_coeff = _of_joints("dof_damping", "Passive damping, N·m·s/rad, (N, J).")
    joint_limits = alias_of("joint_pos_limits")
    joint_velocity_limits = alias_of("joint_vel_limits")
    joint_friction = alias_of("joint_friction_coeff")
    default_joint_limits = alias_of("default_joint_pos_limits")
    default_joint_friction = alias_of("default_joint_friction_coeff")

    body_names = alias_of("_layout.body_names", "Names of the bodies, breadth first.")

    @cached_until_change
    def body_link_lin_vel_w(self) -> torch.Tensor:
        """Linear velocities of the origins of the robot's links in world axes, m/s, (N, B, 3)."""
        lever = self.body_pos_w - self.body_com_pos_w
        return self.body_lin_vel_w + self.body_ang_vel_w.cross(lever, dim=-1)

    @cached_until_change
    def body_com_pos_w(self) -> torch.Tensor:
        """Positions of the centres of mass of the robot's bodies in the world, m, (N, B, 3)."""
        return self._output("xipos")[:, self._body_ids].float()

    @cached_until_change
    def body_com_quat_w(self) -> torch.Tensor:
        """World orientations of the bodies' principal axes of inertia, as quaternions (w, x, y, z), (N, B, 4)."""
        link, inertial = self.body_quat_w.reshape(-1, 4), self.body_com_quat_b.reshape(-1, 4)
        return rotation.quat_mul(link, inertial).view_as(self.body_quat_w)

    @cached_until_change
    def body_com_pos_b(self) -> torch.Tensor:
        """Position of each body's centre of mass in the frame of the body's link, m, (N, B, 3)."""
        return self._of_bodies("body_ipos")

    @cached_until_change
    def body_com_quat_b(self) -> torch.Tensor:
        """Quaternion (w, x, y, z) of each body's principal axes of inertia in the body's link frame, (N, B, 4)."""
        return self._of_bodies("body_iquat")

    body_link_pose_w = joined("body_pos_w", "body_quat_w", "Poses of the link frames, (N, B, 7).")
    body_link_vel_w = joined("body_link_lin_vel_w", "body_ang_vel_w", "Velocities of the links' origins, (N, B, 6).")
    body_com_pose_w = joined("body_com_pos_w", "body_com_quat_w", "Poses of the bodies' centres of mass, (N, B, 7).")
    body_com_vel_w = joined("body_lin_vel_w", "body_ang_vel_w", "Velocities of the bodies' CoM, (N, B, 6).")
    body_state_w = joined("body_link_pose_w", "body_com_vel_w", "Poses of the links, velocities of CoM, (N, B, 13).")
    body_link_state_w = joined("body_link_pose_w", "body_link_vel_w", "States of the links' origins, (N, B, 13).")
    body_com_state_w = joined("body_com_pose_w", "body_com_vel_w", "States of the bodies' CoM, (N, B, 13).")
    body_com_pose_b = joined("body_com_pos_b", "body_com_quat_b", "Poses of the CoM in the links' frames, (N, B, 7).")
    body_link_pos_w = alias_of("body_pos_w")
    body_link_quat_w = alias_of("body_quat_w")
    body_link_ang_vel_w = alias_of("body_ang_vel_w")
    body_com_lin_vel_w = alias_of("body_lin_vel_w")
    body_com_ang_vel_w = alias_of("body_ang_vel_w")
    body_pose_w = alias_of("body_link_pose_w")
    body_vel_w = alias_of("body_com_vel_w")
    body_acc_w = alias_of("body_com_acc_w")
    body_lin_acc_w = alias_of("body_com_lin_acc_w")
    body_ang_acc_w = alias_of("body_com_ang_acc_w")
    com_pos_b = alias_of("body_com_pos_b")
    com_quat_b = alias_of("body_com_quat_b")

    @cached_until_change
    def body_com_acc_w(self) -> torch.Tensor:
        """Finite-difference accelerations of the bodies' CoM, m/s^2, rad/s^2, (N, B, 6); 0 after a reset or a write."""
        if self._vel_before is None:
            # At the first read of accelerations, the bodies' velocities before the last physics step are unknown.
            # Compute the bodies' old velocities from the qpos and qvel before the last physics step.
            # After the first read, ``before_step`` stores the bodies' velocities before each physics step.
            sim, now, has_stepped = self._sim, (self._qpos.clone(), self._qvel.clone()), self._torque_valid > 0.0
            self._qpos.copy_(torch.where(has_stepped, self._qpos_before, now[0]))
            self._qvel.copy_(torch.where(has_stepped, self._qvel_before, now[1]))
            self.invalidate()
            for name in ("xpos", "xquat", "xipos", "cvel", "subtree_com"):
                sim.derived(name)
            sim.forward()
            velocity = self.body_com_vel_w
            self._qpos.copy_(now[0])
            self._qvel.copy_(now[1])
            sim.forward()
            self.invalidate()
            self._vel_before = velocity
            self._acc_valid.copy_(self._torque_valid.unsqueeze(2))
        return (self.body_com_vel_w - self._vel_before) / self._dt * self._acc_valid

    @cached_until_change
    def body_com_lin_acc_w(self) -> torch.Tensor:
        """Linear accelerations of the centres of mass of the robot's bodies, m/s^2, (N, B, 3)."""
        return self.body_com_acc_w[..., :3]

    @cached_until_change
    def body_com_ang_acc_w(self) -> torch.Tensor:
        """Angular accelerations of the robot's bodies, rad/s^2, (N, B, 3)."""
        return self.body_com_acc_w[..., 3:]

    def forget_accelerations(self, ids: torch.Tensor) -> None:
        """Set the accelerations of the environments ``ids`` to zero until the next physics step."""
        if self._vel_before is not None:
            fill_rows(self._acc_valid, ids, 0.0)
