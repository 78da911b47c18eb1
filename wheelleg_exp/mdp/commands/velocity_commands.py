"""Velocity commands: uniform, normal, with a target heading, and with an integrated travel error."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator, Mapping, Sequence
from typing import Annotated, Any, Literal, get_args

import mujoco
import torch

from wheelleg_exp.constraints import Broken, Interval, Length, NonNegative, Positive, PositiveInterval, Share, relation
from wheelleg_exp.errors import ConfigError
from wheelleg_exp.managers import Env, SceneEntityCfg, member
from wheelleg_exp.mdp.commands.command_ranges import RangedCommand, command_of
from wheelleg_exp.mdp.root_motion import default_pose
from wheelleg_exp.sim.class_members import alias_of
from wheelleg_exp.sim.ids import fill_rows
from wheelleg_exp.sim.rotation import wrap_to_pi

VelocityAxis = Literal["lin_vel_x", "lin_vel_y", "ang_vel_z", "heading"]


def _heading_has_a_range(ranges: Mapping[str, object], heading_command: bool = False) -> Iterator[Broken]:
    if heading_command and ranges.get("heading") is None:
        yield Broken("ranges.heading", "heading_command needs a heading range", "[low, high] in radians")


@relation(_heading_has_a_range)
class UniformVelocityCommand(RangedCommand):
    """Planar velocity in the base's axes: (v_x, v_y) in m/s and yaw rate in rad/s, uniform in their ranges.

    The command is zero in environments that are drawn as standing. With ``heading_command``, some environments turn
    towards a target heading with the yaw rate ``w_z = clip(k * wrap(target - heading))``. As in Isaac Lab, the first
    observation after ``reset`` contains the drawn velocity even if the robot must stand or turn.

    Args:
        ranges: ``lin_vel_x``, ``lin_vel_y`` (m/s), ``ang_vel_z`` (rad/s), and ``heading`` (rad, or null).
        rel_standing_envs: share of draws that stand still.
        rel_heading_envs: share of draws that follow a heading.
        heading_command: whether headings are drawn.
        heading_control_stiffness: k, 1/s.
        limit_ranges: widest ranges, for terms of other projects that read ``command.cfg.limit_ranges``.
    """

    def __init__(
        self,
        env: Env,
        ranges: Mapping[VelocityAxis, Interval | None],
        resampling_time_range: PositiveInterval,
        generator: torch.Generator,
        rel_standing_envs: Share = 0.0,
        rel_heading_envs: Share = 1.0,
        heading_command: bool = False,
        heading_control_stiffness: NonNegative = 1.0,
        asset_name: str = "robot",
        limit_ranges: Mapping[VelocityAxis, Interval | None] | None = None,
    ) -> None:
        super().__init__(env, resampling_time_range, ("error_vel_xy", "error_vel_yaw"), generator)
        self.robot = member(env.scene, asset_name, "asset_name")
        if ranges.get("heading") is not None and not heading_command:
            warnings.warn("a heading range is given, but heading_command is off", stacklevel=2)
        self.take_ranges(ranges, get_args(VelocityAxis))
        limits = {str(axis): list(pair) for axis, pair in (limit_ranges or {}).items() if pair is not None}
        self.limit_ranges = self.setting("limit_ranges", limits)
        self._has_heading = heading_command
        self._rel_standing, self._rel_heading = rel_standing_envs, rel_heading_envs
        self._stiffness = heading_control_stiffness
        n, device = env.num_envs, env.device
        self._command = self.buffer("_command", torch.zeros(n, 3, device=device))
        self.heading_target = self.buffer("heading_target", torch.zeros(n, device=device))
        self.is_heading_env = self.buffer("is_heading_env", torch.zeros(n, dtype=torch.bool, device=device))
        self.is_standing_env = self.buffer("is_standing_env", torch.zeros(n, dtype=torch.bool, device=device))

    command = alias_of("_command", "The present command (N, 3): v_x, v_y in m/s, w_z in rad/s, base axes.")
    vel_command_b = alias_of("_command", "The present velocity command (N, 3), under its name in Isaac Lab.")

    @property
    def asked(self) -> torch.Tensor:
        """The drawn velocity (N, 3), which equals the command unless a subclass limits the command's acceleration."""
        return self._command

    def errors(self) -> torch.Tensor:
        """Return the norm of the planar velocity error, m/s, and the absolute yaw rate error, rad/s, (2, N)."""
        data = self.robot.data
        xy = torch.linalg.vector_norm(self._command[:, :2] - data.root_lin_vel_b[:, :2], dim=1)
        yaw = (self._command[:, 2] - data.root_ang_vel_b[:, 2]).abs()
        return torch.stack((xy, yaw))

    def draw(self, env_ids: torch.Tensor) -> None:
        u = torch.rand(env_ids.shape[0], 6, generator=self._generator, device=self._command.device)
        low, high = self.bounds()
        drawn = low + (high - low) * u[:, :4]
        self.asked.index_copy_(0, env_ids, drawn[:, :3])
        if self._has_heading:
            self.heading_target.index_copy_(0, env_ids, drawn[:, 3])
            self.is_heading_env.index_copy_(0, env_ids, u[:, 4] <= self._rel_heading)
        self.is_standing_env.index_copy_(0, env_ids, u[:, 5] <= self._rel_standing)

    def post_process(self) -> None:
        if self._has_heading:
            error = wrap_to_pi(self.heading_target - self.robot.data.heading_w)
            low, high = self.bounds()
            steered = torch.clamp(self._stiffness * error, low[2], high[2])
            self.asked[:, 2] = torch.where(self.is_heading_env, steered, self.asked[:, 2])
        self.asked.masked_fill_(self.is_standing_env.unsqueeze(1), 0.0)


