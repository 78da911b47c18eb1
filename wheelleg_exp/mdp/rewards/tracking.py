"""Rewards for following commands."""

from __future__ import annotations

import torch

from wheelleg_exp.constraints import NonNegative, Positive
from wheelleg_exp.managers import Env, SceneEntityCfg
from wheelleg_exp.mdp.commands.travel import kept_travel_error
from wheelleg_exp.mdp.ground import height_over_ground

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


def track_lin_vel_xy_yaw_frame_exp(
    env: Env, std: Positive, command_name: str, asset_cfg: SceneEntityCfg = _ROBOT
) -> torch.Tensor:
    """exp(-|v_xy command - v_xy|^2 / std^2), velocities of the root's centre of mass in level axes that turn with it.

    Unlike ``track_lin_vel_xy_exp`` it does not take a leaning robot's fall for speed.
    """
    data = env.scene[asset_cfg.name].data
    command, velocity, yaw = env.command_manager.get_command(command_name), data.root_lin_vel_w, data.heading_w
    cos, sin = torch.cos(yaw), torch.sin(yaw)
    forwards = cos * velocity[:, 0] + sin * velocity[:, 1]
    sideways = cos * velocity[:, 1] - sin * velocity[:, 0]
    error = (command[:, 0] - forwards).square() + (command[:, 1] - sideways).square()
    return torch.exp(-error / std**2)


def track_ang_vel_z_world_exp(
    env: Env, command_name: str, std: Positive, asset_cfg: SceneEntityCfg = _ROBOT
) -> torch.Tensor:
    """exp(-(w_z command - w_z)^2 / std^2), angular velocity about the world's vertical."""
    command = env.command_manager.get_command(command_name)[:, 2]
    error = (command - env.scene[asset_cfg.name].data.root_ang_vel_w[:, 2]).square()
    return torch.exp(-error / std**2)


def track_base_height_exp(
    env: Env, std: Positive, command_name: str, asset_cfg: SceneEntityCfg = _ROBOT
) -> torch.Tensor:
    """exp(-(height command - h)^2 / std^2), h of the root link above the ground straight below, m. Not in Isaac Lab.

    The command's first component is the height, as ``UniformBasePoseCommand`` has it.
    """
    command = env.command_manager.get_command(command_name)[:, 0]
    error = (command - height_over_ground(env, env.scene[asset_cfg.name].data.root_pos_w)).square()
    return torch.exp(-error / std**2)


def track_base_tilt_exp(env: Env, std: Positive, command_name: str, asset_cfg: SceneEntityCfg = _ROBOT) -> torch.Tensor:
    """exp(-|(roll, pitch) command - (roll, pitch)|^2 / std^2), rad, pitch forwards is positive. Not in Isaac Lab.

    The command is height, roll and pitch, as ``UniformBasePoseCommand`` has it.
    """
    command = env.command_manager.get_command(command_name)
    x, y, z = env.scene[asset_cfg.name].data.projected_gravity_b.unbind(dim=1)
    roll, pitch = torch.atan2(-y, -z), torch.asin(x.clamp(-1.0, 1.0))
    error = (command[:, 1] - roll).square() + (command[:, 2] - pitch).square()
    return torch.exp(-error / std**2)


def travel_error_l2(env: Env, command_name: str, heading_length: NonNegative = 0.0) -> torch.Tensor:
    """Squared distance, m^2, from where the velocity command would have brought the robot. Not in Isaac Lab.

    Args:
        env: the environment.
        command_name: a command that keeps the error, ``UniformVelocityTravelCommand``.
        heading_length: m that a radian of heading counts as.
    """
    travel, heading = kept_travel_error(env, command_name).unbind(dim=1)
    return travel.square() + (heading_length * heading).square()
