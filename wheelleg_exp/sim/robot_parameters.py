"""Writing what the robot's joints are: gains, limits, armatures and friction of each environment."""

from __future__ import annotations

import math

import torch

from wheelleg_exp.sim.actuators import ActuatorBase, ImplicitActuator
from wheelleg_exp.sim.ids import Columns, EnvIds, columns
from wheelleg_exp.sim.layout import soft_limits
from wheelleg_exp.sim.options import RobotOptions
from wheelleg_exp.sim.robot_faces import RobotFaces

_STRONGEST = 1e10  # N·m: MuJoCo's largest number stands for a drive without a limit
Values = torch.Tensor | float


class RobotParameters(RobotFaces):
    """Isaac Lab's writers of joint parameters; values are (n, k) for environments and joints, or one number.

    Gains and limits are those of the joints' actuators, whatever their model; joints without one keep none.
    """

    options: RobotOptions
    actuators: dict[str, ActuatorBase]

    def write_joint_stiffness_to_sim(
        self, stiffness: Values, joint_ids: Columns = None, env_ids: EnvIds = None
    ) -> None:
        """Set kp of the joints' actuators, N·m/rad."""
        self._write_gain("stiffness", 1, stiffness, joint_ids, env_ids)

    def write_joint_damping_to_sim(self, damping: Values, joint_ids: Columns = None, env_ids: EnvIds = None) -> None:
        """Set kd of the joints' actuators, N·m·s/rad."""
        self._write_gain("damping", 2, damping, joint_ids, env_ids)

    def write_joint_effort_limit_to_sim(
        self, limits: Values, joint_ids: Columns = None, env_ids: EnvIds = None
    ) -> None:
        """Set the largest torques of the joints' actuators, N·m."""
        ids, joints = self._rows(env_ids), columns(joint_ids, self.device)
        self._assign(self.data.joint_effort_limits, ids, joints, limits)
        for place, values, named in self._write_drives("effort_limit", ids, joints, limits):
            largest = values.clamp(max=_STRONGEST).to(self._sim.dtype)
            field = self._sim.expand("actuator_forcerange")
            both = torch.stack((-largest, largest), dim=2)
            field[ids, place] = torch.where(named.unsqueeze(1), both, field[ids, place])

    def write_joint_velocity_limit_to_sim(
        self, limits: Values, joint_ids: Columns = None, env_ids: EnvIds = None
    ) -> None:
        """Set the largest speeds of the joints' actuators, rad/s: targets are clipped to them."""
        ids, joints = self._rows(env_ids), columns(joint_ids, self.device)
        self._assign(self.data.soft_joint_vel_limits, ids, joints, limits)
        self._write_drives("velocity_limit", ids, joints, limits)

    def write_joint_armature_to_sim(self, armature: Values, joint_ids: Columns = None, env_ids: EnvIds = None) -> None:
        """Set reflected rotor inertias, kg·m^2."""
        self._write_dofs("dof_armature", armature, joint_ids, env_ids)
        self._sim.set_const()

    def write_joint_friction_coefficient_to_sim(
        self,
        joint_friction_coeff: Values,
        joint_dynamic_friction_coeff: Values | None = None,
        joint_viscous_friction_coeff: Values | None = None,
        joint_ids: Columns = None,
        env_ids: EnvIds = None,
    ) -> None:
        """Set friction losses, N·m, and passive dampings, N·m·s/rad; MuJoCo has no other friction in motion."""
        del joint_dynamic_friction_coeff
        self._write_dofs("dof_frictionloss", joint_friction_coeff, joint_ids, env_ids)
        if joint_viscous_friction_coeff is not None:
            self.write_joint_viscous_friction_coefficient_to_sim(joint_viscous_friction_coeff, joint_ids, env_ids)

    def write_joint_viscous_friction_coefficient_to_sim(
        self, joint_viscous_friction_coeff: Values, joint_ids: Columns = None, env_ids: EnvIds = None
    ) -> None:
        """Set passive dampings, N·m·s/rad."""
        self._write_dofs("dof_damping", joint_viscous_friction_coeff, joint_ids, env_ids)

    def write_joint_position_limit_to_sim(
        self,
        limits: torch.Tensor,
        joint_ids: Columns = None,
        env_ids: EnvIds = None,
        warn_limit_violation: bool = True,
    ) -> None:
        """Set joint limits (n, k, 2), rad, which may be infinite; soft limits follow, defaults are clamped to them."""
        del warn_limit_violation
        ids, joints = self._rows(env_ids), columns(joint_ids, self.device)
        data, sim = self.data, self._sim
        self._assign(data.joint_pos_limits, ids, joints, limits)
        now = data.joint_pos_limits[ids]
        data.soft_joint_pos_limits[ids] = soft_limits(now, self.options.soft_joint_pos_limit_factor)
        data.default_joint_pos[ids] = data.default_joint_pos[ids].clamp(now[..., 0], now[..., 1])
        rows, places = ids.unsqueeze(1), self.layout.joint_ids[joints]
        written = now[:, joints].to(sim.dtype)
        # MuJoCo has one switch for both ends: the open end of a joint that is limited at the other lies far away.
        far = 2.0 * math.pi * 1e6
        if sim.may_differ("jnt_limited") or not self.layout.all_limited:
            sim.expand("jnt_limited")[rows, places] = written.isfinite().any(dim=2)
        sim.expand("jnt_range")[rows, places] = written.clamp(-far, far)

    def write_encoder_bias(self, bias: Values, joint_ids: Columns = None, env_ids: EnvIds = None) -> None:
        """Set by how much the joints' encoders read too much, rad."""
        self._assign(self.data.encoder_bias, self._rows(env_ids), columns(joint_ids, self.device), bias)
        self._has_new_targets = True
        self.data.invalidate()

    def _write_gain(self, name: str, column: int, values: Values, joint_ids: Columns, env_ids: EnvIds) -> None:
        ids, joints = self._rows(env_ids), columns(joint_ids, self.device)
        for place, written, named in self._write_drives(name, ids, joints, values):
            field = self._sim.expand("actuator_biasprm")
            gains = -written.to(self._sim.dtype)
            field[ids, place, column] = torch.where(named, gains, field[ids, place, column])

    def _write_drives(
        self, name: str, ids: torch.Tensor, joints: torch.Tensor | slice, values: Values
    ) -> list[tuple[slice, torch.Tensor, torch.Tensor]]:
        """Write a number of the actuators.

        Returns:
            Of each group whose drive is in the solver: the place of its controls, values (n, k), and which are written.
        """
        self._has_new_targets = True  # what the drives make of the targets is new
        named = torch.zeros(self.num_joints, dtype=torch.bool, device=self.device)
        named[joints] = True
        spread = torch.zeros(len(ids), self.num_joints, device=self.device)
        spread[:, joints] = values
        start, found = 0, []
        for actuator in self.actuators.values():
            place = slice(start, start := start + len(actuator.joint_names))
            own, theirs, which = getattr(actuator, name), spread[:, actuator.joint_ids], named[actuator.joint_ids]
            own[ids] = torch.where(which, theirs, own[ids])
            if isinstance(actuator, ImplicitActuator):
                found.append((place, theirs, which))
        return found

    def _write_dofs(self, field: str, values: Values, joint_ids: Columns, env_ids: EnvIds) -> None:
        ids, joints = self._rows(env_ids), columns(joint_ids, self.device)
        if isinstance(values, torch.Tensor):
            values = values.to(self._sim.dtype)
        self._sim.expand(field)[ids.unsqueeze(1), self.layout.dof_ids[joints]] = values

    @staticmethod
    def _assign(of: torch.Tensor, ids: torch.Tensor, joints: torch.Tensor | slice, values: Values) -> None:
        """Write values (n, k, ...) into a tensor (N, J, ...)."""
        rows = of[ids]
        rows[:, joints] = values
        of[ids] = rows
