"""Shared computations of several terms: height above the ground, tilt, resting side, and level velocity."""

from __future__ import annotations

import torch

from wheelleg_exp.managers import Env
from wheelleg_exp.sim.articulation_data import ArticulationData


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
