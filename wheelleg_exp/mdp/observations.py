"""Observation terms, (N, width)."""

from __future__ import annotations

import torch

from wheelleg_exp.errors import ConfigError
from wheelleg_exp.managers import Env, SceneEntityCfg, TermBase

_ROBOT = SceneEntityCfg("robot")


def base_pos_z(env: Env, asset_cfg: SceneEntityCfg = _ROBOT) -> torch.Tensor:
    """Height of the root link in the world, m; the environment's origin is not subtracted."""
    return env.scene[asset_cfg.name].data.root_pos_w[:, 2:3]


def base_lin_vel(env: Env, asset_cfg: SceneEntityCfg = _ROBOT) -> torch.Tensor:
    """Velocity of the root body's centre of mass in link axes, m/s."""
    return env.scene[asset_cfg.name].data.root_lin_vel_b


def base_ang_vel(env: Env, asset_cfg: SceneEntityCfg = _ROBOT) -> torch.Tensor:
    """Angular velocity of the root link in its own axes, rad/s."""
    return env.scene[asset_cfg.name].data.root_ang_vel_b


def root_link_lin_vel(env: Env, asset_cfg: SceneEntityCfg = _ROBOT) -> torch.Tensor:
    """Velocity of the root link's origin in link axes, m/s."""
    return env.scene[asset_cfg.name].data.root_link_lin_vel_b


def projected_gravity(env: Env, asset_cfg: SceneEntityCfg = _ROBOT) -> torch.Tensor:
    """Unit gravity direction in link axes; upright is (0, 0, -1)."""
    return env.scene[asset_cfg.name].data.projected_gravity_b


def root_pos_w(env: Env, asset_cfg: SceneEntityCfg = _ROBOT) -> torch.Tensor:
    """Position of the root link relative to the environment's origin, m."""
    return env.scene[asset_cfg.name].data.root_pos_w - env.scene.env_origins


def root_quat_w(env: Env, make_quat_unique: bool = False, asset_cfg: SceneEntityCfg = _ROBOT) -> torch.Tensor:
    """Orientation of the root link (w, x, y, z); with ``make_quat_unique`` w is not negative."""
    quat = env.scene[asset_cfg.name].data.root_quat_w
    return torch.where(quat[:, 0:1] < 0, -quat, quat) if make_quat_unique else quat


def root_lin_vel_w(env: Env, asset_cfg: SceneEntityCfg = _ROBOT) -> torch.Tensor:
    """Velocity of the root body's centre of mass in world axes, m/s."""
    return env.scene[asset_cfg.name].data.root_lin_vel_w


def root_ang_vel_w(env: Env, asset_cfg: SceneEntityCfg = _ROBOT) -> torch.Tensor:
    """Angular velocity of the root link in world axes, rad/s."""
    return env.scene[asset_cfg.name].data.root_ang_vel_w


def joint_pos(env: Env, asset_cfg: SceneEntityCfg = _ROBOT) -> torch.Tensor:
    """Joint positions, rad."""
    return env.scene[asset_cfg.name].data.joint_pos[:, asset_cfg.joint_ids]


def joint_pos_rel(env: Env, asset_cfg: SceneEntityCfg = _ROBOT) -> torch.Tensor:
    """Joint positions minus their defaults, rad. A wheel's angle grows without bound."""
    data = env.scene[asset_cfg.name].data
    return data.joint_pos[:, asset_cfg.joint_ids] - data.default_joint_pos[:, asset_cfg.joint_ids]


class joint_pos_limit_normalized(TermBase):
    """Joint positions on [-1, 1] between their soft limits: 2 (q - middle) / (high - low).

    Args:
        env: the environment.
        asset_cfg: the robot and its joints, each of them limited.
    """

    settings = ("_ids",)

    def __init__(self, env: Env, asset_cfg: SceneEntityCfg = _ROBOT) -> None:
        self._data, self._ids = env.scene[asset_cfg.name].data, asset_cfg.joint_ids
        if not self._data.soft_joint_pos_limits[:, asset_cfg.joint_ids].isfinite().all():
            raise ConfigError(
                "a joint without limits cannot be normalised",
                key="asset_cfg.joint_names",
                expected="limited joints",
            )

    def __call__(self, env: Env) -> torch.Tensor:
        """Normalise."""
        del env
        low, high = self._data.soft_joint_pos_limits[:, self._ids].unbind(dim=2)
        return 2.0 * (self._data.joint_pos[:, self._ids] - (low + high) / 2) / (high - low)


def joint_pos_sin_cos(env: Env, asset_cfg: SceneEntityCfg = _ROBOT) -> torch.Tensor:
    """Sines, then cosines, of the joint positions: a bounded view of wheel angles."""
    angle = env.scene[asset_cfg.name].data.joint_pos[:, asset_cfg.joint_ids]
    return torch.cat((torch.sin(angle), torch.cos(angle)), dim=1)


def joint_vel(env: Env, asset_cfg: SceneEntityCfg = _ROBOT) -> torch.Tensor:
    """Joint velocities, rad/s."""
    return env.scene[asset_cfg.name].data.joint_vel[:, asset_cfg.joint_ids]


def joint_vel_rel(env: Env, asset_cfg: SceneEntityCfg = _ROBOT) -> torch.Tensor:
    """Joint velocities minus their defaults, rad/s."""
    data = env.scene[asset_cfg.name].data
    return data.joint_vel[:, asset_cfg.joint_ids] - data.default_joint_vel[:, asset_cfg.joint_ids]


def joint_effort_commanded(env: Env, asset_cfg: SceneEntityCfg = _ROBOT) -> torch.Tensor:
    """Clipped drive torque at the start of the last physics step, N·m; 0 right after a reset."""
    return env.scene[asset_cfg.name].data.applied_torque[:, asset_cfg.joint_ids]


joint_effort = joint_effort_commanded


def last_action(env: Env, action_name: str | None = None) -> torch.Tensor:
    """Raw action of the whole manager, or of one term; 0 after a reset."""
    if action_name is None:
        return env.action_manager.action
    return env.action_manager.get_action_term(action_name).raw_actions


def generated_commands(env: Env, command_name: str) -> torch.Tensor:
    """The present command of a term."""
    return env.command_manager.get_command(command_name)


def current_time_s(env: Env) -> torch.Tensor:
    """Time since the episode began, s."""
    return env.episode_length_buf.unsqueeze(1) * env.step_dt


def remaining_time_s(env: Env) -> torch.Tensor:
    """Time until the episode's end, s."""
    return env.max_episode_length_s - env.episode_length_buf.unsqueeze(1) * env.step_dt
