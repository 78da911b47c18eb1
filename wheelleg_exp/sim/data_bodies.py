"""The bodies' state under Isaac Lab's names: poses, velocities, accelerations, of links and centres of mass."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch

from wheelleg_exp.sim import rotation
from wheelleg_exp.sim.absent import lacking
from wheelleg_exp.sim.data import RobotData
from wheelleg_exp.sim.derived import derived, same_as
from wheelleg_exp.sim.ids import fill_rows


@lacking(
    {
        "body_incoming_joint_wrench_b": "MuJoCo works out what acts between links only for force and torque sensors"
        " of the model; applied_torque has what the actuators apply"
    }
)
class BodyData(RobotData):
    """Poses are (x, y, z, w, x, y, z), velocities linear then angular, states a pose and a velocity; world axes.

    Attributes:
        default_mass: of the model, kg, (N, B).
        default_inertia: of the model, about the centre of mass in link axes, kg·m^2, row by row, (N, B, 9).
    """

    def __init__(self, *args: Any, **more: Any) -> None:
        super().__init__(*args, **more)
        n, bodies = self._sim.num_envs, len(self._body_ids)
        self.default_mass = self._of_bodies("body_mass").clone()
        axes = rotation.quat_to_matrix(self._of_bodies("body_iquat")[0])
        inertia = axes @ torch.diag_embed(self._of_bodies("body_inertia")[0]) @ axes.mT
        self.default_inertia = inertia.reshape(1, bodies, 9).repeat(n, 1, 1)
        self._vel_before: torch.Tensor | None = None  # once somebody has asked for accelerations
        self._acc_valid = torch.zeros(n, 1, 1, device=self._sim.device)

    @property
    def body_names(self) -> list[str]:
        """Names of the bodies, breadth first."""
        return self._layout.body_names

    @derived
    def body_link_pose_w(self) -> torch.Tensor:
        """Poses of the link frames, m and (w, x, y, z), (N, B, 7)."""
        return torch.cat((self.body_pos_w, self.body_quat_w), dim=2)

    @derived
    def body_link_lin_vel_w(self) -> torch.Tensor:
        """Velocities of the links' origins, m/s, (N, B, 3)."""
        lever = self.body_pos_w - self.body_com_pos_w
        return self.body_lin_vel_w + torch.linalg.cross(self.body_ang_vel_w, lever)

    @derived
    def body_link_vel_w(self) -> torch.Tensor:
        """Velocities of the links' origins, m/s and rad/s, (N, B, 6)."""
        return torch.cat((self.body_link_lin_vel_w, self.body_ang_vel_w), dim=2)

    @derived
    def body_com_pos_w(self) -> torch.Tensor:
        """Positions of the bodies' centres of mass, m, (N, B, 3)."""
        return self._output("xipos")[:, self._body_ids].float()

    @derived
    def body_com_quat_w(self) -> torch.Tensor:
        """Orientations of the bodies' principal axes of inertia (w, x, y, z), (N, B, 4)."""
        link, inertial = self.body_quat_w.reshape(-1, 4), self.body_com_quat_b.reshape(-1, 4)
        return rotation.quat_mul(link, inertial).view_as(self.body_quat_w)

    @derived
    def body_com_pose_w(self) -> torch.Tensor:
        """Poses of the bodies' centres of mass and principal axes, m and (w, x, y, z), (N, B, 7)."""
        return torch.cat((self.body_com_pos_w, self.body_com_quat_w), dim=2)

    @derived
    def body_com_vel_w(self) -> torch.Tensor:
        """Velocities of the bodies' centres of mass, m/s and rad/s, (N, B, 6)."""
        return torch.cat((self.body_lin_vel_w, self.body_ang_vel_w), dim=2)

    @derived
    def body_state_w(self) -> torch.Tensor:
        """Poses of the links and velocities of their centres of mass, (N, B, 13)."""
        return torch.cat((self.body_link_pose_w, self.body_com_vel_w), dim=2)

    @derived
    def body_link_state_w(self) -> torch.Tensor:
        """Poses and velocities of the links' origins, (N, B, 13)."""
        return torch.cat((self.body_link_pose_w, self.body_link_vel_w), dim=2)

    @derived
    def body_com_state_w(self) -> torch.Tensor:
        """Poses and velocities of the bodies' centres of mass, (N, B, 13)."""
        return torch.cat((self.body_com_pose_w, self.body_com_vel_w), dim=2)

    @derived
    def body_com_pos_b(self) -> torch.Tensor:
        """Centres of mass in their link's frame, m, (N, B, 3)."""
        return self._of_bodies("body_ipos")

    @derived
    def body_com_quat_b(self) -> torch.Tensor:
        """Principal axes of inertia in their link's frame (w, x, y, z), (N, B, 4)."""
        return self._of_bodies("body_iquat")

    @derived
    def body_com_pose_b(self) -> torch.Tensor:
        """Centres of mass and principal axes in their link's frame, m and (w, x, y, z), (N, B, 7)."""
        return torch.cat((self.body_com_pos_b, self.body_com_quat_b), dim=2)

    @derived
    def body_com_acc_w(self) -> torch.Tensor:
        """Accelerations of the bodies' centres of mass, m/s^2 and rad/s^2, (N, B, 6); a body at rest has 0.

        Finite difference over the last physics step, 0 after a reset or a written velocity until the next one.
        """
        if self._vel_before is None:
            self._vel_before = self._velocity_before()
            self._acc_valid.copy_(self._torque_valid.unsqueeze(2))
        return (self.body_com_vel_w - self._vel_before) / self._dt * self._acc_valid

    @derived
    def body_com_lin_acc_w(self) -> torch.Tensor:
        """Linear accelerations of the bodies' centres of mass, m/s^2, (N, B, 3)."""
        return self.body_com_acc_w[..., :3]

    @derived
    def body_com_ang_acc_w(self) -> torch.Tensor:
        """Angular accelerations of the bodies, rad/s^2, (N, B, 3)."""
        return self.body_com_acc_w[..., 3:]

    body_link_pos_w = same_as("body_pos_w")
    body_link_quat_w = same_as("body_quat_w")
    body_link_ang_vel_w = same_as("body_ang_vel_w")
    body_com_lin_vel_w = same_as("body_lin_vel_w")
    body_com_ang_vel_w = same_as("body_ang_vel_w")
    body_pose_w = same_as("body_link_pose_w")
    body_vel_w = same_as("body_com_vel_w")
    body_acc_w = same_as("body_com_acc_w")
    body_lin_acc_w = same_as("body_com_lin_acc_w")
    body_ang_acc_w = same_as("body_com_ang_acc_w")
    com_pos_b = same_as("body_com_pos_b")
    com_quat_b = same_as("body_com_quat_b")

    def _velocity_before(self) -> torch.Tensor:
        """Return the bodies' velocities at the start of the last physics step, from the state kept of it."""
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
        return velocity

    def forget_accelerations(self, ids: torch.Tensor) -> None:
        """Report no acceleration of bodies whose velocity was written, until the next physics step."""
        if self._vel_before is not None:
            fill_rows(self._acc_valid, ids, 0.0)

    def before_step(self) -> None:
        """Keep the motion state that the coming physics step starts from."""
        super().before_step()
        if self._vel_before is not None:
            self._vel_before = self.body_com_vel_w

    def mark_stepped(self) -> None:
        """Note that the last solve belongs to every environment's present episode."""
        super().mark_stepped()
        if self._vel_before is not None:
            self._acc_valid.fill_(1.0)

    def reset(self, ids: torch.Tensor) -> None:
        """Report zero torque and acceleration for ``ids`` until their next physics step."""
        super().reset(ids)
        self.forget_accelerations(ids)

    def state_dict(self) -> dict[str, torch.Tensor]:
        """Return what is kept of the last physics step."""
        if self._vel_before is None:
            return super().state_dict()
        return {
            **super().state_dict(),
            "body_vel_before": self._vel_before.clone(),
            "acc_valid": self._acc_valid.clone(),
        }

    def load_state_dict(self, saved: Mapping[str, torch.Tensor]) -> None:
        """Restore what ``state_dict`` returned."""
        super().load_state_dict(saved)
        found = saved.get("body_vel_before")
        self._vel_before = None if found is None else found.clone()
        self._acc_valid.copy_(saved.get("acc_valid", torch.zeros_like(self._acc_valid)))
