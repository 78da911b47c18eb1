"""What sensors of the scene measure."""

from __future__ import annotations

import torch

from wheelleg_exp.constraints import NonNegative
from wheelleg_exp.managers import Env, SceneEntityCfg

_IMU = SceneEntityCfg("imu")


def height_scan(env: Env, sensor_cfg: SceneEntityCfg, offset: float = 0.5) -> torch.Tensor:
    """Height of a ray caster above where its rays hit, less ``offset``, m, (N, rays).

    A ray that hits nothing gives minus infinity: the observation needs a ``clip``.
    """
    data = env.scene[sensor_cfg.name].data
    return data.pos_w[:, 2:3] - data.ray_hits_w[..., 2] - offset


def imu_orientation(env: Env, asset_cfg: SceneEntityCfg = _IMU) -> torch.Tensor:
    """Orientation of an IMU in the world (w, x, y, z)."""
    return env.scene[asset_cfg.name].data.quat_w


def imu_projected_gravity(env: Env, asset_cfg: SceneEntityCfg = _IMU) -> torch.Tensor:
    """Unit gravity direction in an IMU's axes; upright is (0, 0, -1)."""
    return env.scene[asset_cfg.name].data.projected_gravity_b


def imu_ang_vel(env: Env, asset_cfg: SceneEntityCfg = _IMU) -> torch.Tensor:
    """Angular velocity that an IMU measures in its own axes, rad/s."""
    return env.scene[asset_cfg.name].data.ang_vel_b


def imu_lin_acc(env: Env, asset_cfg: SceneEntityCfg = _IMU) -> torch.Tensor:
    """Linear acceleration that an IMU measures in its own axes, m/s^2."""
    return env.scene[asset_cfg.name].data.lin_acc_b


def body_contacts(env: Env, sensor_cfg: SceneEntityCfg, threshold: NonNegative = 1.0) -> torch.Tensor:
    """Which bodies have exceeded ``threshold`` (N) within the contact sensor's history, 1 or 0; not in Isaac Lab."""
    force = env.scene.contact_sensor(sensor_cfg.name).max_force_norm()[:, sensor_cfg.body_ids]
    return (force > threshold).float()


def body_contact_forces(env: Env, sensor_cfg: SceneEntityCfg) -> torch.Tensor:
    """Net normal contact forces, N, world axes, body by body, (N, 3 B); not in Isaac Lab."""
    return env.scene[sensor_cfg.name].data.net_forces_w[:, sensor_cfg.body_ids].flatten(1)


def body_air_time(env: Env, sensor_cfg: SceneEntityCfg) -> torch.Tensor:
    """How long each body has been in the air, s, 0 in contact; not in Isaac Lab."""
    return env.scene[sensor_cfg.name].data.current_air_time[:, sensor_cfg.body_ids]
