"""Reward terms: one value per environment, (N,), before weight and time step; formulas as in Isaac Lab unless noted."""

from __future__ import annotations

import math

import torch

from wheelleg_exp.constraints import Names, NonNegative, Positive
from wheelleg_exp.errors import ConfigError
from wheelleg_exp.managers import Env, SceneEntityCfg, TermBase
from wheelleg_exp.mdp.commands.velocity_commands import integrated_travel_error
from wheelleg_exp.mdp.root_motion import height_over_ground, level_velocity, roll_pitch
from wheelleg_exp.sim.ids import picked
from wheelleg_exp.sim.names import match_names


def _length(vectors: torch.Tensor) -> torch.Tensor:
    found: torch.Tensor = torch.linalg.vector_norm(vectors, dim=-1)
    return found


def _speed(velocity: torch.Tensor) -> torch.Tensor:
    """Return the horizontal speeds (...) of velocities (..., k), whose first components are along x and y."""
    return _length(velocity[..., :2])


def is_alive(env: Env) -> torch.Tensor:
    """1 unless the episode failed in this step; a time-out counts as alive."""
    return (~env.termination_manager.terminated).float()


def is_terminated(env: Env) -> torch.Tensor:
    """1 where the episode failed in this step; time-outs excluded."""
    return env.termination_manager.terminated.float()


class is_terminated_term(TermBase):
    """Number of the listed termination terms that fired in the control step; 0 if a time-out ended the episode.

    Args:
        term_keys: expressions of termination names; all by default.
    """

    def __init__(self, env: Env, term_keys: Names = ".*") -> None:
        names = env.termination_manager.active_terms
        self._names = match_names(term_keys, names, key="term_keys", what="termination")[1]

    def __call__(self, env: Env) -> torch.Tensor:
        manager = env.termination_manager
        fired = torch.stack([manager.get_term(name) for name in self._names]).sum(dim=0)
        return (fired * ~manager.time_outs).float()


_ROBOT = SceneEntityCfg("robot")


def lin_vel_z_l2(env: Env, asset_cfg: SceneEntityCfg = _ROBOT) -> torch.Tensor:
    """Squared velocity of the root's centre of mass along the z axis of the root link, (m/s)^2."""
    return env.scene.articulations[asset_cfg.name].data.root_lin_vel_b[:, 2].square()


def ang_vel_xy_l2(env: Env, asset_cfg: SceneEntityCfg = _ROBOT) -> torch.Tensor:
    """w_x^2 + w_y^2 of the root in link axes, (rad/s)^2."""
    return env.scene.articulations[asset_cfg.name].data.root_ang_vel_b[:, :2].square().sum(dim=1)


def flat_orientation_l2(env: Env, asset_cfg: SceneEntityCfg = _ROBOT) -> torch.Tensor:
    """g_x^2 + g_y^2 of the projected gravity: sin^2 of the tilt."""
    return env.scene.articulations[asset_cfg.name].data.projected_gravity_b[:, :2].square().sum(dim=1)


def flat_orientation_exp(env: Env, std: Positive, asset_cfg: SceneEntityCfg = _ROBOT) -> torch.Tensor:
    """exp(-(g_x^2 + g_y^2) / std^2) of the projected gravity: g_x^2 + g_y^2 is sin^2 of the tilt. Not in Isaac Lab.

    Its gradient, unlike that of a squared error, does not vanish at small tilts. Upside down, the reward is the same.

    Args:
        std: sine of the tilt at which 1/e of the reward remains.
    """
    return torch.exp(-flat_orientation_l2(env, asset_cfg) / std**2)


def pitch_orientation_l2(env: Env, asset_cfg: SceneEntityCfg = _ROBOT) -> torch.Tensor:
    """g_x^2 of the projected gravity: sin^2 of the pitch. Not in Isaac Lab."""
    return env.scene.articulations[asset_cfg.name].data.projected_gravity_b[:, 0].square()


