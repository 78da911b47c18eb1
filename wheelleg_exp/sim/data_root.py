"""The root's state under Isaac Lab's names: poses, velocities and both in one, of the link and of its CoM."""

from __future__ import annotations

from typing import Any

import torch

from wheelleg_exp.sim import rotation
from wheelleg_exp.sim.data import RobotData
from wheelleg_exp.sim.derived import derived, same_as


class RootData(RobotData):
    """Poses are (x, y, z, w, x, y, z), velocities linear then angular, states a pose and a velocity; world axes.

    Attributes:
        GRAVITY_VEC_W: unit vector of gravity, world axes, (N, 3).
        FORWARD_VEC_B: the link's x axis, link axes, (N, 3).
        default_root_state: where resets begin: pose of the link from the environment's origin, velocity, (N, 13).
    """

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        n, layout = self._sim.num_envs, self._layout
        self.GRAVITY_VEC_W = self._gravity_dir.repeat(n, 1)
        self.FORWARD_VEC_B = torch.tensor([1.0, 0.0, 0.0], device=self._sim.device).repeat(n, 1)
        still = torch.zeros(6, device=self._sim.device)
        start = torch.cat((layout.default_root_pos, layout.default_root_quat, still))
        self.default_root_state = start.repeat(n, 1)

    def settings(self) -> dict[str, torch.Tensor]:
        """Return the tensors that come from the config and the model, and that an event may change."""
        return {**super().settings(), "default_root_state": self.default_root_state}

    @derived
    def root_link_pose_w(self) -> torch.Tensor:
        """Pose of the root link, m and (w, x, y, z), (N, 7)."""
        return torch.cat((self.root_pos_w, self.root_quat_w), dim=1)

    @derived
    def root_link_vel_w(self) -> torch.Tensor:
        """Velocity of the root link's origin, m/s and rad/s, (N, 6)."""
        return torch.cat((self.root_link_lin_vel_w, self.root_ang_vel_w), dim=1)

    @derived
    def root_com_pos_w(self) -> torch.Tensor:
        """Position of the root body's centre of mass, m, (N, 3)."""
        return self.root_pos_w + rotation.rotate(self.root_rot_w, self.com_b)

    @derived
    def root_com_quat_w(self) -> torch.Tensor:
        """Orientation of the root body's principal axes of inertia (w, x, y, z), (N, 4)."""
        return rotation.quat_mul(self.root_quat_w, self._of_bodies("body_iquat")[:, 0])

    @derived
    def root_com_pose_w(self) -> torch.Tensor:
        """Pose of the root body's centre of mass and principal axes, m and (w, x, y, z), (N, 7)."""
        return torch.cat((self.root_com_pos_w, self.root_com_quat_w), dim=1)

    @derived
    def root_com_vel_w(self) -> torch.Tensor:
        """Velocity of the root body's centre of mass, m/s and rad/s, (N, 6)."""
        return torch.cat((self.root_lin_vel_w, self.root_ang_vel_w), dim=1)

    @derived
    def root_state_w(self) -> torch.Tensor:
        """Pose of the root link and velocity of its centre of mass, (N, 13)."""
        return torch.cat((self.root_link_pose_w, self.root_com_vel_w), dim=1)

    @derived
    def root_link_state_w(self) -> torch.Tensor:
        """Pose and velocity of the root link's origin, (N, 13)."""
        return torch.cat((self.root_link_pose_w, self.root_link_vel_w), dim=1)

    @derived
    def root_com_state_w(self) -> torch.Tensor:
        """Pose and velocity of the root body's centre of mass, (N, 13)."""
        return torch.cat((self.root_com_pose_w, self.root_com_vel_w), dim=1)

    root_pose_w = same_as("root_link_pose_w")
    root_vel_w = same_as("root_com_vel_w")
    root_link_pos_w = same_as("root_pos_w")
    root_link_quat_w = same_as("root_quat_w")
    root_link_ang_vel_w = same_as("root_ang_vel_w")
    root_link_ang_vel_b = same_as("root_ang_vel_b")
    root_com_lin_vel_w = same_as("root_lin_vel_w")
    root_com_ang_vel_w = same_as("root_ang_vel_w")
    root_com_lin_vel_b = same_as("root_lin_vel_b")
    root_com_ang_vel_b = same_as("root_ang_vel_b")
