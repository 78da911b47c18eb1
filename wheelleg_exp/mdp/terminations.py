"""Termination terms, (N,) bool."""

from __future__ import annotations

import math
from typing import Annotated

import torch

from wheelleg_exp.constraints import Above, AtMost, Bounds, Count, NonNegative, Positive
from wheelleg_exp.managers import Env, SceneEntityCfg, TermBase
from wheelleg_exp.mdp.root_motion import height_over_ground
from wheelleg_exp.sim.ids import picked

Tilt = Annotated[float, Above(0), AtMost(math.pi)]  # rad
_ROBOT = SceneEntityCfg("robot")
_ROUNDING = 1e-3  # The engine's rounding error of a torque is at most 0.1 % of the effort limit.


def time_out(env: Env) -> torch.Tensor:
    """End the episode if the episode has reached the longest length."""
    return env.episode_length_buf >= env.max_episode_length


def command_resample(env: Env, command_name: str, num_resamples: Count = 1) -> torch.Tensor:
    """End the episode when the command would be drawn again after ``num_resamples`` draws."""
    command = env.command_manager.get_term(command_name)
    return (command.time_left <= env.step_dt) & (command.command_counter == num_resamples)


def bad_orientation(env: Env, limit_angle: Tilt, asset_cfg: SceneEntityCfg = _ROBOT) -> torch.Tensor:
    """End the episode if the root is tilted by more than ``limit_angle`` (rad), also upside down, unlike Isaac Lab."""
    upright = -env.scene.articulations[asset_cfg.name].data.projected_gravity_b[:, 2]
    return torch.acos(upright.clamp(-1.0, 1.0)) > limit_angle


def root_height_below_minimum(env: Env, minimum_height: float, asset_cfg: SceneEntityCfg = _ROBOT) -> torch.Tensor:
    """End the episode if the root link is below ``minimum_height`` (m) in the world; for flat ground only."""
    return env.scene.articulations[asset_cfg.name].data.root_pos_w[:, 2] < minimum_height


def root_height_over_ground_below_minimum(
    env: Env, minimum_height: float, asset_cfg: SceneEntityCfg = _ROBOT
) -> torch.Tensor:
    """End the episode if the root link is less than ``minimum_height`` (m) above the ground. Not in Isaac Lab."""
    return height_over_ground(env, env.scene.articulations[asset_cfg.name].data.root_pos_w) < minimum_height


def terrain_out_of_bounds(
    env: Env, asset_cfg: SceneEntityCfg = _ROBOT, distance_buffer: NonNegative = 3.0
) -> torch.Tensor:
    """End the episode if the root link is less than ``distance_buffer`` (m) from the outer edge of a tiled ground."""
    terrain, position = env.scene.terrain, env.scene.articulations[asset_cfg.name].data.root_pos_w
    if terrain.terrain_origins is None:
        return torch.zeros_like(position[:, 0], dtype=torch.bool)
    counts, room = terrain.terrain_origins.shape, terrain.border_width
    x, y = (position[:, i].abs() > 0.5 * counts[i] * terrain.size[i] + room - distance_buffer for i in (0, 1))
    return x | y


def terrain_tile_left(env: Env, margin: float = 0.0, asset_cfg: SceneEntityCfg = _ROBOT) -> torch.Tensor:
    """End the episode if the root link is more than ``margin`` (m) outside the environment's tile. Not in Isaac Lab."""
    away = (env.scene.articulations[asset_cfg.name].data.root_pos_w[:, :2] - env.scene.env_origins[:, :2]).abs()
    size = env.scene.terrain.size
    return (away[:, 0] > 0.5 * size[0] + margin) | (away[:, 1] > 0.5 * size[1] + margin)


