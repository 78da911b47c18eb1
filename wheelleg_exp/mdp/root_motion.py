"""Shared computations of several terms: height above the ground and the wheels, tilt, resting side, level velocity."""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import mujoco
import torch

from wheelleg_exp.managers import Env
from wheelleg_exp.sim.articulation_data import ArticulationData
from wheelleg_exp.sim.ids import Ids


def height_over_ground(env: Env, positions: torch.Tensor) -> torch.Tensor:
    """Return the heights of world positions (N, ..., 3) above the ground, m, (N, ...)."""
    height: torch.Tensor = positions[..., 2] - env.scene.terrain.height_at(positions[..., :2])
    return height


def roll_pitch(projected_gravity: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Return roll and pitch, rad, (N,) each, with R = Rz(yaw) Ry(pitch) Rx(roll), from gravity in link axes, (N, 3)."""
    x, y, z = projected_gravity.unbind(dim=1)
    return torch.atan2(-y, -z), torch.asin(x.clamp(-1.0, 1.0))


SIDES = ("upright", "upside_down", "face", "back", "left", "right")


def resting_side(projected_gravity: torch.Tensor) -> torch.Tensor:
    """Return the index in ``SIDES`` of the side on which each link lies, (N,), from gravity in link axes, (N, 3)."""
    x, y, z = projected_gravity.unbind(dim=1)
    return torch.stack((-z, z, x, -x, y, -y)).argmax(dim=0)


def level_velocity(data: ArticulationData) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the forward and leftward velocity of the root's centre of mass in horizontal axes, m/s, (N,) each."""
    velocity, yaw = data.root_lin_vel_w, data.heading_w
    cos, sin = torch.cos(yaw), torch.sin(yaw)
    return cos * velocity[:, 0] + sin * velocity[:, 1], cos * velocity[:, 1] - sin * velocity[:, 0]


def default_pose(model: mujoco.MjModel, robot: Any) -> mujoco.MjData:
    """Return MuJoCo's data of a robot's links and joint axes in the default pose."""
    data = mujoco.MjData(model)
    for name, value in zip(robot.joint_names, robot.layout.default_joint_pos.tolist(), strict=True):
        data.qpos[model.joint(name).qposadr[0]] = value
    mujoco.mj_kinematics(model, data)
    return data


class Link(NamedTuple):
    """One joint of each of W legs: ``default`` is its position in the default pose, which the geometry describes."""

    columns: torch.Tensor  # indices among the robot's joints, (W,)
    default: torch.Tensor  # rad or m, (W,)
    slides: torch.Tensor  # whether the joint slides along its axis instead of turning about it, (W, 1)
    axes: torch.Tensor  # in the root link's axes, (W, 3)
    anchors: torch.Tensor  # points on the axes in the root link's frame, m, (W, 3)

    def move(self, points: torch.Tensor, joint_pos: torch.Tensor) -> torch.Tensor:
        """Return where the joint moves a point of each leg, m, (N, W, 3), given all joint positions (N, J)."""
        moved, arm = (joint_pos[:, self.columns] - self.default).unsqueeze(2), points - self.anchors
        along = self.axes * (self.axes * arm).sum(dim=-1, keepdim=True)
        across = torch.linalg.cross(self.axes.expand_as(arm), arm)
        turned = self.anchors + along + (arm - along) * moved.cos() + across * moved.sin()  # Rodrigues' formula
        return torch.where(self.slides, points + self.axes * moved, turned)


class HeightOverWheels:
    """The root link's height over the wheels' lowest points, from what encoders and IMU measure; mean over W wheels.

    ``links`` are the joints from the wheels to the root link, which move the wheels' ``centres`` (W, 3), m, one after
    the other. Joints without motors count, too, so a robot needs encoders at them. ``radius`` is that of the wheels, m.
    """

    def __init__(self, model: mujoco.MjModel, robot: Any, wheel_ids: Ids, radius: float) -> None:
        pose, layout, root = default_pose(model, robot), robot.layout, int(robot.body_ids[0])
        turn, device, ids = pose.xmat[root].reshape(3, 3), layout.joint_ids.device, layout.joint_ids.tolist()
        # In float32, rounding errors of a height would be as large as the tolerance of exported policies.
        numbers = partial(torch.tensor, dtype=torch.float64, device=device)
        anchors, axes = numbers((pose.xanchor - pose.xpos[root]) @ turn), numbers(pose.xaxis @ turn)
        wheels = layout.joint_ids[wheel_ids].tolist()
        legs = [_joints_between(model, wheel, root) for wheel in wheels]
        most = max(map(len, legs))
        self._data, self.radius, self.centres, self.links = robot.data, radius, anchors[wheels], list[Link]()
        # A shorter leg starts with the wheel's joint, which does not move the wheel's centre.
        legs = [[wheel] * (most - len(leg)) + leg for wheel, leg in zip(wheels, legs, strict=True)]
        for joints in map(list, zip(*legs, strict=True)):
            columns = torch.tensor([ids.index(joint) for joint in joints], device=device)
            slides = torch.tensor(model.jnt_type[joints, None] == mujoco.mjtJoint.mjJNT_SLIDE, device=device)
            default = layout.default_joint_pos[columns].double()
            self.links.append(Link(columns, default, slides, axes[joints], anchors[joints]))

    def __call__(self) -> torch.Tensor:
        """Return the measured height, m, (N,), float64."""
        points, joint_pos = self.centres, self._data.joint_pos_measured.double()
        for link in self.links:
            points = link.move(points, joint_pos)
        down: torch.Tensor = self._data.projected_gravity_measured.double()
        return (points * down.unsqueeze(1)).sum(dim=2).mean(dim=1) + self.radius


def _joints_between(model: mujoco.MjModel, wheel: int, root: int) -> list[int]:
    """Return the ids of the joints that move a wheel's joint relative to the root link, from the wheel to the root."""
    found, dof = list[int](), int(model.jnt_dofadr[wheel])
    while (dof := model.dof_parentid[dof]) >= 0 and model.dof_bodyid[dof] != root:
        found.append(int(model.dof_jntid[dof]))
    return found
