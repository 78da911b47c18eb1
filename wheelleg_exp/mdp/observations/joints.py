"""Joints: positions, velocities, efforts."""

from __future__ import annotations

import torch

from wheelleg_exp.errors import ConfigError
from wheelleg_exp.managers import Env, SceneEntityCfg, TermBase
from wheelleg_exp.sim.ids import picked

_ROBOT = SceneEntityCfg("robot")


def joint_pos(env: Env, asset_cfg: SceneEntityCfg = _ROBOT, measured: bool = True) -> torch.Tensor:
    """Joint positions, rad: what the encoders read, or with ``measured: false`` where the joints are."""
    data = env.scene[asset_cfg.name].data
    return picked(data.joint_pos_measured if measured else data.joint_pos, asset_cfg.joint_ids)


def joint_pos_rel(env: Env, asset_cfg: SceneEntityCfg = _ROBOT, measured: bool = True) -> torch.Tensor:
    """Joint positions (as ``joint_pos``) minus their defaults, rad. A wheel's angle grows without bound."""
    data = env.scene[asset_cfg.name].data
    return joint_pos(env, asset_cfg, measured) - picked(data.default_joint_pos, asset_cfg.joint_ids)


class joint_pos_limit_normalized(TermBase):
    """Joint positions on [-1, 1] between their soft limits: 2 (q - middle) / (high - low).

    Args:
        env: the environment.
        asset_cfg: the robot and its joints, each of them limited.
    """

    settings = ("_ids",)

    def __init__(self, env: Env, asset_cfg: SceneEntityCfg = _ROBOT) -> None:
        self._data, self._ids = env.scene[asset_cfg.name].data, asset_cfg.joint_ids
        if not picked(self._data.soft_joint_pos_limits, asset_cfg.joint_ids).isfinite().all():
            raise ConfigError(
                "a joint without limits cannot be normalised",
                key="asset_cfg.joint_names",
                expected="limited joints",
            )

    def __call__(self, env: Env) -> torch.Tensor:
        """Normalise."""
        del env
        low, high = picked(self._data.soft_joint_pos_limits, self._ids).unbind(dim=2)
        return 2.0 * (picked(self._data.joint_pos_measured, self._ids) - (low + high) / 2) / (high - low)


def joint_pos_sin_cos(env: Env, asset_cfg: SceneEntityCfg = _ROBOT) -> torch.Tensor:
    """Sines, then cosines, of the joint positions: a bounded view of wheel angles."""
    angle = joint_pos(env, asset_cfg)
    return torch.cat((torch.sin(angle), torch.cos(angle)), dim=1)


def joint_vel(env: Env, asset_cfg: SceneEntityCfg = _ROBOT) -> torch.Tensor:
    """Joint velocities, rad/s."""
    return picked(env.scene[asset_cfg.name].data.joint_vel, asset_cfg.joint_ids)


def joint_vel_rel(env: Env, asset_cfg: SceneEntityCfg = _ROBOT) -> torch.Tensor:
    """Joint velocities minus their defaults, rad/s."""
    data = env.scene[asset_cfg.name].data
    return picked(data.joint_vel, asset_cfg.joint_ids) - picked(data.default_joint_vel, asset_cfg.joint_ids)


def joint_acc(env: Env, asset_cfg: SceneEntityCfg = _ROBOT) -> torch.Tensor:
    """Joint accelerations over the last physics step, rad/s^2; 0 right after a reset. Not in Isaac Lab."""
    return picked(env.scene[asset_cfg.name].data.joint_acc, asset_cfg.joint_ids)


def joint_effort_commanded(env: Env, asset_cfg: SceneEntityCfg = _ROBOT) -> torch.Tensor:
    """Clipped drive torque at the start of the last physics step, N·m; 0 right after a reset."""
    return picked(env.scene[asset_cfg.name].data.applied_torque, asset_cfg.joint_ids)


joint_effort = joint_effort_commanded