def upward(env: Env, asset_cfg: SceneEntityCfg = _ROBOT) -> torch.Tensor:
    """(1 - g_z)^2 of the projected gravity: 4 upright, 1 lying, 0 upside down. Not in Isaac Lab."""
    return (1.0 - env.scene.articulations[asset_cfg.name].data.projected_gravity_b[:, 2]).square()


def base_height_l2(
    env: Env, target_height: float, asset_cfg: SceneEntityCfg = _ROBOT, sensor_cfg: SceneEntityCfg | None = None
) -> torch.Tensor:
    """(z - target)^2 of the root link in the world, m^2; for flat ground at z = 0.

    With a ray caster, the target is relative to the mean height of the hits; as in Isaac Lab, the value is infinite if
    a ray has no hit. ``base_height_over_ground_l2`` needs no sensor.
    """
    height = env.scene.articulations[asset_cfg.name].data.root_pos_w[:, 2]
    if sensor_cfg is not None:
        height = height - env.scene[sensor_cfg.name].data.ray_hits_w[..., 2].mean(dim=1)
    return (height - target_height).square()


def base_height_over_ground_l2(env: Env, target_height: float, asset_cfg: SceneEntityCfg = _ROBOT) -> torch.Tensor:
    """(h - target)^2 of the root link's height h above the ground straight below, m^2. Not in Isaac Lab."""
    height = height_over_ground(env, env.scene.articulations[asset_cfg.name].data.root_pos_w)
    return (height - target_height).square()


def base_height_exp(env: Env, target_height: float, std: Positive, asset_cfg: SceneEntityCfg = _ROBOT) -> torch.Tensor:
    """exp(-(h - target)^2 / std^2) of the root link's height h above the ground straight below. Not in Isaac Lab.

    Its gradient, unlike that of a squared error, does not vanish at errors of millimetres.

    Args:
        target_height: m.
        std: error at which 1/e of the reward remains, m.
    """
    height = height_over_ground(env, env.scene.articulations[asset_cfg.name].data.root_pos_w)
    return torch.exp(-((height - target_height) / std).square())


def standing_exp(
    env: Env, target_height: float, height_std: Positive, tilt_std: Positive, asset_cfg: SceneEntityCfg = _ROBOT
) -> torch.Tensor:
    """exp(-(h - target)^2 / height_std^2 - s^2 / tilt_std^2); 0 upside down. Not in Isaac Lab.

    h is the root link's height above the ground, m, s the sine of the tilt. The product pays only a robot that stands.
    """
    height = base_height_exp(env, target_height, height_std, asset_cfg)
    upright = env.scene.articulations[asset_cfg.name].data.projected_gravity_b[:, 2] < 0.0
    return height * flat_orientation_exp(env, tilt_std, asset_cfg) * upright


def body_lin_acc_norm_sum(env: Env, asset_cfg: SceneEntityCfg = _ROBOT) -> torch.Tensor:
    """Sum of the norms, not squared, of the bodies' linear accelerations, m/s^2. Isaac Lab: ``body_lin_acc_l2``."""
    acceleration = picked(env.scene.articulations[asset_cfg.name].data.body_lin_acc_w, asset_cfg.body_ids)
    return _length(acceleration).sum(dim=1)


body_lin_acc_l2 = body_lin_acc_norm_sum


def track_lin_vel_xy_exp(
    env: Env, std: Positive, command_name: str, asset_cfg: SceneEntityCfg = _ROBOT
) -> torch.Tensor:
    """exp(-|v_xy command - v_xy|^2 / std^2), velocities of the root's centre of mass in link axes."""
    command = env.command_manager.get_command(command_name)[:, :2]
    error = (command - env.scene.articulations[asset_cfg.name].data.root_lin_vel_b[:, :2]).square().sum(dim=1)
    return torch.exp(-error / std**2)


def track_ang_vel_z_exp(env: Env, std: Positive, command_name: str, asset_cfg: SceneEntityCfg = _ROBOT) -> torch.Tensor:
    """exp(-(w_z command - w_z)^2 / std^2), angular velocity in link axes."""
    command = env.command_manager.get_command(command_name)[:, 2]
    error = (command - env.scene.articulations[asset_cfg.name].data.root_ang_vel_b[:, 2]).square()
    return torch.exp(-error / std**2)


