"""Velocities in the base's axes."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping, Sequence
from typing import Annotated, Any, Literal, get_args

import torch

from wheelleg_exp.constraints import Broken, Interval, Length, NonNegative, PositiveInterval, Share, relation
from wheelleg_exp.managers import Env, member
from wheelleg_exp.mdp.commands.ranges import RangedCommand
from wheelleg_exp.sim.rotation import wrap_to_pi

VelocityAxis = Literal["lin_vel_x", "lin_vel_y", "ang_vel_z", "heading"]


def _heading_has_a_range(given: Mapping[str, Any]) -> Iterator[Broken]:
    if given.get("heading_command") and given["ranges"].get("heading") is None:
        yield Broken("ranges.heading", "heading_command needs a heading range", "[low, high] in radians")


@relation(_heading_has_a_range)
class UniformVelocityCommand(RangedCommand):
    """Planar velocity in the base's axes: (v_x, v_y) in m/s and yaw rate in rad/s, uniform in their ranges.

    Standing environments get zero. With ``heading_command`` some environments follow a target heading instead,
    by ``w_z = clip(k * wrap(target - heading))``. Both act from the first ``compute`` after a draw on, so the
    observation right after ``reset`` shows the drawn values, as in Isaac Lab.

    Args:
        env: the environment.
        ranges: ``lin_vel_x``, ``lin_vel_y`` (m/s), ``ang_vel_z`` (rad/s), ``heading`` (rad, or null).
        resampling_time_range: shortest and longest time between two draws, s.
        generator: the term's random stream.
        rel_standing_envs: share of draws that stand still.
        rel_heading_envs: share of draws that follow a heading.
        heading_command: whether headings are drawn at all.
        heading_control_stiffness: k, 1/s.
        asset_name: the member of the scene that is commanded.
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
    ) -> None:
        super().__init__(env, resampling_time_range, ("error_vel_xy", "error_vel_yaw"), generator)
        self.robot = member(env.scene, asset_name, "asset_name")
        if ranges.get("heading") is not None and not heading_command:
            warnings.warn("a heading range is given, but heading_command is off", stacklevel=2)
        self.take_ranges(ranges, get_args(VelocityAxis))
        self._has_heading = heading_command
        self._rel_standing, self._rel_heading = rel_standing_envs, rel_heading_envs
        self._stiffness = heading_control_stiffness
        n, device = env.num_envs, env.device
        self._command = torch.zeros(n, 3, device=device)
        self.heading_target = torch.zeros(n, device=device)
        self.is_heading_env = torch.zeros(n, dtype=torch.bool, device=device)
        self.is_standing_env = torch.zeros(n, dtype=torch.bool, device=device)

    @property
    def command(self) -> torch.Tensor:
        """The present command (N, 3): v_x, v_y in m/s, w_z in rad/s, base axes."""
        return self._command

    @property
    def vel_command_b(self) -> torch.Tensor:
        """The same, under Isaac Lab's name."""
        return self._command

    @property
    def asked(self) -> torch.Tensor:
        """What is asked for in the end (N, 3): the command itself, unless a class of this lets it get there slowly."""
        return self._command

    def errors(self) -> torch.Tensor:
        """Return |v_xy error| in m/s and |w_z error| in rad/s, (2, N)."""
        data = self.robot.data
        xy = torch.linalg.vector_norm(self._command[:, :2] - data.root_lin_vel_b[:, :2], dim=1)
        yaw = (self._command[:, 2] - data.root_ang_vel_b[:, 2]).abs()
        return torch.stack((xy, yaw))

    def draw(self, env_ids: torch.Tensor) -> None:
        """Draw velocities, headings and who stands."""
        u = torch.rand(env_ids.shape[0], 6, generator=self._generator, device=self._command.device)
        low, high = self.bounds()
        drawn = low + (high - low) * u[:, :4]
        self.asked.index_copy_(0, env_ids, drawn[:, :3])
        if self._has_heading:
            self.heading_target.index_copy_(0, env_ids, drawn[:, 3])
            self.is_heading_env.index_copy_(0, env_ids, u[:, 4] <= self._rel_heading)
        self.is_standing_env.index_copy_(0, env_ids, u[:, 5] <= self._rel_standing)

    def post_process(self) -> None:
        """Steer towards headings, then stop those that stand."""
        if self._has_heading:
            error = wrap_to_pi(self.heading_target - self.robot.data.heading_w)
            low, high = self.bounds()
            steered = torch.clamp(self._stiffness * error, low[2], high[2])
            self.asked[:, 2] = torch.where(self.is_heading_env, steered, self.asked[:, 2])
        self.asked.masked_fill_(self.is_standing_env.unsqueeze(1), 0.0)


_Moment = Literal["mean_vel", "std_vel", "zero_prob"]
_Three = Annotated[Sequence[float], Length(3)]


def _is_a_distribution(given: Mapping[str, Any]) -> Iterator[Broken]:
    ranges = given["ranges"]
    for name in get_args(_Moment):
        if name not in ranges:
            yield Broken(f"ranges.{name}", "is missing", "three numbers: v_x, v_y, w_z")
    if any(number < 0.0 for number in ranges.get("std_vel", ())):
        yield Broken("ranges.std_vel", "a deviation is below 0", "three numbers of at least 0")
    if not all(0.0 <= number <= 1.0 for number in ranges.get("zero_prob", ())):
        yield Broken("ranges.zero_prob", "is no probability", "three numbers from 0 to 1")


@relation(_is_a_distribution)
class NormalVelocityCommand(UniformVelocityCommand):
    """Planar velocity in the base's axes: each component is +-N(mean, std), both signs alike, or 0 by a chance.

    Zeros act from the first ``compute`` after a draw on. There are no headings.

    Args:
        env: the environment.
        ranges: ``mean_vel``, ``std_vel`` and ``zero_prob`` of v_x, v_y (m/s) and w_z (rad/s).
        resampling_time_range: shortest and longest time between two draws, s.
        generator: the term's random stream.
        rel_standing_envs: share of draws that stand still.
        asset_name: the member of the scene that is commanded.
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
        # A tuple: tensors among the attributes are state.
        self._moments = tuple(torch.tensor(list(ranges[name]), device=env.device) for name in get_args(_Moment))
        self.is_zero_vel_env = torch.zeros(env.num_envs, 3, dtype=torch.bool, device=env.device)

    def draw(self, env_ids: torch.Tensor) -> None:
        """Draw velocities, which components are zero, and who stands."""
        device, mean, std, zero = self._command.device, *self._moments
        normal = torch.randn(env_ids.shape[0], 3, generator=self._generator, device=device)
        u = torch.rand(env_ids.shape[0], 7, generator=self._generator, device=device)
        self._command[env_ids] = torch.where(u[:, :3] <= 0.5, 1.0, -1.0) * (mean + std * normal)
        self.is_zero_vel_env[env_ids] = u[:, 3:6] < zero
        self.is_standing_env[env_ids] = u[:, 6] <= self._rel_standing

    def post_process(self) -> None:
        """Stop those that stand, and the components that are zero."""
        super().post_process()
        self._command.masked_fill_(self.is_zero_vel_env, 0.0)
