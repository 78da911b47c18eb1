"""Rewards on joints: motion, effort, pose and limits."""

from __future__ import annotations

import torch

from wheelleg_exp.constraints import NonNegative, Positive
from wheelleg_exp.errors import ConfigError
from wheelleg_exp.managers import Env, SceneEntityCfg, TermBase
from wheelleg_exp.sim.ids import fill_rows, picked

_ROBOT = SceneEntityCfg("robot")


def joint_torques_l2(env: Env, asset_cfg: SceneEntityCfg = _ROBOT) -> torch.Tensor:
    """Sum of squared applied torques, (N·m)^2."""
    return picked(env.scene[asset_cfg.name].data.applied_torque, asset_cfg.joint_ids).square().sum(dim=1)


def joint_power(env: Env, asset_cfg: SceneEntityCfg = _ROBOT, positive_only: bool = False) -> torch.Tensor:
    """Sum of |torque * velocity| over joints, W. Not in Isaac Lab.

    With ``positive_only`` braking joints cost nothing: the sum of what the drives put in.
    """
    data = env.scene[asset_cfg.name].data
    power = picked(data.applied_torque, asset_cfg.joint_ids) * picked(data.joint_vel, asset_cfg.joint_ids)
    return (power.clamp(min=0.0) if positive_only else power.abs()).sum(dim=1)


def joint_vel_l1(env: Env, asset_cfg: SceneEntityCfg = _ROBOT) -> torch.Tensor:
    """Sum of joint speeds, rad/s."""
    return picked(env.scene[asset_cfg.name].data.joint_vel, asset_cfg.joint_ids).abs().sum(dim=1)


def joint_vel_l2(env: Env, asset_cfg: SceneEntityCfg = _ROBOT) -> torch.Tensor:
    """Sum of squared joint velocities, (rad/s)^2."""
    return picked(env.scene[asset_cfg.name].data.joint_vel, asset_cfg.joint_ids).square().sum(dim=1)


def joint_acc_l2(env: Env, asset_cfg: SceneEntityCfg = _ROBOT) -> torch.Tensor:
    """Sum of squared joint accelerations over the last physics step, (rad/s^2)^2."""
    return picked(env.scene[asset_cfg.name].data.joint_acc, asset_cfg.joint_ids).square().sum(dim=1)


class joint_vel_rate_l2(TermBase):
    """Sum of squared changes of joint velocity over a control step, (rad/s)^2; 0 in an episode's first step.

    Not in Isaac Lab: wheels that turn smoothly. ``joint_acc_l2`` sees the last physics step alone.

    Args:
        env: the environment.
        asset_cfg: the joints.
    """

    def __init__(self, env: Env, asset_cfg: SceneEntityCfg = _ROBOT) -> None:
        self._joints = asset_cfg
        self._last = torch.zeros_like(self._velocity(env))
        self._has_last = torch.zeros(env.num_envs, 1, device=env.device)

    def __call__(self, env: Env) -> torch.Tensor:
        """Compare with the last step."""
        velocity = self._velocity(env)
        change = (velocity - self._last) * self._has_last
        self._last.copy_(velocity)
        self._has_last.fill_(1.0)
        return change.square().sum(dim=1)

    def reset(self, env_ids: torch.Tensor) -> None:
        """Forget the velocities of ``env_ids``."""
        fill_rows(self._has_last, env_ids, 0.0)

    def _velocity(self, env: Env) -> torch.Tensor:
        velocity: torch.Tensor = picked(env.scene[self._joints.name].data.joint_vel, self._joints.joint_ids)
        return velocity


def joint_deviation_l1(env: Env, asset_cfg: SceneEntityCfg = _ROBOT) -> torch.Tensor:
    """Sum of the distances of the joints from their defaults, rad."""
    data = env.scene[asset_cfg.name].data
    ids = asset_cfg.joint_ids
    return (picked(data.joint_pos, ids) - picked(data.default_joint_pos, ids)).abs().sum(dim=1)


def stand_still_joint_deviation_l1(
    env: Env, command_name: str, command_threshold: NonNegative = 0.06, asset_cfg: SceneEntityCfg = _ROBOT
) -> torch.Tensor:
    """``joint_deviation_l1`` where the commanded planar velocity is below ``command_threshold`` (m/s), else 0."""
    speed = torch.linalg.vector_norm(env.command_manager.get_command(command_name)[:, :2], dim=1)
    return joint_deviation_l1(env, asset_cfg) * (speed < command_threshold)


def joint_symmetry_l1(
    env: Env, left_cfg: SceneEntityCfg, right_cfg: SceneEntityCfg, mirrored: bool = False
) -> torch.Tensor:
    """Sum of |q_left - q_right| over pairs of joints, rad. Not in Isaac Lab.

    The pairs are the joints of the two entities in order; give both the same ``preserve_order``. ``mirrored`` joints
    turn in opposite senses on the two sides, so that a symmetric pose has |q_left + q_right| = 0.
    """
    left = picked(env.scene[left_cfg.name].data.joint_pos, left_cfg.joint_ids)
    right = picked(env.scene[right_cfg.name].data.joint_pos, right_cfg.joint_ids)
    if left.shape != right.shape:
        raise ConfigError(
            f"{left.shape[1]} left and {right.shape[1]} right joints", key="right_cfg.joint_names", expected="pairs"
        )
    return (left + right if mirrored else left - right).abs().sum(dim=1)


def joint_pos_limits(env: Env, asset_cfg: SceneEntityCfg = _ROBOT) -> torch.Tensor:
    """Sum of the distances of the joints beyond their soft limits, rad."""
    data = env.scene[asset_cfg.name].data
    q = picked(data.joint_pos, asset_cfg.joint_ids)
    low, high = picked(data.soft_joint_pos_limits, asset_cfg.joint_ids).unbind(dim=2)
    return ((low - q).clamp(min=0.0) + (q - high).clamp(min=0.0)).sum(dim=1)


def joint_vel_limits(env: Env, soft_ratio: Positive, asset_cfg: SceneEntityCfg = _ROBOT) -> torch.Tensor:
    """Sum of clip(|qd| - limit * ratio, 0, 1), rad/s."""
    data = env.scene[asset_cfg.name].data
    limit = picked(data.soft_joint_vel_limits, asset_cfg.joint_ids) * soft_ratio
    return (picked(data.joint_vel, asset_cfg.joint_ids).abs() - limit).clamp(0.0, 1.0).sum(dim=1)


def applied_torque_limits(env: Env, asset_cfg: SceneEntityCfg = _ROBOT) -> torch.Tensor:
    """Sum of |applied - computed| torque: what the effort limit cut off, N·m."""
    data = env.scene[asset_cfg.name].data
    ids = asset_cfg.joint_ids
    return (picked(data.applied_torque, ids) - picked(data.computed_torque, ids)).abs().sum(dim=1)
