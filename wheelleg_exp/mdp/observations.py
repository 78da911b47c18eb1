"""Observation terms, (N, width): the root, joints, bodies, sensors, commands, and time."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Annotated

import torch

from wheelleg_exp.constraints import NonNegative, NotEmpty, Positive
from wheelleg_exp.errors import ConfigError, nearest_name
from wheelleg_exp.managers import Env, SceneEntityCfg, TermBase
from wheelleg_exp.mdp.commands.command_ranges import command_of
from wheelleg_exp.mdp.commands.pose_commands import WheeledBasePoseCommand
from wheelleg_exp.mdp.commands.velocity_commands import integrated_travel_error
from wheelleg_exp.mdp.root_motion import height_over_ground, roll_pitch
from wheelleg_exp.sim import rotation
from wheelleg_exp.sim.ids import picked

_ROBOT = SceneEntityCfg("robot")


def base_pos_z(env: Env, asset_cfg: SceneEntityCfg = _ROBOT) -> torch.Tensor:
    """Height of the root link in the world frame, m; the height of the environment's origin is not subtracted."""
    return env.scene.articulations[asset_cfg.name].data.root_pos_w[:, 2:3]


def base_height(env: Env, asset_cfg: SceneEntityCfg = _ROBOT) -> torch.Tensor:
    """Height of the root link above the ground, m."""
    return height_over_ground(env, env.scene.articulations[asset_cfg.name].data.root_pos_w).unsqueeze(1)


def base_lin_vel(env: Env, asset_cfg: SceneEntityCfg = _ROBOT) -> torch.Tensor:
    """Velocity of the root body's centre of mass in the axes of the root link, m/s."""
    return env.scene.articulations[asset_cfg.name].data.root_lin_vel_b


def base_ang_vel(env: Env, asset_cfg: SceneEntityCfg = _ROBOT) -> torch.Tensor:
    """Angular velocity of the root link in the axes of the root link, rad/s, as the robot's IMU measures it."""
    return env.scene.articulations[asset_cfg.name].data.root_ang_vel_measured


def root_link_lin_vel(env: Env, asset_cfg: SceneEntityCfg = _ROBOT) -> torch.Tensor:
    """Velocity of the root link's origin in the axes of the root link, m/s."""
    return env.scene.articulations[asset_cfg.name].data.root_link_lin_vel_b


def projected_gravity(env: Env, asset_cfg: SceneEntityCfg = _ROBOT) -> torch.Tensor:
    """Unit vector of gravity in the axes of the root link, as the robot's IMU measures it; upright: (0, 0, -1)."""
    return env.scene.articulations[asset_cfg.name].data.projected_gravity_measured


def base_roll_pitch(env: Env, asset_cfg: SceneEntityCfg = _ROBOT) -> torch.Tensor:
    """Roll and pitch of the root link, rad, as the robot's IMU measures them, with R = Rz(yaw) Ry(pitch) Rx(roll)."""
    return torch.stack(roll_pitch(projected_gravity(env, asset_cfg)), dim=1)


def root_pos_w(env: Env, asset_cfg: SceneEntityCfg = _ROBOT) -> torch.Tensor:
    """Position of the root link relative to the environment's origin, m."""
    return env.scene.articulations[asset_cfg.name].data.root_pos_w - env.scene.env_origins


def root_quat_w(env: Env, make_quat_unique: bool = False, asset_cfg: SceneEntityCfg = _ROBOT) -> torch.Tensor:
    """Orientation of the root link (w, x, y, z); with ``make_quat_unique``, w is not negative."""
    quat = env.scene.articulations[asset_cfg.name].data.root_quat_w
    return torch.where(quat[:, 0:1] < 0, -quat, quat) if make_quat_unique else quat


def root_lin_vel_w(env: Env, asset_cfg: SceneEntityCfg = _ROBOT) -> torch.Tensor:
    """Velocity of the root body's centre of mass in world axes, m/s."""
    return env.scene.articulations[asset_cfg.name].data.root_lin_vel_w


def root_ang_vel_w(env: Env, asset_cfg: SceneEntityCfg = _ROBOT) -> torch.Tensor:
    """Angular velocity of the root link in world axes, rad/s."""
    return env.scene.articulations[asset_cfg.name].data.root_ang_vel_w


def joint_pos(env: Env, asset_cfg: SceneEntityCfg = _ROBOT, measured: bool = True) -> torch.Tensor:
    """Joint positions, rad, as the encoders read them, or the true positions with ``measured: false``."""
    data = env.scene.articulations[asset_cfg.name].data
    return picked(data.joint_pos_measured if measured else data.joint_pos, asset_cfg.joint_ids)


def joint_pos_rel(env: Env, asset_cfg: SceneEntityCfg = _ROBOT, measured: bool = True) -> torch.Tensor:
    """Joint positions (as in ``joint_pos``) minus the default ones, rad; unbounded for a wheel that rolls."""
    data = env.scene.articulations[asset_cfg.name].data
    return joint_pos(env, asset_cfg, measured) - picked(data.default_joint_pos, asset_cfg.joint_ids)