def track_lin_vel_xy_yaw_frame_exp(
    env: Env, std: Positive, command_name: str, asset_cfg: SceneEntityCfg = _ROBOT
) -> torch.Tensor:
    """exp(-|v_xy command - v_xy|^2 / std^2), velocities of the root's centre of mass in level axes that turn with it.

    Unlike in ``track_lin_vel_xy_exp``, vertical velocity of a leaning robot does not count as forward speed.
    """
    command = env.command_manager.get_command(command_name)
    forwards, sideways = level_velocity(env.scene.articulations[asset_cfg.name].data)
    error = (command[:, 0] - forwards).square() + (command[:, 1] - sideways).square()
    return torch.exp(-error / std**2)


def track_ang_vel_z_world_exp(
    env: Env, command_name: str, std: Positive, asset_cfg: SceneEntityCfg = _ROBOT
) -> torch.Tensor:
    """exp(-(w_z command - w_z)^2 / std^2), angular velocity about the world's vertical."""
    command = env.command_manager.get_command(command_name)[:, 2]
    error = (command - env.scene.articulations[asset_cfg.name].data.root_ang_vel_w[:, 2]).square()
    return torch.exp(-error / std**2)


def track_base_height_exp(
    env: Env, std: Positive, command_name: str, asset_cfg: SceneEntityCfg = _ROBOT
) -> torch.Tensor:
    """exp(-(height command - h)^2 / std^2), h of the root link above the ground straight below, m. Not in Isaac Lab.

    The height must be the first component of the command, as in ``UniformBasePoseCommand``.
    """
    command = env.command_manager.get_command(command_name)[:, 0]
    error = (command - height_over_ground(env, env.scene.articulations[asset_cfg.name].data.root_pos_w)).square()
    return torch.exp(-error / std**2)


class jump_clearance(TermBase):
    """Rate at which the largest clearance of the lower wheel grows within a jump, m/s. Not in Isaac Lab.

    Over a jump, it sums to the largest clearance, at most ``target``. The command must be a ``JumpCommand``.

    Args:
        rest: height of the wheels' links while the robot stands: the radius of the wheels, m.
        target: clearance above which the reward does not grow, m; null: the commanded height.
        asset_cfg: the wheels' links.
    """

    def __init__(
        self,
        env: Env,
        command_name: str,
        rest: NonNegative,
        target: Positive | None,
        asset_cfg: SceneEntityCfg = _ROBOT,
    ) -> None:
        self._command, self._rest, self._target, self._entity = command_name, rest, target, asset_cfg
        self._highest = self.buffer("_highest", torch.zeros(env.num_envs, device=env.device), fill=0.0)

    def height(self, env: Env) -> torch.Tensor:
        """Return the height of the lowest wheel's link above the ground, m, (N,)."""
        wheels = picked(env.scene[self._entity.name].data.body_pos_w, self._entity.body_ids)
        return height_over_ground(env, wheels).amin(dim=1)

    def __call__(self, env: Env) -> torch.Tensor:
        command = env.command_manager.get_command(self._command)
        jumps = command[:, 0] > 0.0
        target = command[:, 1] if self._target is None else self._target
        height = (self.height(env) - self._rest).clamp(min=0.0).clamp(max=target)
        gain = torch.where(jumps, (height - self._highest).clamp(min=0.0), 0.0)
        self._highest.copy_(torch.where(jumps, self._highest + gain, 0.0))
        return gain / env.step_dt


class jump_apex(jump_clearance):
    """Like ``jump_clearance``, for the apex that the base would reach without further forces. Not in Isaac Lab.

    The apex is h + v²/2g for a height h above the ground and an upward velocity v: it rises while the legs push.

    Args:
        rest: height of the base while the robot stands, m.
        target: rise of the apex above which the reward does not grow, m; null: the commanded height.
    """

    def height(self, env: Env) -> torch.Tensor:
        """Return the apex of the base above the ground, m, (N,)."""
        data = env.scene.articulations[self._entity.name].data
        gravity = math.hypot(*env.scene.model.opt.gravity)
        rise = data.root_lin_vel_w[:, 2].clamp(min=0.0).square() / (2.0 * gravity)
        return height_over_ground(env, data.root_pos_w) + rise


