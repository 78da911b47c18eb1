"""Rewards on the motion and the pose of the root, and on the acceleration of bodies."""

from __future__ import annotations

import torch

from wheelleg_exp.constraints import Positive
from wheelleg_exp.managers import Env, SceneEntityCfg
from wheelleg_exp.mdp.ground import height_over_ground
from wheelleg_exp.sim.ids import picked

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


def flat_orientation_exp(env: Env, std: Positive, asset_cfg: SceneEntityCfg = _ROBOT) -> torch.Tensor:
    """exp(-(g_x^2 + g_y^2) / std^2) of the projected gravity: g_x^2 + g_y^2 is sin^2 of the tilt. Not in Isaac Lab.

    Unlike a square it still tells one degree from two, and costs a robot that falls no more than its weight. As with
    the square, one that hangs upside down counts as upright.

    Args:
        env: the environment.
        std: sine of the tilt that leaves 1/e of the reward.
        asset_cfg: the robot.
    """
    return torch.exp(-flat_orientation_l2(env, asset_cfg) / std**2)


def pitch_orientation_l2(env: Env, asset_cfg: SceneEntityCfg = _ROBOT) -> torch.Tensor:
    """g_x^2 of the projected gravity: sin^2 of the pitch. Not in Isaac Lab."""
    return env.scene[asset_cfg.name].data.projected_gravity_b[:, 0].square()


def upward(env: Env, asset_cfg: SceneEntityCfg = _ROBOT) -> torch.Tensor:
    """(1 - g_z)^2 of the projected gravity: 4 upright, 1 lying, 0 upside down. Not in Isaac Lab."""
    return (1.0 - env.scene[asset_cfg.name].data.projected_gravity_b[:, 2]).square()


def base_height_l2(
    env: Env,
    target_height: float,
    asset_cfg: SceneEntityCfg = _ROBOT,
    sensor_cfg: SceneEntityCfg | None = None,
) -> torch.Tensor:
    """(z - target)^2 of the root link in the world, m^2; for flat ground at z = 0.

    With a ray caster the target counts from the mean height of its hits, so that one ray that misses makes the value
    infinite, as in Isaac Lab. ``base_height_over_ground_l2`` needs no sensor.
    """
    height = env.scene[asset_cfg.name].data.root_pos_w[:, 2]
    if sensor_cfg is not None:
        height = height - env.scene[sensor_cfg.name].data.ray_hits_w[..., 2].mean(dim=1)
    return (height - target_height).square()


def base_height_over_ground_l2(env: Env, target_height: float, asset_cfg: SceneEntityCfg = _ROBOT) -> torch.Tensor:
    """(h - target)^2 of the root link's height h above the ground straight below, m^2. Not in Isaac Lab."""
    height = height_over_ground(env, env.scene[asset_cfg.name].data.root_pos_w)
    return (height - target_height).square()


def base_height_exp(env: Env, target_height: float, std: Positive, asset_cfg: SceneEntityCfg = _ROBOT) -> torch.Tensor:
    """exp(-(h - target)^2 / std^2) of the root link's height h above the ground straight below. Not in Isaac Lab.

    Unlike a square it still tells a millimetre from two.

    Args:
        env: the environment.
        target_height: m.
        std: error that leaves 1/e of the reward, m.
        asset_cfg: the robot.
    """
    height = height_over_ground(env, env.scene[asset_cfg.name].data.root_pos_w)
    return torch.exp(-((height - target_height) / std).square())


def body_lin_acc_norm_sum(env: Env, asset_cfg: SceneEntityCfg = _ROBOT) -> torch.Tensor:
    """Sum of the norms of the bodies' linear accelerations, not squared, m/s^2.

    Isaac Lab calls it ``body_lin_acc_l2``, which names a square.
    """
    acceleration = picked(env.scene[asset_cfg.name].data.body_lin_acc_w, asset_cfg.body_ids)
    return torch.linalg.vector_norm(acceleration, dim=-1).sum(dim=1)


body_lin_acc_l2 = body_lin_acc_norm_sum
