"""What sensors of the scene measure."""

from __future__ import annotations

import torch

from wheelleg_exp.constraints import NonNegative
from wheelleg_exp.errors import ConfigError, nearest_name
from wheelleg_exp.managers import Env, SceneEntityCfg
from wheelleg_exp.sim.ids import picked

_IMU = SceneEntityCfg("imu")
_CAMERA = SceneEntityCfg("tiled_camera")


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
    force = picked(env.scene.contact_sensor(sensor_cfg.name).max_force_norm(), sensor_cfg.body_ids)
    return (force > threshold).float()


def body_contact_forces(env: Env, sensor_cfg: SceneEntityCfg) -> torch.Tensor:
    """Net normal contact forces, N, world axes, body by body, (N, 3 B); not in Isaac Lab."""
    return picked(env.scene[sensor_cfg.name].data.net_forces_w, sensor_cfg.body_ids).flatten(1)


def body_air_time(env: Env, sensor_cfg: SceneEntityCfg) -> torch.Tensor:
    """How long each body has been in the air, s, 0 in contact; not in Isaac Lab."""
    return picked(env.scene[sensor_cfg.name].data.current_air_time, sensor_cfg.body_ids)


def image(
    env: Env,
    sensor_cfg: SceneEntityCfg = _CAMERA,
    data_type: str = "rgb",
    convert_perspective_to_orthogonal: bool = False,
    normalize: bool = True,
) -> torch.Tensor:
    """Picture of a camera, (N, height, width, channels).

    Args:
        env: the environment.
        sensor_cfg: the camera.
        data_type: which of its pictures: ``rgb``, ``depth``, ``distance_to_camera``, ...
        convert_perspective_to_orthogonal: turn ``distance_to_camera`` into distances along the camera's axis.
        normalize: colours from 0 to 1 less the mean of each channel in the picture; distances (m) that are infinite
            become 0; normals from 0 to 1.
    """
    data = env.scene[sensor_cfg.name].data
    if data_type not in data.output:
        raise ConfigError(
            f"the sensor '{sensor_cfg.name}' takes no pictures of '{data_type}'",
            key="data_type",
            expected="one of " + ", ".join(data.output),
            nearest=nearest_name(data_type, data.output),
        )
    picture = data.output[data_type].float()
    if data_type == "distance_to_camera" and convert_perspective_to_orthogonal:
        picture = picture * _cosines(data.intrinsic_matrices, picture)
    if not normalize:
        return picture
    if data_type == "rgb":
        picture = picture / 255.0
        return picture - picture.mean(dim=(1, 2), keepdim=True)
    if "distance_to" in data_type or "depth" in data_type:
        return picture.masked_fill(picture == torch.inf, 0.0)
    return (picture + 1.0) * 0.5 if "normals" in data_type else picture


def _cosines(intrinsics: torch.Tensor, picture: torch.Tensor) -> torch.Tensor:
    """Return the cosine between each pixel's ray and the axis, (N, height, width, 1), by the intrinsic matrices, px."""
    height, width = picture.shape[1:3]
    column = torch.arange(width, device=picture.device).view(1, 1, width, 1)
    row = torch.arange(height, device=picture.device).view(1, height, 1, 1)
    f_x, f_y, c_x, c_y = (intrinsics[:, i, j].view(-1, 1, 1, 1) for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
    return torch.rsqrt(1.0 + ((column - c_x) / f_x).square() + ((row - c_y) / f_y).square())
