"""Rewards on joints: motion, effort, pose and limits."""

from __future__ import annotations

import torch

from wheelleg_exp.constraints import Positive
from wheelleg_exp.errors import ConfigError
from wheelleg_exp.managers import Env, SceneEntityCfg

_ROBOT = SceneEntityCfg("robot")


def joint_torques_l2(env: Env, asset_cfg: SceneEntityCfg = _ROBOT) -> torch.Tensor:
    """Sum of squared applied torques, (N·m)^2."""
    return env.scene[asset_cfg.name].data.applied_torque[:, asset_cfg.joint_ids].square().sum(dim=1)


def joint_vel_l1(env: Env, asset_cfg: SceneEntityCfg = _ROBOT) -> torch.Tensor:
    """Sum of joint speeds, rad/s."""
    return env.scene[asset_cfg.name].data.joint_vel[:, asset_cfg.joint_ids].abs().sum(dim=1)


def joint_vel_l2(env: Env, asset_cfg: SceneEntityCfg = _ROBOT) -> torch.Tensor:
    """Sum of squared joint velocities, (rad/s)^2."""
    return env.scene[asset_cfg.name].data.joint_vel[:, asset_cfg.joint_ids].square().sum(dim=1)


def joint_acc_l2(env: Env, asset_cfg: SceneEntityCfg = _ROBOT) -> torch.Tensor:
    """Sum of squared joint accelerations over the last physics step, (rad/s^2)^2."""
    return env.scene[asset_cfg.name].data.joint_acc[:, asset_cfg.joint_ids].square().sum(dim=1)


def joint_deviation_l1(env: Env, asset_cfg: SceneEntityCfg = _ROBOT) -> torch.Tensor:
    """Sum of the distances of the joints from their defaults, rad."""
    data = env.scene[asset_cfg.name].data
    ids = asset_cfg.joint_ids
    return (data.joint_pos[:, ids] - data.default_joint_pos[:, ids]).abs().sum(dim=1)


def joint_symmetry_l1(
    env: Env, left_cfg: SceneEntityCfg, right_cfg: SceneEntityCfg, mirrored: bool = False
) -> torch.Tensor:
    """Sum of |q_left - q_right| over pairs of joints, rad. Not in Isaac Lab.

    The pairs are the joints of the two entities in order; give both the same ``preserve_order``. ``mirrored`` joints
    turn in opposite senses on the two sides, so that a symmetric pose has |q_left + q_right| = 0.
    """
    left = env.scene[left_cfg.name].data.joint_pos[:, left_cfg.joint_ids]
    right = env.scene[right_cfg.name].data.joint_pos[:, right_cfg.joint_ids]
    if left.shape != right.shape:
        raise ConfigError(
            f"{left.shape[1]} left and {right.shape[1]} right joints", key="right_cfg.joint_names", expected="pairs"
        )
    return (left + right if mirrored else left - right).abs().sum(dim=1)


def joint_pos_limits(env: Env, asset_cfg: SceneEntityCfg = _ROBOT) -> torch.Tensor:
    """Sum of the distances of the joints beyond their soft limits, rad."""
    data = env.scene[asset_cfg.name].data
    q = data.joint_pos[:, asset_cfg.joint_ids]
    low, high = data.soft_joint_pos_limits[:, asset_cfg.joint_ids].unbind(dim=2)
    return ((low - q).clamp(min=0.0) + (q - high).clamp(min=0.0)).sum(dim=1)


def joint_vel_limits(env: Env, soft_ratio: Positive, asset_cfg: SceneEntityCfg = _ROBOT) -> torch.Tensor:
    """Sum of clip(|qd| - limit * ratio, 0, 1), rad/s."""
    data = env.scene[asset_cfg.name].data
    limit = data.soft_joint_vel_limits[:, asset_cfg.joint_ids] * soft_ratio
    return (data.joint_vel[:, asset_cfg.joint_ids].abs() - limit).clamp(0.0, 1.0).sum(dim=1)


def applied_torque_limits(env: Env, asset_cfg: SceneEntityCfg = _ROBOT) -> torch.Tensor:
    """Sum of |applied - computed| torque: what the effort limit cut off, N·m."""
    data = env.scene[asset_cfg.name].data
    ids = asset_cfg.joint_ids
    return (data.applied_torque[:, ids] - data.computed_torque[:, ids]).abs().sum(dim=1)
