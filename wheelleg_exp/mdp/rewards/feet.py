"""Rewards on feet that step: flight, stance, sliding and clearance."""

from __future__ import annotations

import torch

from wheelleg_exp.constraints import NonNegative, Positive
from wheelleg_exp.managers import Env, SceneEntityCfg
from wheelleg_exp.mdp.ground import height_over_ground
from wheelleg_exp.mdp.rewards.pairing import require_pairs
from wheelleg_exp.sim.ids import picked

_ROBOT = SceneEntityCfg("robot")
_WALKING = 0.1  # m/s: below, no step is asked for


def _is_asked_to_walk(env: Env, command_name: str) -> torch.Tensor:
    return torch.linalg.vector_norm(env.command_manager.get_command(command_name)[:, :2], dim=1) > _WALKING


def feet_air_time(env: Env, command_name: str, sensor_cfg: SceneEntityCfg, threshold: NonNegative) -> torch.Tensor:
    """Sum over feet that have just landed of how much longer than ``threshold`` (s) they flew, s.

    0 where the commanded planar velocity is not above 0.1 m/s. The contact sensor has to track air times.
    """
    sensor = env.scene.contact_sensor(sensor_cfg.name)
    landed = picked(sensor.compute_first_contact(env.step_dt), sensor_cfg.body_ids)
    longer = picked(sensor.data.last_air_time, sensor_cfg.body_ids) - threshold
    return (longer * landed).sum(dim=1) * _is_asked_to_walk(env, command_name)


def feet_air_time_positive_biped(
    env: Env, command_name: str, threshold: NonNegative, sensor_cfg: SceneEntityCfg
) -> torch.Tensor:
    """Shortest time, s, that all feet have been as they are, where exactly one stands; at most ``threshold``.

    0 where the commanded planar velocity is not above 0.1 m/s. The contact sensor has to track air times.
    """
    data = env.scene.contact_sensor(sensor_cfg.name).data
    contact = picked(data.current_contact_time, sensor_cfg.body_ids)
    stands = contact > 0.0
    lasted = torch.where(stands, contact, picked(data.current_air_time, sensor_cfg.body_ids)).amin(dim=1)
    single = stands.sum(dim=1) == 1
    return lasted.clamp(max=threshold) * (single & _is_asked_to_walk(env, command_name))


def feet_slide(
    env: Env, sensor_cfg: SceneEntityCfg, asset_cfg: SceneEntityCfg = _ROBOT, threshold: NonNegative = 1.0
) -> torch.Tensor:
    """Sum of the horizontal speeds of the feet that touch something, m/s.

    Args:
        env: the environment.
        sensor_cfg: the feet of a contact sensor.
        asset_cfg: the same bodies of the robot, in the same order.
        threshold: force above which a foot touches, N; Isaac Lab's 1 N is a fifth of a robot of 0.5 kg.
    """
    touches = picked(env.scene.contact_sensor(sensor_cfg.name).max_force_norm(), sensor_cfg.body_ids) > threshold
    velocity = env.scene[asset_cfg.name].data.body_lin_vel_w[:, asset_cfg.body_ids, :2]
    require_pairs(touches, velocity, "asset_cfg.body_names")
    return (torch.linalg.vector_norm(velocity, dim=-1) * touches).sum(dim=1)


def feet_stumble(env: Env, sensor_cfg: SceneEntityCfg, ratio: Positive = 4.0) -> torch.Tensor:
    """1 where some foot or wheel is pushed sideways more than ``ratio`` times as hard as upwards, else 0.

    Not in Isaac Lab: it runs into something steep.
    """
    force = picked(env.scene.contact_sensor(sensor_cfg.name).data.net_forces_w, sensor_cfg.body_ids)
    sideways = torch.linalg.vector_norm(force[..., :2], dim=-1)
    return (sideways > ratio * force[..., 2].abs()).any(dim=1).float()


def feet_clearance_l2(env: Env, clearance: Positive, asset_cfg: SceneEntityCfg) -> torch.Tensor:
    """Sum over feet of (h - clearance)^2 times the horizontal speed, m^3/s: a moving foot is to be lifted.

    Not in Isaac Lab. h is the link's height above the ground straight below, m.
    """
    data, ids = env.scene[asset_cfg.name].data, asset_cfg.body_ids
    error = height_over_ground(env, picked(data.body_pos_w, ids)) - clearance
    speed = torch.linalg.vector_norm(data.body_lin_vel_w[:, ids, :2], dim=-1)
    return (error.square() * speed).sum(dim=1)


def air_time_variance(env: Env, sensor_cfg: SceneEntityCfg, max_time: Positive = 0.5) -> torch.Tensor:
    """Variance over feet of their last flights and of their last stances, each at most ``max_time`` (s), s^2.

    Not in Isaac Lab's library: an even gait. The contact sensor has to track air times.
    """
    data, ids = env.scene.contact_sensor(sensor_cfg.name).data, sensor_cfg.body_ids
    flights, stances = picked(data.last_air_time, ids), picked(data.last_contact_time, ids)
    return flights.clamp(max=max_time).var(dim=1) + stances.clamp(max=max_time).var(dim=1)