_Moment = Literal["mean_vel", "std_vel", "zero_prob"]
_Three = Annotated[Sequence[float], Length(3)]


def _is_a_distribution(ranges: Mapping[str, _Three]) -> Iterator[Broken]:
    for name in get_args(_Moment):
        if name not in ranges:
            yield Broken(f"ranges.{name}", "the moment is missing", "three numbers: v_x, v_y, w_z")
    if any(number < 0.0 for number in ranges.get("std_vel", ())):
        yield Broken("ranges.std_vel", "a standard deviation is below 0", "three numbers of at least 0")
    if not all(0.0 <= number <= 1.0 for number in ranges.get("zero_prob", ())):
        yield Broken("ranges.zero_prob", "is not a probability", "three numbers from 0 to 1")


@relation(_is_a_distribution)
class NormalVelocityCommand(UniformVelocityCommand):
    """Planar velocity in the base's axes: each component is +N(mean, std) or -N(mean, std) with equal chance, or 0.

    Args:
        ranges: ``mean_vel``, ``std_vel`` and ``zero_prob``: means, standard deviations, and probabilities of zero for
            v_x, v_y (m/s) and w_z (rad/s).
    """

    def __init__(
        self,
        env: Env,
        ranges: Mapping[_Moment, _Three],
        resampling_time_range: PositiveInterval,
        generator: torch.Generator,
        rel_standing_envs: Share = 0.0,
        asset_name: str = "robot",
    ) -> None:
        super().__init__(env, {}, resampling_time_range, generator, rel_standing_envs, asset_name=asset_name)
        self._moments = tuple(torch.tensor(list(ranges[name]), device=env.device) for name in get_args(_Moment))
        is_zero_vel_env = torch.zeros(env.num_envs, 3, dtype=torch.bool, device=env.device)
        self.is_zero_vel_env = self.buffer("is_zero_vel_env", is_zero_vel_env)

    def draw(self, env_ids: torch.Tensor) -> None:
        device, mean, std, zero = self._command.device, *self._moments
        normal = torch.randn(env_ids.shape[0], 3, generator=self._generator, device=device)
        u = torch.rand(env_ids.shape[0], 7, generator=self._generator, device=device)
        self._command[env_ids] = torch.where(u[:, :3] <= 0.5, 1.0, -1.0) * (mean + std * normal)
        self.is_zero_vel_env[env_ids] = u[:, 3:6] < zero
        self.is_standing_env[env_ids] = u[:, 6] <= self._rel_standing

    def post_process(self) -> None:
        super().post_process()
        self._command.masked_fill_(self.is_zero_vel_env, 0.0)


_ROLLS = 0.5  # A wheel can roll along x if its axle is less than 60 degrees away from the y axis.