class stuck(TermBase):
    """End the episode if a robot must drive but moved less than ``distance`` (m) in ``time`` (s). Not in Isaac Lab.

    Distance and time restart from 0 while the commanded planar speed is at most ``command_threshold``.

    Args:
        distance: distance in the plane, m.
        time: s.
        command_threshold: m/s.
    """

    def __init__(
        self,
        env: Env,
        command_name: str,
        distance: Positive,
        time: Positive,
        command_threshold: NonNegative = 0.1,
        asset_cfg: SceneEntityCfg = _ROBOT,
    ) -> None:
        self._command, self._threshold = command_name, command_threshold
        self._distance, self._steps = distance, math.ceil(round(time / env.step_dt, 6))
        self._asset = asset_cfg.name
        self._from = self.buffer("_from", torch.zeros(env.num_envs, 2, device=env.device))
        # ``_stayed`` counts control steps without a movement by ``distance``; -1 marks the start of an episode.
        self._stayed = self.buffer("_stayed", torch.full((env.num_envs,), -1, device=env.device), fill=-1)

    def __call__(self, env: Env) -> torch.Tensor:
        position = env.scene[self._asset].data.root_pos_w[:, :2]
        speed = torch.linalg.vector_norm(env.command_manager.get_command(self._command)[:, :2], dim=1)
        left = torch.linalg.vector_norm(position - self._from, dim=1) > self._distance
        restarts = left | (speed <= self._threshold) | (self._stayed < 0)
        self._stayed.add_(1).masked_fill_(restarts, 0)
        self._from.copy_(torch.where(restarts.unsqueeze(1), position, self._from))
        return self._stayed >= self._steps


def joint_pos_out_of_limit(env: Env, asset_cfg: SceneEntityCfg = _ROBOT) -> torch.Tensor:
    """End the episode if the position of at least one joint is outside the joint's soft limits."""
    data = env.scene.articulations[asset_cfg.name].data
    q = picked(data.joint_pos, asset_cfg.joint_ids)
    low, high = picked(data.soft_joint_pos_limits, asset_cfg.joint_ids).unbind(dim=2)
    return ((q < low) | (q > high)).any(dim=1)


def joint_pos_out_of_manual_limit(env: Env, bounds: Bounds, asset_cfg: SceneEntityCfg = _ROBOT) -> torch.Tensor:
    """End the episode if at least one joint position is outside ``bounds``, rad."""
    q = picked(env.scene.articulations[asset_cfg.name].data.joint_pos, asset_cfg.joint_ids)
    return ((q < bounds[0]) | (q > bounds[1])).any(dim=1)


def joint_vel_out_of_limit(env: Env, asset_cfg: SceneEntityCfg = _ROBOT) -> torch.Tensor:
    """End the episode if at least one joint is faster than its actuator's velocity limit."""
    data = env.scene.articulations[asset_cfg.name].data
    speed = picked(data.joint_vel, asset_cfg.joint_ids).abs()
    return (speed > picked(data.soft_joint_vel_limits, asset_cfg.joint_ids)).any(dim=1)


def joint_vel_out_of_manual_limit(env: Env, max_velocity: Positive, asset_cfg: SceneEntityCfg = _ROBOT) -> torch.Tensor:
    """End the episode if at least one joint is faster than ``max_velocity``, rad/s."""
    speed = picked(env.scene.articulations[asset_cfg.name].data.joint_vel, asset_cfg.joint_ids).abs()
    return (speed > max_velocity).any(dim=1)


def joint_effort_out_of_limit(env: Env, asset_cfg: SceneEntityCfg = _ROBOT) -> torch.Tensor:
    """End the episode if a joint torque was clipped by a torque limit, which may depend on joint speed or position."""
    data, joints = env.scene.articulations[asset_cfg.name].data, asset_cfg.joint_ids
    computed, applied = picked(data.computed_torque, joints), picked(data.applied_torque, joints)
    limits = picked(data.joint_effort_limits, joints)
    scale = torch.where(limits.isfinite(), limits, computed.abs())
    return ((computed.abs() > limits) | ((computed - applied).abs() > _ROUNDING * scale)).any(dim=1)


def illegal_contact(env: Env, threshold: NonNegative, sensor_cfg: SceneEntityCfg) -> torch.Tensor:
    """End the episode if a listed body's contact force exceeded ``threshold`` (N) in the contact sensor's history."""
    force = picked(env.scene.contact_sensor(sensor_cfg.name).max_force_norm(), sensor_cfg.body_ids)
    return (force > threshold).any(dim=1)


def non_finite_state(env: Env) -> torch.Tensor:
    """End the episode if the engine found NaN or huge values in the simulation and reset the simulation."""
    return env.scene.unstable()