class jump_landing(TermBase):
    """exp(-a^2 / impact_std^2 - s^2 / tilt_std^2) at the end of a jump's window, per control step. Not in Isaac Lab.

    a is the impact, the largest change of the base's velocity in a control step of the window, m/s; s is the sine of
    the tilt. The reward is paid once, and sums to at most 1 over the control step. It is 0 if the wheels did not all
    leave the ground, or if one of them is still in the air. The command must be a ``JumpCommand``.

    Args:
        sensor_cfg: the wheels of a contact sensor.
        threshold: force up to which a wheel is in the air, N.
        impact_std: impact at which 1/e of the reward remains, m/s.
        tilt_std: sine of the tilt at which 1/e of the reward remains.
    """

    def __init__(
        self,
        env: Env,
        command_name: str,
        sensor_cfg: SceneEntityCfg,
        threshold: NonNegative,
        impact_std: Positive,
        tilt_std: Positive,
        asset_cfg: SceneEntityCfg = _ROBOT,
    ) -> None:
        self._command, self._wheels, self._threshold, self._entity = command_name, sensor_cfg, threshold, asset_cfg
        self._impact_std, self._tilt_std = impact_std, tilt_std
        zeros = torch.zeros(env.num_envs, device=env.device)
        self._last = self.buffer("_last", zeros.unsqueeze(1).repeat(1, 3), fill=0.0)  # velocity, m/s
        self._impact = self.buffer("_impact", zeros.clone(), fill=0.0)
        self._jumped = self.buffer("_jumped", zeros.bool(), fill=False)  # in the window of the last control step
        self._flew = self.buffer("_flew", zeros.bool(), fill=False)

    def __call__(self, env: Env) -> torch.Tensor:
        force = picked(env.scene.contact_sensor(self._wheels.name).max_force_norm(), self._wheels.body_ids)
        flies, velocity = force <= self._threshold, env.scene[self._entity.name].data.root_lin_vel_w
        jumps = env.command_manager.get_command(self._command)[:, 0] > 0.0
        lands = self._jumped & ~jumps & self._flew & ~flies.any(dim=1)
        upright = flat_orientation_exp(env, self._tilt_std, self._entity)
        value = torch.exp(-(self._impact / self._impact_std).square()) * upright * lands / env.step_dt
        change = _length(velocity - self._last)
        self._impact.copy_(torch.where(jumps, torch.maximum(self._impact, change), 0.0))
        self._flew.copy_(jumps & (self._flew | flies.all(dim=1)))
        self._jumped.copy_(jumps)
        self._last.copy_(velocity)
        return value


def while_commanded(env: Env, term: str, command_name: str) -> torch.Tensor:
    """Value of the reward term ``term`` while the command's first component is not 0, else 0. Not in Isaac Lab.

    In such a phase, for example a jump, its weight adds to that of ``term``, which must be a function.
    """
    found = env.reward_manager.get_term_cfg(term)
    if isinstance(found.func, TermBase) or found.func is while_commanded:
        raise ConfigError(f"the reward '{term}' has state", key="term", expected="another reward that is a function")
    value: torch.Tensor = found(env)
    return value * (env.command_manager.get_command(command_name)[:, 0] != 0.0)


def track_base_tilt_exp(env: Env, std: Positive, command_name: str, asset_cfg: SceneEntityCfg = _ROBOT) -> torch.Tensor:
    """exp(-|(roll, pitch) command - (roll, pitch)|^2 / std^2), rad, pitch forwards is positive. Not in Isaac Lab.

    The command must consist of height, roll and pitch, as in ``UniformBasePoseCommand``.
    """
    command = env.command_manager.get_command(command_name)
    roll, pitch = roll_pitch(env.scene.articulations[asset_cfg.name].data.projected_gravity_b)
    error = (command[:, 1] - roll).square() + (command[:, 2] - pitch).square()
    return torch.exp(-error / std**2)