class UniformVelocityTravelCommand(UniformVelocityCommand):
    """A uniform velocity command that also integrates the robot's velocity error. Not in Isaac Lab.

    A policy that observes only velocities, whose measurements have errors, drifts at a zero command. With the
    integrated error, it can hold its position, like an integral controller. The error is computed from what a robot can
    measure: the rates of its rolling wheels, and the yaw rate of its gyroscope.

    A robot on two wheels must first roll back before it can drive off, and it falls if the command jumps to a high
    speed. With ``max_lin_acceleration`` and ``max_ang_acceleration``, the command starts from zero at a reset and
    approaches the drawn target (``asked``) at a limited rate.

    Args:
        wheel_cfg: joints of the wheels; their axes in the model give the rolling directions, also of mirrored wheels.
        wheel_radius: radius of the wheels, m.
        max_travel_error: bound of the integrated distance, m; distance beyond it is forgotten.
        max_heading_error: bound of the integrated angle, rad.
        max_lin_acceleration: largest change of the commanded speed, m/s²; null means unlimited.
        max_ang_acceleration: largest change of the commanded yaw rate, rad/s²; null means unlimited.

    Attributes:
        max_acceleration: largest change of each component, m/s², m/s², rad/s²; None means unlimited.
        fastest: largest change of the commanded speed in a control step, m/s.
        travel_error: travelled minus commanded distance, m, and turned minus commanded angle, rad, (N, 2).
        wheel_signs: for each wheel 1 if positive speed rolls forwards, else -1.
    """

    def __init__(
        self,
        env: Env,
        ranges: Mapping[VelocityAxis, Interval | None],
        resampling_time_range: PositiveInterval,
        generator: torch.Generator,
        wheel_cfg: SceneEntityCfg,
        wheel_radius: Positive,
        max_travel_error: Positive,
        max_heading_error: Positive,
        max_lin_acceleration: Positive | None = None,
        max_ang_acceleration: Positive | None = None,
        rel_standing_envs: Share = 0.0,
        rel_heading_envs: Share = 1.0,
        heading_command: bool = False,
        heading_control_stiffness: NonNegative = 1.0,
        asset_name: str = "robot",
    ) -> None:
        heading = (rel_heading_envs, heading_command, heading_control_stiffness)
        super().__init__(env, ranges, resampling_time_range, generator, rel_standing_envs, *heading, asset_name)
        self._wheels = member(env.scene, wheel_cfg.name, "wheel_cfg.name")
        self._wheel_ids, self._radius = wheel_cfg.joint_ids, wheel_radius
        signs = rolling_signs(env.scene.sim.model, self._wheels, wheel_cfg.joint_ids)
        self.wheel_signs = tuple(signs)
        self._signs = torch.tensor(signs, device=env.device)
        self.travel_error = self.buffer("travel_error", torch.zeros(env.num_envs, 2, device=env.device))
        self._asked = self.buffer("_asked", torch.zeros(env.num_envs, 3, device=env.device))
        self.max_acceleration = (max_lin_acceleration, max_lin_acceleration, max_ang_acceleration)
        most = [math.inf if limit is None else limit for limit in self.max_acceleration]
        self._fastest = torch.tensor(most, device=env.device) * env.step_dt
        self.fastest = most[0] * env.step_dt
        self._most = torch.tensor([max_travel_error, max_heading_error], device=env.device)

    @property
    def rolled(self) -> torch.Tensor:
        """Speed at which the wheels roll, on average, m/s, (N,)."""
        speeds: torch.Tensor = self._wheels.data.joint_vel[:, self._wheel_ids] * self._signs
        return speeds.mean(dim=1) * self._radius

    def compute(self, dt: float) -> torch.Tensor:
        turned = self.robot.data.root_ang_vel_measured[:, 2]
        missed = torch.stack((self.rolled - self._command[:, 0], turned - self._command[:, 2]), dim=1)
        self.travel_error.add_(missed * dt).clamp_(-self._most, self._most)
        return super().compute(dt)

    asked = alias_of("_asked")

    def post_process(self) -> None:
        super().post_process()
        self._command.add_((self._asked - self._command).clamp_(-self._fastest, self._fastest))

    def finish_episode(self, env_ids: torch.Tensor) -> dict[str, torch.Tensor]:
        fill_rows(self.travel_error, env_ids, 0.0)
        log = super().finish_episode(env_ids)
        asked = self._asked.index_select(0, env_ids).clamp(-self._fastest, self._fastest)
        self._command.index_copy_(0, env_ids, asked)
        return log


def rolling_signs(model: mujoco.MjModel, robot: Any, joint_ids: torch.Tensor | Sequence[int] | slice) -> list[float]:
    """Return 1 for each wheel that a positive joint velocity rolls along the base's x axis, otherwise -1.

    ``joint_ids`` are indices in ``robot.joint_names``. In the default pose, a wheel rolls along the cross product of
    its axis and the vertical: the sign is that of the axis' component along the base's y axis.
    """
    data = default_pose(model, robot)
    left = data.xmat[int(robot.body_ids[0])].reshape(3, 3)[:, 1]
    signs = []
    for index in torch.arange(len(robot.joint_names), device=robot.body_ids.device)[joint_ids].tolist():
        joint = model.joint(robot.joint_names[index])
        along = float(data.xaxis[joint.id] @ left) if joint.type[0] == mujoco.mjtJoint.mjJNT_HINGE else 0.0
        if abs(along) < _ROLLS:
            message = f"joint '{joint.name}' does not roll the robot forwards or backwards"
            expected = "wheels: hinges whose axis is along the base's y"
            raise ConfigError(message, key="wheel_cfg.joint_names", expected=expected)
        signs.append(math.copysign(1.0, along))
    return signs


def integrated_travel_error(env: Env, command_name: str) -> torch.Tensor:
    """Return the integrated distance error (m) and heading error (rad) of a travel command, (N, 2)."""
    return command_of(env, command_name, UniformVelocityTravelCommand, "integrate its error").travel_error
