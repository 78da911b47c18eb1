"""The robot's state and parameters, with the attribute names of Isaac Lab's ``ArticulationData``."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch

from wheelleg_exp.sim import rotation
from wheelleg_exp.sim.class_members import alias_of, cached_until_change, declare_unsupported, joined
from wheelleg_exp.sim.ids import fill_rows
from wheelleg_exp.sim.robot_data import RobotData

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


@declare_unsupported(_UNSUPPORTED)
class ArticulationData(RobotData):
    """The robot's state and parameters: float32, N environments, joints and bodies in the robot's order.

    The suffix ``_w`` of an attribute name means world axes, and the suffix ``_b`` means the axes of a link.
    Velocities refer to centres of mass of bodies, unless the attribute name contains ``link``. Poses refer to link
    frames, unless the attribute name contains ``com``. A pose is a position, m, and a quaternion (w, x, y, z). A
    velocity consists of a linear velocity, m/s, and an angular velocity, rad/s. A state, such as ``root_state_w``, is a
    pose followed by a velocity. CoM means centre of mass.

    Attributes:
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

    def __init__(self, *args: Any, gains: Callable[[str, bool], torch.Tensor]) -> None:
        super().__init__(*args)
        n, layout, bodies, device = self._sim.num_envs, self._layout, len(self._body_ids), self._sim.device
        self._gains = gains
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
        self.default_inertia = inertia.reshape(1, bodies, 9).repeat(n, 1, 1)
        # ``_vel_before`` stores the bodies' velocities before the last physics step; None until accelerations are read.
        self._vel_before: torch.Tensor | None = self.buffer("_vel_before", None)
        self._acc_valid = self.buffer("_acc_valid", torch.zeros(n, 1, 1, device=device))

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

    @property
    def joint_armature(self) -> torch.Tensor:
        """Reflected rotor inertia of each joint's drive, kg·m^2, (N, J)."""
        return self._of_joints("dof_armature")

    @property
    def joint_friction_coeff(self) -> torch.Tensor:
        """Friction loss, N·m, (N, J)."""
        return self._of_joints("dof_frictionloss")

    @property
    def joint_viscous_friction_coeff(self) -> torch.Tensor:
        """Passive damping, N·m·s/rad, (N, J)."""
        return self._of_joints("dof_damping")

    def _of_joints(self, field: str) -> torch.Tensor:
        return self._model(field)[:, self._dof_ids].float()

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
        """Linear and angular accelerations of the bodies' centres of mass, m/s^2 and rad/s^2, (N, B, 6); 0 at rest.

        The acceleration of a body is the difference of its velocity over the last physics step, divided by the step.
        After a reset or a write of velocities, all accelerations are 0 until the next physics step.
        """
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

    def before_step(self) -> None:
        super().before_step()
        if self._vel_before is not None:
            self._vel_before = self.body_com_vel_w

    def mark_stepped(self) -> None:
        super().mark_stepped()
        if self._vel_before is not None:
            self._acc_valid.fill_(1.0)

    def reset(self, ids: torch.Tensor) -> None:
        super().reset(ids)
        self.forget_accelerations(ids)
