"""Reward terms, (N,), before weight and time step. Formulas are Isaac Lab's unless the text says otherwise."""

from __future__ import annotations

import torch

from wheelleg_exp.constraints import Names, NonNegative, Positive
from wheelleg_exp.errors import ConfigError
from wheelleg_exp.managers import Env, SceneEntityCfg, TermBase
from wheelleg_exp.sim.names import match_names

_ROBOT = SceneEntityCfg("robot")


def is_alive(env: Env) -> torch.Tensor:
    """1 unless the episode failed in this step; a time-out counts as alive."""
    return (~env.termination_manager.terminated).float()


def is_terminated(env: Env) -> torch.Tensor:
    """1 where the episode failed in this step; time-outs excluded."""
    return env.termination_manager.terminated.float()


class is_terminated_term(TermBase):
    """Number of the matching terminations that fired in this step, 0 on a time-out.

    Args:
        env: the environment.
        term_keys: expressions of termination names; by default all.
    """

    def __init__(self, env: Env, term_keys: Names = ".*") -> None:
        names = env.termination_manager.active_terms
        self._names = match_names(term_keys, names, key="term_keys", what="termination")[1]

    def __call__(self, env: Env) -> torch.Tensor:
        """Count."""
        manager = env.termination_manager
        fired = torch.stack([manager.get_fired(name) for name in self._names]).sum(dim=0)
        return (fired * ~manager.time_outs).float()


def lin_vel_z_l2(env: Env, asset_cfg: SceneEntityCfg = _ROBOT) -> torch.Tensor:
    """Squared vertical velocity of the root's centre of mass in link axes, (m/s)^2."""
    return env.scene[asset_cfg.name].data.root_lin_vel_b[:, 2].square()


def ang_vel_xy_l2(env: Env, asset_cfg: SceneEntityCfg = _ROBOT) -> torch.Tensor:
    """w_x^2 + w_y^2 of the root in link axes, (rad/s)^2."""
    return env.scene[asset_cfg.name].data.root_ang_vel_b[:, :2].square().sum(dim=1)


def flat_orientation_l2(env: Env, asset_cfg: SceneEntityCfg = _ROBOT) -> torch.Tensor:
    """g_x^2 + g_y^2 of the projected gravity: sin^2 of the tilt."""
    return env.scene[asset_cfg.name].data.projected_gravity_b[:, :2].square().sum(dim=1)


def pitch_orientation_l2(env: Env, asset_cfg: SceneEntityCfg = _ROBOT) -> torch.Tensor:
    """g_x^2 of the projected gravity: sin^2 of the pitch. Not in Isaac Lab."""
    return env.scene[asset_cfg.name].data.projected_gravity_b[:, 0].square()


def base_height_l2(env: Env, target_height: float, asset_cfg: SceneEntityCfg = _ROBOT) -> torch.Tensor:
    """(z - target)^2 of the root link in the world, m^2; for flat ground at z = 0."""
    return (env.scene[asset_cfg.name].data.root_pos_w[:, 2] - target_height).square()


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
    low, high = data.soft_joint_pos_limits[asset_cfg.joint_ids].unbind(dim=1)
    return ((low - q).clamp(min=0.0) + (q - high).clamp(min=0.0)).sum(dim=1)


def joint_vel_limits(env: Env, soft_ratio: Positive, asset_cfg: SceneEntityCfg = _ROBOT) -> torch.Tensor:
    """Sum of clip(|qd| - limit * ratio, 0, 1), rad/s."""
    data = env.scene[asset_cfg.name].data
    limit = data.soft_joint_vel_limits[asset_cfg.joint_ids] * soft_ratio
    return (data.joint_vel[:, asset_cfg.joint_ids].abs() - limit).clamp(0.0, 1.0).sum(dim=1)


def applied_torque_limits(env: Env, asset_cfg: SceneEntityCfg = _ROBOT) -> torch.Tensor:
    """Sum of |applied - computed| torque: what the effort limit cut off, N·m."""
    data = env.scene[asset_cfg.name].data
    ids = asset_cfg.joint_ids
    return (data.applied_torque[:, ids] - data.computed_torque[:, ids]).abs().sum(dim=1)


def action_rate_l2(env: Env) -> torch.Tensor:
    """Sum of squared changes of the raw action."""
    return (env.action_manager.action - env.action_manager.prev_action).square().sum(dim=1)


def action_l2(env: Env) -> torch.Tensor:
    """Sum of squared raw actions."""
    return env.action_manager.action.square().sum(dim=1)


def undesired_contacts(env: Env, threshold: NonNegative, sensor_cfg: SceneEntityCfg) -> torch.Tensor:
    """Number of bodies whose contact force exceeded ``threshold`` (N) within the sensor's history."""
    force = env.scene.contact_sensor(sensor_cfg.name).max_force_norm()[:, sensor_cfg.body_ids]
    return (force > threshold).sum(dim=1).float()


def no_contact_count(env: Env, threshold: NonNegative, sensor_cfg: SceneEntityCfg) -> torch.Tensor:
    """Number of bodies whose contact force stayed at or below ``threshold`` (N) within the sensor's history.

    Not in Isaac Lab: the number of wheels in the air.
    """
    force = env.scene.contact_sensor(sensor_cfg.name).max_force_norm()[:, sensor_cfg.body_ids]
    return (force <= threshold).sum(dim=1).float()


def no_desired_contact(env: Env, sensor_cfg: SceneEntityCfg, threshold: NonNegative = 1.0) -> torch.Tensor:
    """1 where none of the bodies exceeded ``threshold`` (N) within the sensor's history.

    Isaac Lab calls it ``desired_contacts``, which names the opposite.
    """
    force = env.scene.contact_sensor(sensor_cfg.name).max_force_norm()[:, sensor_cfg.body_ids]
    return (~(force > threshold).any(dim=1)).float()


desired_contacts = no_desired_contact


def contact_forces(env: Env, threshold: NonNegative, sensor_cfg: SceneEntityCfg) -> torch.Tensor:
    """Sum of the contact forces beyond ``threshold``, N."""
    force = env.scene.contact_sensor(sensor_cfg.name).max_force_norm()[:, sensor_cfg.body_ids]
    return (force - threshold).clamp(min=0.0).sum(dim=1)


def track_lin_vel_xy_exp(
    env: Env, std: Positive, command_name: str, asset_cfg: SceneEntityCfg = _ROBOT
) -> torch.Tensor:
    """exp(-|v_xy command - v_xy|^2 / std^2), velocities of the root's centre of mass in link axes."""
    command = env.command_manager.get_command(command_name)[:, :2]
    error = (command - env.scene[asset_cfg.name].data.root_lin_vel_b[:, :2]).square().sum(dim=1)
    return torch.exp(-error / std**2)


def track_ang_vel_z_exp(env: Env, std: Positive, command_name: str, asset_cfg: SceneEntityCfg = _ROBOT) -> torch.Tensor:
    """exp(-(w_z command - w_z)^2 / std^2), angular velocity in link axes."""
    command = env.command_manager.get_command(command_name)[:, 2]
    error = (command - env.scene[asset_cfg.name].data.root_ang_vel_b[:, 2]).square()
    return torch.exp(-error / std**2)
