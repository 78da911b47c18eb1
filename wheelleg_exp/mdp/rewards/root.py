"""Rewards on the motion and the pose of the root."""

from __future__ import annotations

import torch

from wheelleg_exp.managers import Env, SceneEntityCfg

_ROBOT = SceneEntityCfg("robot")


def lin_vel_z_l2(env: Env, asset_cfg: SceneEntityCfg = _ROBOT) -> torch.Tensor:
    """Squared vertical velocity of the root's centre of mass in link axes, (m/s)^2."""
    return env.scene[asset_cfg.name].data.root_lin_vel_b[:, 2].square()


def ang_vel_xy_l2(env: Env, asset_cfg: SceneEntityCfg = _ROBOT) -> torch.Tensor:
    """w_x^2 + w_y^2 of the root in link axes, (rad/s)^2."""
    return env.scene[asset_cfg.name].data.root_ang_vel_b[:, :2].square().sum(dim=1)


def flat_orientation_l2(env: Env, asset_cfg: SceneEntityCfg = _ROBOT) -> torch.Tensor:
    """g_x^2 + g_y^2 of the projected gravity: sin^2 of the tilt."""
    return env.scene[asset_cfg.name].data.projected_gravity_b[:, :2].square().sum(dim=1)


def pitch_orientation_l2(env: Env, asset_cfg: SceneEntityCfg = _ROBOT) -> torch.Tensor:
    """g_x^2 of the projected gravity: sin^2 of the pitch. Not in Isaac Lab."""
    return env.scene[asset_cfg.name].data.projected_gravity_b[:, 0].square()


def base_height_l2(env: Env, target_height: float, asset_cfg: SceneEntityCfg = _ROBOT) -> torch.Tensor:
    """(z - target)^2 of the root link in the world, m^2; for flat ground at z = 0."""
    return (env.scene[asset_cfg.name].data.root_pos_w[:, 2] - target_height).square()