def travel_error_l2(env: Env, command_name: str, heading_length: NonNegative = 0.0) -> torch.Tensor:
    """Squared difference between travelled and commanded distance, m^2. Not in Isaac Lab.

    Args:
        command_name: a command of class ``UniformVelocityTravelCommand``, which integrates the error.
        heading_length: length that one radian of heading error counts as, m.
    """
    travel, heading = integrated_travel_error(env, command_name).unbind(dim=1)
    return travel.square() + (heading_length * heading).square()


def joint_torques_l2(env: Env, asset_cfg: SceneEntityCfg = _ROBOT) -> torch.Tensor:
    """Sum of the squares of the torques that the joints' drives applied, (N·m)^2."""
    return picked(env.scene.articulations[asset_cfg.name].data.applied_torque, asset_cfg.joint_ids).square().sum(dim=1)


def joint_power(env: Env, asset_cfg: SceneEntityCfg = _ROBOT, positive_only: bool = False) -> torch.Tensor:
    """Sum of joint powers |torque * velocity|, W; ``positive_only`` leaves out braking joints. Not in Isaac Lab."""
    data = env.scene.articulations[asset_cfg.name].data
    power = picked(data.applied_torque, asset_cfg.joint_ids) * picked(data.joint_vel, asset_cfg.joint_ids)
    return (power.clamp(min=0.0) if positive_only else power.abs()).sum(dim=1)


def joint_vel_l1(env: Env, asset_cfg: SceneEntityCfg = _ROBOT) -> torch.Tensor:
    """Sum of joint speeds, rad/s."""
    return picked(env.scene.articulations[asset_cfg.name].data.joint_vel, asset_cfg.joint_ids).abs().sum(dim=1)


def joint_vel_l2(env: Env, asset_cfg: SceneEntityCfg = _ROBOT) -> torch.Tensor:
    """Sum of the squares of the joint velocities, (rad/s)^2."""
    return picked(env.scene.articulations[asset_cfg.name].data.joint_vel, asset_cfg.joint_ids).square().sum(dim=1)


def joint_acc_l2(env: Env, asset_cfg: SceneEntityCfg = _ROBOT) -> torch.Tensor:
    """Sum of the squares of the joint accelerations over the last physics step, (rad/s^2)^2."""
    return picked(env.scene.articulations[asset_cfg.name].data.joint_acc, asset_cfg.joint_ids).square().sum(dim=1)


class joint_vel_rate_l2(TermBase):
    """Sum of the squared changes of joint velocities over a control step, (rad/s)^2; 0 in an episode's first step.

    Not in Isaac Lab. It penalises jerky wheels; ``joint_acc_l2`` sees only the last physics step.
    """

    def __init__(self, env: Env, asset_cfg: SceneEntityCfg = _ROBOT) -> None:
        self._joints = asset_cfg
        self._last = self.buffer("_last", torch.zeros_like(self._velocity(env)))
        self._has_last = self.buffer("_has_last", torch.zeros(env.num_envs, 1, device=env.device), fill=0.0)

    def __call__(self, env: Env) -> torch.Tensor:
        velocity = self._velocity(env)
        change = (velocity - self._last) * self._has_last
        self._last.copy_(velocity)
        self._has_last.fill_(1.0)
        return change.square().sum(dim=1)

    def _velocity(self, env: Env) -> torch.Tensor:
        return picked(env.scene.articulations[self._joints.name].data.joint_vel, self._joints.joint_ids)


def joint_deviation_l1(env: Env, asset_cfg: SceneEntityCfg = _ROBOT) -> torch.Tensor:
    """Sum of the absolute differences between joint positions and default positions, rad."""
    data = env.scene.articulations[asset_cfg.name].data
    ids = asset_cfg.joint_ids
    return (picked(data.joint_pos, ids) - picked(data.default_joint_pos, ids)).abs().sum(dim=1)


