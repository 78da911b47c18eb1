"""Command terms."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping
from typing import Any, Literal, get_args

import torch

from wheelleg_exp.constraints import Broken, Interval, NonNegative, PositiveInterval, Share, relation
from wheelleg_exp.managers import CommandTerm, Env, bounds
from wheelleg_exp.sim.rotation import wrap_to_pi

_Axis = Literal["lin_vel_x", "lin_vel_y", "ang_vel_z", "heading"]


def _heading_has_a_range(given: Mapping[str, Any]) -> Iterator[Broken]:
    if given["heading_command"] and given["ranges"].get("heading") is None:
        yield Broken("ranges.heading", "heading_command needs a heading range", "[low, high] in radians")


@relation(_heading_has_a_range)
class UniformVelocityCommand(CommandTerm):
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
    """

    def __init__(
        self,
        env: Env,
        ranges: Mapping[_Axis, Interval | None],
        resampling_time_range: PositiveInterval,
        generator: torch.Generator,
        rel_standing_envs: Share = 0.0,
        rel_heading_envs: Share = 1.0,
        heading_command: bool = False,
        heading_control_stiffness: NonNegative = 1.0,
    ) -> None:
        super().__init__(env, resampling_time_range, ("error_vel_xy", "error_vel_yaw"), generator)
        if ranges.get("heading") is not None and not heading_command:
            warnings.warn("a heading range is given, but heading_command is off", stacklevel=2)
        named = {axis: pair for axis, pair in ranges.items() if pair is not None}
        low, high = bounds(named, get_args(_Axis), "ranges", env.device)
        # A tuple: tensors among the attributes are state.
        self._ranges = (low, high)
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

    def errors(self) -> torch.Tensor:
        """Return |v_xy error| in m/s and |w_z error| in rad/s, (2, N)."""
        data = self._env.scene.robot.data
        xy = torch.linalg.vector_norm(self._command[:, :2] - data.root_lin_vel_b[:, :2], dim=1)
        yaw = (self._command[:, 2] - data.root_ang_vel_b[:, 2]).abs()
        return torch.stack((xy, yaw))

    def draw(self, env_ids: torch.Tensor) -> None:
        """Draw velocities, headings and who stands."""
        u = torch.rand(len(env_ids), 6, generator=self._generator, device=self._command.device)
        low, high = self._ranges
        drawn = low + (high - low) * u[:, :4]
        self._command[env_ids] = drawn[:, :3]
        if self._has_heading:
            self.heading_target[env_ids] = drawn[:, 3]
            self.is_heading_env[env_ids] = u[:, 4] <= self._rel_heading
        self.is_standing_env[env_ids] = u[:, 5] <= self._rel_standing

    def post_process(self) -> None:
        """Steer towards headings, then stop those that stand."""
        if self._has_heading:
            error = wrap_to_pi(self.heading_target - self._env.scene.robot.data.heading_w)
            steered = torch.clamp(self._stiffness * error, self._ranges[0][2], self._ranges[1][2])
            self._command[:, 2] = torch.where(self.is_heading_env, steered, self._command[:, 2])
        self._command.masked_fill_(self.is_standing_env.unsqueeze(1), 0.0)