class joint_pos_limit_normalized(TermBase):
    """Positions of limited joints on [-1, 1] between their soft limits: 2 (q - middle) / (high - low)."""

    def __init__(self, env: Env, asset_cfg: SceneEntityCfg = _ROBOT) -> None:
        self._data, self._ids = env.scene.articulations[asset_cfg.name].data, asset_cfg.joint_ids
        if not picked(self._data.soft_joint_pos_limits, asset_cfg.joint_ids).isfinite().all():
            message = "the position of a joint without limits cannot be normalised"
            raise ConfigError(message, key="asset_cfg.joint_names", expected="limited joints")

    def __call__(self, env: Env) -> torch.Tensor:
        del env
        low, high = picked(self._data.soft_joint_pos_limits, self._ids).unbind(dim=2)
        return 2.0 * (picked(self._data.joint_pos_measured, self._ids) - (low + high) / 2) / (high - low)


def joint_pos_sin_cos(env: Env, asset_cfg: SceneEntityCfg = _ROBOT) -> torch.Tensor:
    """Sines, then cosines, of all joint positions; unlike angles, both are bounded for rolling wheels."""
    angle = joint_pos(env, asset_cfg)
    return torch.cat((torch.sin(angle), torch.cos(angle)), dim=1)


def joint_vel(env: Env, asset_cfg: SceneEntityCfg = _ROBOT) -> torch.Tensor:
    """Joint velocities, rad/s."""
    return picked(env.scene.articulations[asset_cfg.name].data.joint_vel, asset_cfg.joint_ids)


def joint_vel_rel(env: Env, asset_cfg: SceneEntityCfg = _ROBOT) -> torch.Tensor:
    """Joint velocities minus the default joint velocities, rad/s."""
    data = env.scene.articulations[asset_cfg.name].data
    return picked(data.joint_vel, asset_cfg.joint_ids) - picked(data.default_joint_vel, asset_cfg.joint_ids)


def joint_acc(env: Env, asset_cfg: SceneEntityCfg = _ROBOT) -> torch.Tensor:
    """Accelerations of the joints over the last physics step, rad/s^2; 0 right after a reset. Not in Isaac Lab."""
    return picked(env.scene.articulations[asset_cfg.name].data.joint_acc, asset_cfg.joint_ids)


def joint_effort_commanded(env: Env, asset_cfg: SceneEntityCfg = _ROBOT) -> torch.Tensor:
    """Clipped torque of each joint's drive at the start of the last physics step, N·m; 0 right after a reset."""
    return picked(env.scene.articulations[asset_cfg.name].data.applied_torque, asset_cfg.joint_ids)


joint_effort = joint_effort_commanded


def body_pose_w(env: Env, asset_cfg: SceneEntityCfg = _ROBOT) -> torch.Tensor:
    """Poses of the links, body by body: position from the environment's origin, m, and (w, x, y, z), (N, 7 B)."""
    data = env.scene.articulations[asset_cfg.name].data
    position = picked(data.body_pos_w, asset_cfg.body_ids) - env.scene.env_origins.unsqueeze(1)
    return torch.cat((position, picked(data.body_quat_w, asset_cfg.body_ids)), dim=2).flatten(1)


def body_projected_gravity_b(env: Env, asset_cfg: SceneEntityCfg = _ROBOT) -> torch.Tensor:
    """Unit vector of gravity in the axes of each of B links, (N, 3 B)."""
    data = env.scene.articulations[asset_cfg.name].data
    gravity = rotation.rotate(data.root_rot_w, data.projected_gravity_b)
    turned = torch.matmul(gravity.view(-1, 1, 1, 3), picked(data.body_rot_w, asset_cfg.body_ids))
    return turned.flatten(1)


_IMU = SceneEntityCfg("imu")
_CAMERA = SceneEntityCfg("tiled_camera")


def height_scan(env: Env, sensor_cfg: SceneEntityCfg, offset: float = 0.5) -> torch.Tensor:
    """Heights of a ray caster above its rays' hits minus ``offset``, m, (N, rays). Set ``clip``: a miss gives -inf."""
    data = env.scene[sensor_cfg.name].data
    found: torch.Tensor = data.pos_w[:, 2:3] - data.ray_hits_w[..., 2] - offset
    return found


def imu_orientation(env: Env, asset_cfg: SceneEntityCfg = _IMU) -> torch.Tensor:
    """Orientation of an IMU in the world (w, x, y, z)."""
    found: torch.Tensor = env.scene[asset_cfg.name].data.quat_w
    return found


def imu_projected_gravity(env: Env, asset_cfg: SceneEntityCfg = _IMU) -> torch.Tensor:
    """Return the unit vector of gravity in the axes of an IMU, which is (0, 0, -1) for an upright IMU."""
    found: torch.Tensor = env.scene[asset_cfg.name].data.projected_gravity_b
    return found


def imu_ang_vel(env: Env, asset_cfg: SceneEntityCfg = _IMU) -> torch.Tensor:
    """Angular velocity that an IMU measures in its own axes, rad/s."""
    found: torch.Tensor = env.scene[asset_cfg.name].data.ang_vel_b
    return found