def stand_still_joint_deviation_l1(
    env: Env, command_name: str, command_threshold: NonNegative = 0.06, asset_cfg: SceneEntityCfg = _ROBOT
) -> torch.Tensor:
    """Value of ``joint_deviation_l1`` while the commanded planar speed is below ``command_threshold`` (m/s), else 0."""
    speed = _speed(env.command_manager.get_command(command_name))
    return joint_deviation_l1(env, asset_cfg) * (speed < command_threshold)


def joint_symmetry_l1(
    env: Env, left_cfg: SceneEntityCfg, right_cfg: SceneEntityCfg, mirrored: bool = False
) -> torch.Tensor:
    """Sum of |q_left - q_right| over pairs of left and right joint positions, rad. Not in Isaac Lab.

    The pairs have the same index in both lists, which need equal ``preserve_order``. ``mirrored`` joints have opposite
    signs on the two sides, so that a symmetric pose has |q_left + q_right| = 0.
    """
    left = picked(env.scene[left_cfg.name].data.joint_pos, left_cfg.joint_ids)
    right = picked(env.scene[right_cfg.name].data.joint_pos, right_cfg.joint_ids)
    if left.shape != right.shape:
        message = f"there are {left.shape[1]} left and {right.shape[1]} right joints"
        raise ConfigError(message, key="right_cfg.joint_names", expected="pairs of joints")
    return (left + right if mirrored else left - right).abs().sum(dim=1)


def joint_pos_limits(env: Env, asset_cfg: SceneEntityCfg = _ROBOT) -> torch.Tensor:
    """Sum of the amounts by which joint positions exceed the joints' soft limits, rad."""
    data = env.scene.articulations[asset_cfg.name].data
    q = picked(data.joint_pos, asset_cfg.joint_ids)
    low, high = picked(data.soft_joint_pos_limits, asset_cfg.joint_ids).unbind(dim=2)
    return ((low - q).clamp(min=0.0) + (q - high).clamp(min=0.0)).sum(dim=1)


def joint_vel_limits(env: Env, soft_ratio: Positive, asset_cfg: SceneEntityCfg = _ROBOT) -> torch.Tensor:
    """Sum over joints of the excess velocity clip(|qd| - limit * ratio, 0, 1), rad/s."""
    data = env.scene.articulations[asset_cfg.name].data
    limit = picked(data.soft_joint_vel_limits, asset_cfg.joint_ids) * soft_ratio
    return (picked(data.joint_vel, asset_cfg.joint_ids).abs() - limit).clamp(0.0, 1.0).sum(dim=1)


def applied_torque_limits(env: Env, asset_cfg: SceneEntityCfg = _ROBOT) -> torch.Tensor:
    """Sum of |applied - computed| torque: the part that the effort limit clipped, N·m."""
    data = env.scene.articulations[asset_cfg.name].data
    ids = asset_cfg.joint_ids
    return (picked(data.applied_torque, ids) - picked(data.computed_torque, ids)).abs().sum(dim=1)


def action_rate_l2(env: Env) -> torch.Tensor:
    """Sum of squared changes of the raw action between two control steps."""
    return (env.action_manager.action - env.action_manager.prev_action).square().sum(dim=1)


def action_l2(env: Env) -> torch.Tensor:
    """Sum of squared raw actions."""
    return env.action_manager.action.square().sum(dim=1)


class action_acceleration_l2(TermBase):
    """Sum of squared second differences (a - 2 a_1 + a_2)^2 of the raw action over control steps. Not in Isaac Lab.

    As in ``action_rate_l2``, actions from before the start of an episode are 0.
    """

    def __init__(self, env: Env) -> None:
        self._before_last = self.buffer("_before_last", torch.zeros_like(env.action_manager.action), fill=0.0)

    def __call__(self, env: Env) -> torch.Tensor:
        action, last = env.action_manager.action, env.action_manager.prev_action
        second_difference = action - 2.0 * last + self._before_last
        self._before_last.copy_(last)
        return second_difference.square().sum(dim=1)


