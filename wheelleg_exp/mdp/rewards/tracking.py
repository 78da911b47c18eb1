"""Rewards for following commands."""

from __future__ import annotations

import torch

from wheelleg_exp.constraints import Positive
from wheelleg_exp.managers import Env, SceneEntityCfg

_ROBOT = SceneEntityCfg("robot")


def track_lin_vel_xy_exp(
    env: Env, std: Positive, command_name: str, asset_cfg: SceneEntityCfg = _ROBOT
) -> torch.Tensor:
    """exp(-|v_xy command - v_xy|^2 / std^2), velocities of the root's centre of mass in link axes."""
    command = env.command_manager.get_command(command_name)[:, :2]
    error = (command - env.scene[asset_cfg.name].data.root_lin_vel_b[:, :2]).square().sum(dim=1)
    return torch.exp(-error / std**2)


def track_ang_vel_z_exp(env: Env, std: Positive, command_name: str, asset_cfg: SceneEntityCfg = _ROBOT) -> torch.Tensor:
    """exp(-(w_z command - w_z)^2 / std^2), angular velocity in link axes."""
    command = env.command_manager.get_command(command_name)[:, 2]
    error = (command - env.scene[asset_cfg.name].data.root_ang_vel_b[:, 2]).square()
    return torch.exp(-error / std**2)