def imu_lin_acc(env: Env, asset_cfg: SceneEntityCfg = _IMU) -> torch.Tensor:
    """Linear acceleration that an IMU measures in its own axes, m/s^2."""
    found: torch.Tensor = env.scene[asset_cfg.name].data.lin_acc_b
    return found


def body_contacts(env: Env, sensor_cfg: SceneEntityCfg, threshold: NonNegative = 1.0) -> torch.Tensor:
    """1 for bodies whose contact force exceeded ``threshold`` (N) in the sensor's history, else 0; not in Isaac Lab."""
    force = picked(env.scene.contact_sensor(sensor_cfg.name).max_force_norm(), sensor_cfg.body_ids)
    return (force > threshold).float()


def body_contact_forces(env: Env, sensor_cfg: SceneEntityCfg) -> torch.Tensor:
    """Sum of the normal contact forces on each of B bodies, newtons, world axes, (N, 3 B)."""
    return picked(env.scene[sensor_cfg.name].data.net_forces_w, sensor_cfg.body_ids).flatten(1)


def body_air_time(env: Env, sensor_cfg: SceneEntityCfg) -> torch.Tensor:
    """Time since each sensed body lost contact, s; 0 for a body that is in contact."""
    return picked(env.scene[sensor_cfg.name].data.current_air_time, sensor_cfg.body_ids)


def image(
    env: Env,
    sensor_cfg: SceneEntityCfg = _CAMERA,
    data_type: str = "rgb",
    convert_perspective_to_orthogonal: bool = False,
    normalize: bool = True,
) -> torch.Tensor:
    """Image of a camera, (N, height, width, channels).

    Args:
        sensor_cfg: the camera.
        data_type: kind of the image: ``rgb``, ``depth``, ``distance_to_camera``, ...
        convert_perspective_to_orthogonal: convert ``distance_to_camera`` to distances along the camera's axis.
        normalize: scale colours to [0, 1] minus the channel's mean, infinite distances (m) to 0, and normals to [0, 1].
    """
    data = env.scene[sensor_cfg.name].data
    if data_type not in data.output:
        known, nearest = "one of " + ", ".join(data.output), nearest_name(data_type, data.output)
        message = f"the sensor '{sensor_cfg.name}' has no images of the type '{data_type}'"
        raise ConfigError(message, key="data_type", expected=known, nearest=nearest)
    picture: torch.Tensor = data.output[data_type].float()
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
    """Return the cosine of the angle between each pixel's ray and the axis of its camera, (N, height, width, 1)."""
    height, width = picture.shape[1:3]
    column = torch.arange(width, device=picture.device).view(1, 1, width, 1)
    row = torch.arange(height, device=picture.device).view(1, height, 1, 1)
    f_x, f_y, c_x, c_y = (intrinsics[:, i, j].view(-1, 1, 1, 1) for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
    return torch.rsqrt(1.0 + ((column - c_x) / f_x).square() + ((row - c_y) / f_y).square())


def last_action(env: Env, action_name: str | None = None) -> torch.Tensor:
    """Last raw action of all action terms, or of one selected action term; 0 right after a reset."""
    if action_name is None:
        return env.action_manager.action
    return env.action_manager.get_term(action_name).raw_actions


def generated_commands(env: Env, command_name: str) -> torch.Tensor:
    """The present command of a command term, (N, k)."""
    return env.command_manager.get_command(command_name)


def travel_error(env: Env, command_name: str) -> torch.Tensor:
    """Distance error (travelled minus commanded distance), m, and heading error (turned minus commanded angle), rad.

    Not in Isaac Lab. The command must be a ``UniformVelocityTravelCommand``, which integrates the errors.
    """
    return integrated_travel_error(env, command_name)


def height_error(env: Env, command_name: str) -> torch.Tensor:
    """Measured minus commanded height of a ``WheeledBasePoseCommand``, m, and its integral, m·s. Not in Isaac Lab."""
    term = command_of(env, command_name, WheeledBasePoseCommand, "measure the height over the wheels")
    return torch.stack((term.height_error(), term.integrated_error), dim=1)


def current_time_s(env: Env) -> torch.Tensor:
    """Time since the start of the episode, s."""
    return env.episode_length_buf.unsqueeze(1) * env.step_dt


def remaining_time_s(env: Env) -> torch.Tensor:
    """Time until the end of the episode, s."""
    return env.max_episode_length_s - env.episode_length_buf.unsqueeze(1) * env.step_dt


def gait_phase(env: Env, period: Positive, offsets: Annotated[Sequence[float], NotEmpty()] = (0.0,)) -> torch.Tensor:
    """Sines, then cosines, of a gait's phase 2 pi (t / period + offset) at k phase offsets, (N, 2 k). Not in Isaac Lab.

    Args:
        period: duration of one cycle, s; t is the time since the start of the episode.
        offsets: offsets as shares of the cycle, for example one for each leg.
    """
    cycles = env.episode_length_buf * (env.step_dt / period)
    angles = [2.0 * math.pi * (cycles + offset).frac() for offset in offsets]
    return torch.stack([angle.sin() for angle in angles] + [angle.cos() for angle in angles], dim=1)