def undesired_contacts(env: Env, threshold: NonNegative, sensor_cfg: SceneEntityCfg) -> torch.Tensor:
    """Number of bodies whose contact force exceeded ``threshold`` (N) in the contact sensor's force history."""
    force = picked(env.scene.contact_sensor(sensor_cfg.name).max_force_norm(), sensor_cfg.body_ids)
    return (force > threshold).sum(dim=1).float()


def no_contact_count(env: Env, threshold: NonNegative, sensor_cfg: SceneEntityCfg) -> torch.Tensor:
    """Number of bodies without a contact force above ``threshold`` (N) in the sensor's history. Not in Isaac Lab."""
    force = picked(env.scene.contact_sensor(sensor_cfg.name).max_force_norm(), sensor_cfg.body_ids)
    return (force <= threshold).sum(dim=1).float()


def no_desired_contact(env: Env, sensor_cfg: SceneEntityCfg, threshold: NonNegative = 1.0) -> torch.Tensor:
    """1 if no contact force in the history exceeded ``threshold`` (N). Isaac Lab's name is ``desired_contacts``."""
    force = picked(env.scene.contact_sensor(sensor_cfg.name).max_force_norm(), sensor_cfg.body_ids)
    return (~(force > threshold).any(dim=1)).float()


desired_contacts = no_desired_contact


def contact_forces(env: Env, threshold: NonNegative, sensor_cfg: SceneEntityCfg) -> torch.Tensor:
    """Sum of the amounts by which the bodies' contact forces exceed ``threshold``, N."""
    force = picked(env.scene.contact_sensor(sensor_cfg.name).max_force_norm(), sensor_cfg.body_ids)
    return (force - threshold).clamp(min=0.0).sum(dim=1)


def require_pairs(first: torch.Tensor, second: torch.Tensor, key: str) -> None:
    """Raise ConfigError with ``key`` unless sensor and robot values (N, k, ...) have equally many bodies, k."""
    if first.shape[1] != second.shape[1]:
        message = f"there are {first.shape[1]} bodies of the sensor, and {second.shape[1]} of the robot"
        raise ConfigError(message, key=key, expected="the same number, in the order of sensor_cfg.body_names")


_WALKING = 0.1  # A commanded speed below 0.1 m/s counts as a command to stand.


def _is_asked_to_walk(env: Env, command_name: str) -> torch.Tensor:
    return _speed(env.command_manager.get_command(command_name)) > _WALKING


def feet_air_time(env: Env, command_name: str, sensor_cfg: SceneEntityCfg, threshold: NonNegative) -> torch.Tensor:
    """Sum of (air time - ``threshold``), s, over all feet that touched down in the control step.

    0 where the commanded planar velocity is not above 0.1 m/s. The contact sensor must track air and contact times.
    """
    sensor = env.scene.contact_sensor(sensor_cfg.name)
    landed = picked(sensor.compute_first_contact(env.step_dt), sensor_cfg.body_ids)
    longer = picked(sensor.data.last_air_time, sensor_cfg.body_ids) - threshold
    return (longer * landed).sum(dim=1) * _is_asked_to_walk(env, command_name)


def feet_air_time_positive_biped(
    env: Env, command_name: str, threshold: NonNegative, sensor_cfg: SceneEntityCfg
) -> torch.Tensor:
    """While one foot is in contact: the time since the last touchdown or lift-off, s, at most ``threshold``.

    0 where the commanded planar velocity is not above 0.1 m/s. The contact sensor must track air and contact times.
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
    """Sum of the horizontal speeds of the feet that are in contact, m/s.

    Args:
        sensor_cfg: the feet of a contact sensor.
        asset_cfg: the same bodies of the robot, in the same order.
        threshold: force above which a foot touches, N; Isaac Lab's 1 N is a fifth of the weight of a 0.5 kg robot.
    """
    touches = picked(env.scene.contact_sensor(sensor_cfg.name).max_force_norm(), sensor_cfg.body_ids) > threshold
    velocity = env.scene.articulations[asset_cfg.name].data.body_lin_vel_w[:, asset_cfg.body_ids]
    require_pairs(touches, velocity, "asset_cfg.body_names")
    return (_speed(velocity) * touches).sum(dim=1)


def feet_stumble(env: Env, sensor_cfg: SceneEntityCfg, ratio: Positive = 4.0) -> torch.Tensor:
    """1 where a foot's horizontal contact force exceeds ``ratio`` times its vertical one, else 0. Not in Isaac Lab."""
    force = picked(env.scene.contact_sensor(sensor_cfg.name).data.net_forces_w, sensor_cfg.body_ids)
    return (_length(force[..., :2]) > ratio * force[..., 2].abs()).any(dim=1).float()


