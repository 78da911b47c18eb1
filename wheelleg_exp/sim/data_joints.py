"""The joints' parameters under Isaac Lab's names: what the config and the model gave, and what acts now."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch

from wheelleg_exp.sim.absent import lacking
from wheelleg_exp.sim.data import RobotData
from wheelleg_exp.sim.derived import same_as

_ONE_FRICTION = "MuJoCo has one friction of a joint at rest and in motion, joint_friction_coeff"
_TENDONS = "a robot's tendons are not read here; env.scene.model has MuJoCo's"
_FIXED = ("stiffness", "damping", "limit_stiffness", "rest_length", "offset", "pos_limits")
_SPATIAL = ("stiffness", "damping", "limit_stiffness", "offset")

# Model fields of a joint's degree of freedom, by Isaac Lab's name of them.
_FIELDS = {
    "armature": "dof_armature",
    "friction_coeff": "dof_frictionloss",
    "viscous_friction_coeff": "dof_damping",
}


@lacking(
    {
        "joint_dynamic_friction_coeff": _ONE_FRICTION,
        "default_joint_dynamic_friction_coeff": _ONE_FRICTION,
        "fixed_tendon_limit": _TENDONS,
        "default_fixed_tendon_limit": _TENDONS,
    }
    | {f"{start}fixed_tendon_{name}": _TENDONS for start in ("", "default_") for name in _FIXED}
    | {f"{start}spatial_tendon_{name}": _TENDONS for start in ("", "default_") for name in _SPATIAL}
)
class JointData(RobotData):
    """Joint parameters, (N, J) in the robot's order.

    Attributes:
        default_joint_stiffness: kp that the config gave, N·m/rad.
        default_joint_damping: kd that the config gave, N·m·s/rad.
        default_joint_armature: of the model, kg·m^2.
        default_joint_friction_coeff: friction loss of the model, N·m.
        default_joint_viscous_friction_coeff: of the model, N·m·s/rad.
        default_joint_pos_limits: of the model, rad, (N, J, 2).
        gear_ratio: 1: actuators act on the joints themselves.
    """

    def __init__(self, *args: Any, gains: Callable[[str, bool], torch.Tensor]) -> None:
        super().__init__(*args)
        self._gains = gains
        self.default_joint_stiffness = gains("stiffness", False)
        self.default_joint_damping = gains("damping", False)
        self.default_joint_armature = self._of_joints("armature").clone()
        self.default_joint_friction_coeff = self._of_joints("friction_coeff").clone()
        self.default_joint_viscous_friction_coeff = self._of_joints("viscous_friction_coeff").clone()
        self.default_joint_pos_limits = self.joint_pos_limits.clone()
        self.gear_ratio = torch.ones_like(self.default_joint_pos)

    @property
    def joint_names(self) -> list[str]:
        """Names of the joints in the order that terms see."""
        return self._layout.joint_names

    @property
    def joint_stiffness(self) -> torch.Tensor:
        """Stiffness of the drives inside the solver, N·m/rad, (N, J); 0 of explicit actuators."""
        return self._gains("stiffness", True)

    @property
    def joint_damping(self) -> torch.Tensor:
        """Damping of the drives inside the solver, N·m·s/rad, (N, J); 0 of explicit actuators."""
        return self._gains("damping", True)

    @property
    def joint_armature(self) -> torch.Tensor:
        """Reflected rotor inertia, kg·m^2, (N, J)."""
        return self._of_joints("armature")

    @property
    def joint_friction_coeff(self) -> torch.Tensor:
        """Friction loss, N·m, (N, J)."""
        return self._of_joints("friction_coeff")

    @property
    def joint_viscous_friction_coeff(self) -> torch.Tensor:
        """Passive damping, N·m·s/rad, (N, J)."""
        return self._of_joints("viscous_friction_coeff")

    def _of_joints(self, name: str) -> torch.Tensor:
        return self._model(_FIELDS[name])[:, self._dof_ids].float()

    joint_limits = same_as("joint_pos_limits")
    joint_velocity_limits = same_as("joint_vel_limits")
    joint_friction = same_as("joint_friction_coeff")
    default_joint_limits = same_as("default_joint_pos_limits")
    default_joint_friction = same_as("default_joint_friction_coeff")
