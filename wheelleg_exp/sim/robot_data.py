"""The robot's state, whose quantities have the attribute names of Isaac Lab.

Each quantity of the robot is computed at its first read after a change of the robot's state.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import torch

from wheelleg_exp.sim import rotation
from wheelleg_exp.sim.class_members import alias_of, cached_until_change
from wheelleg_exp.sim.engine import Engine
from wheelleg_exp.sim.ids import narrowed, picked
from wheelleg_exp.sim.robot_model import JointTargets, RobotLayout
from wheelleg_exp.state import Stateful


class RobotData(Stateful):
    """The robot's state: float32, N environments, joints and bodies in the robot's order; always fresh.

    The suffix ``_w`` of an attribute name means world axes; the suffix ``_b`` means the axes of the root link. Root
    linear velocities refer to the root body's centre of mass, unless the attribute name contains ``link``. Poses refer
    to link frames. ``computed_torque`` returns the actuators' unclipped torques (N, J) in the last physics step.

    Attributes:
        encoder_bias: encoder reading minus joint position, rad, (N, J).
        has_encoder_bias: whether some term sets an encoder bias.
        imu_tilt: orientation of the IMU in the axes of the root link, as rotation matrices, (N, 3, 3).
        gyro_bias: reading of the IMU's gyroscope at rest, rad/s, (N, 3).
        gravity_dir_w: unit vector of gravity in world axes, (N, 3); tilted if an event tilts the ground.
        has_imu_errors: whether some term sets ``imu_tilt``, ``gyro_bias``, or ``gravity_dir_w``.
    """

    def __init__(
        self,
        sim: Engine,
        layout: RobotLayout,
        targets: JointTargets,
        computed_torque: Callable[[RobotData], torch.Tensor],
    ) -> None:
        n, joints, device = sim.num_envs, len(layout.joint_names), sim.device
        self._sim = sim
        self._targets = targets
        self._compute_torque = computed_torque
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
        self._qpos_before, self._qvel_before = self._motion_before.split(self._qpos.shape[1:] + self._qvel.shape[1:], 1)
        self._body_ids = layout.body_ids
        self._actuated = layout.actuated_ids
        every = len(self._actuated) == joints
        self._of_actuator = narrowed(torch.argsort(self._actuated).tolist(), device) if every else None
        self._dt = float(sim.model.opt.timestep)
        com_b = sim.constant("body_ipos")[self._root_id].float().expand(n, 3).clone()
        self.com_b = self.setting("com_b", com_b)
        self.default_joint_pos = self.setting("default_joint_pos", layout.default_joint_pos.expand(n, joints).clone())
        self.default_joint_vel = self.setting("default_joint_vel", layout.default_joint_vel.expand(n, joints).clone())
        self.joint_pos_limits = self.setting("joint_pos_limits", layout.joint_pos_limits.expand(n, joints, 2).clone())
        soft_limits = layout.soft_joint_pos_limits.expand(n, joints, 2).clone()
        self.soft_joint_pos_limits = self.setting("soft_joint_pos_limits", soft_limits)
        velocity_limits = layout.velocity_limits.expand(n, joints).clone()
        self.soft_joint_vel_limits = self.setting("soft_joint_vel_limits", velocity_limits)
        self.joint_effort_limits = self.setting("joint_effort_limits", layout.effort_limits.expand(n, joints).clone())
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

    def reset(self, ids: torch.Tensor) -> None:
        """Set joint torques and accelerations of the environments ``ids`` to zero until the next physics step."""
        self._torque_valid.index_fill_(0, ids, 0.0)
        self._all_valid = False
        self._applied_torque = self._applied_torque.index_fill(0, ids, 0.0)
        self.invalidate()

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

    def begin_control_step(self) -> None:
        """Store the present positions and velocities, from which the next control step starts, for failure reports."""
        self.motion_at_start.copy_(self._sim.motion)

    def load_state_dict(self, saved: Mapping[str, Any]) -> None:
        super().load_state_dict(saved)
        self._all_valid = bool(self._torque_valid.all())
        self.invalidate()

    joint_pos_target = alias_of("_targets.pos", "Position targets, rad, (N, J).")
    joint_vel_target = alias_of("_targets.vel", "Velocity targets, rad/s, (N, J).")
    joint_effort_target = alias_of("_targets.effort", "Feed-forward efforts, N·m, (N, J).")
    joint_vel_limits = alias_of(
        "soft_joint_vel_limits", "The actuators' velocity limits, rad/s, (N, J); the engine itself limits no speed."
    )

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
        return (
            self._velocities[:, 0:3] if self._floating else torch.zeros(self._sim.num_envs, 3, device=self._sim.device)
        )

    @cached_until_change
    def root_ang_vel_b(self) -> torch.Tensor:
        """Angular velocity of the root link in its own axes, rad/s, (N, 3)."""
        return (
            self._velocities[:, 3:6] if self._floating else torch.zeros(self._sim.num_envs, 3, device=self._sim.device)
        )

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
        found: torch.Tensor = self.root_link_lin_vel_b + torch.linalg.cross(self.root_ang_vel_b, self.com_b)
        return found

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
        found: torch.Tensor = self._qpos_before.index_select(1, self._qpos_ids).float()
        return found

    @cached_until_change
    def joint_vel_before(self) -> torch.Tensor:
        """Joint velocities from which the last physics step started, rad/s, (N, J)."""
        found: torch.Tensor = self._qvel_before.index_select(1, self._dof_ids).float()
        return found

    applied_torque = alias_of(
        "_applied_torque", "Clipped actuator torque at the last physics step's start, N·m, (N, J); 0 after a reset."
    )

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
        found: torch.Tensor = self._output("xmat")[:, self._body_ids].unflatten(-1, (3, 3)).float()
        return found

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
        found: torch.Tensor = (velocity[..., 3:6] + torch.linalg.cross(velocity[..., 0:3], offset)).float()
        return found