def feet_clearance_l2(env: Env, clearance: Positive, asset_cfg: SceneEntityCfg) -> torch.Tensor:
    """Sum over feet of (h - clearance)^2 times horizontal speed, m^3/s, h above the ground, m. Not in Isaac Lab."""
    data, ids = env.scene.articulations[asset_cfg.name].data, asset_cfg.body_ids
    error = height_over_ground(env, picked(data.body_pos_w, ids)) - clearance
    return (error.square() * _speed(data.body_lin_vel_w[:, ids])).sum(dim=1)


def air_time_variance(env: Env, sensor_cfg: SceneEntityCfg, max_time: Positive = 0.5) -> torch.Tensor:
    """Variance of the feet's last air times plus variance of the feet's last contact times, s^2.

    Not in Isaac Lab's library. Times are clipped to ``max_time`` (s). The sensor must track air and contact times.
    """
    data, ids = env.scene.contact_sensor(sensor_cfg.name).data, sensor_cfg.body_ids
    flights, stances = picked(data.last_air_time, ids), picked(data.last_contact_time, ids)
    return flights.clamp(max=max_time).var(dim=1) + stances.clamp(max=max_time).var(dim=1)


def wheel_slip(
    env: Env, radius: Positive, sensor_cfg: SceneEntityCfg, asset_cfg: SceneEntityCfg, threshold: NonNegative = 1.0
) -> torch.Tensor:
    """Sum of the slip speeds at the wheels' contact points, m/s; 0 for wheels that roll without slip.

    A contact point moves at v + w x (-r n): n is the normal of the contact force, v the velocity of the wheel's centre
    of mass, w its angular velocity. Slip is the part along the ground.

    Args:
        radius: r of the wheels, m.
        sensor_cfg: the wheels of a contact sensor.
        asset_cfg: the same bodies of the robot, in the same order.
        threshold: force above which a wheel is on the ground, N.
    """
    data, ids = env.scene.articulations[asset_cfg.name].data, asset_cfg.body_ids
    force = picked(env.scene.contact_sensor(sensor_cfg.name).data.net_forces_w, sensor_cfg.body_ids)
    centre, spin = picked(data.body_lin_vel_w, ids), picked(data.body_ang_vel_w, ids)
    require_pairs(force, centre, "asset_cfg.body_names")
    size = _length(force)
    normal = force / size.unsqueeze(-1).clamp(min=1e-6)
    slip = centre - radius * torch.cross(spin, normal, dim=-1)
    along = slip - (slip * normal).sum(dim=-1, keepdim=True) * normal
    return (_length(along) * (size > threshold)).sum(dim=1)


def wheel_spin_in_air_l1(
    env: Env, sensor_cfg: SceneEntityCfg, asset_cfg: SceneEntityCfg, threshold: NonNegative = 1.0
) -> torch.Tensor:
    """Sum of the angular speeds of all wheels that are in the air, rad/s. Not in Isaac Lab.

    Args:
        sensor_cfg: the wheels of a contact sensor.
        asset_cfg: the wheels' joints, in the same order.
        threshold: force up to which a wheel is in the air, N.
    """
    flies = picked(env.scene.contact_sensor(sensor_cfg.name).max_force_norm(), sensor_cfg.body_ids) <= threshold
    speed = picked(env.scene.articulations[asset_cfg.name].data.joint_vel, asset_cfg.joint_ids).abs()
    require_pairs(flies, speed, "asset_cfg.joint_names")
    return (speed * flies).sum(dim=1)
