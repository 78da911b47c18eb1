"""The root: its place, its orientation, its motion."""

from __future__ import annotations

import torch

from wheelleg_exp.managers import Env, SceneEntityCfg

_ROBOT = SceneEntityCfg("robot")


def base_pos_z(env: Env, asset_cfg: SceneEntityCfg = _ROBOT) -> torch.Tensor:
    """Height of the root link in the world, m; the environment's origin is not subtracted."""
    return env.scene[asset_cfg.name].data.root_pos_w[:, 2:3]


def base_height(env: Env, asset_cfg: SceneEntityCfg = _ROBOT) -> torch.Tensor:
    """Height of the root link above the ground below it, m; not in Isaac Lab."""
    position = env.scene[asset_cfg.name].data.root_pos_w
    return (position[:, 2] - env.scene.terrain.height_at(position[:, :2])).unsqueeze(1)


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


def base_roll_pitch(env: Env, asset_cfg: SceneEntityCfg = _ROBOT) -> torch.Tensor:
    """Roll and pitch of the root link, rad, of R = Rz(yaw) Ry(pitch) Rx(roll); not in Isaac Lab."""
    x, y, z = env.scene[asset_cfg.name].data.projected_gravity_b.unbind(dim=1)
    return torch.stack((torch.atan2(-y, -z), torch.asin(x.clamp(-1.0, 1.0))), dim=1)


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
