"""Wider commands for robots that follow them better than one that stands still."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Annotated, Any

import torch

from wheelleg_exp.constraints import Count, Interval, NonNegative, NotEmpty, Positive, Share
from wheelleg_exp.errors import ConfigError, nearest_name
from wheelleg_exp.managers import Env, SceneEntityCfg, TermBase
from wheelleg_exp.sim.ids import fill_rows

_ROBOT = SceneEntityCfg("robot")
_AXES = ("lin_vel_x", "lin_vel_y", "ang_vel_z")  # of a velocity command, in its order


class command_levels_by_skill(TermBase):
    """Widen the ranges of a velocity command where it is followed with skill; returns highs and skills.

    Each axis is judged by itself, over at least ``min_episodes`` episodes that have ended, on the steps alone in which
    it is told to move: S = (score - still) / (1 - still), with score the mean of exp(-e²/std²) for the error e, and
    still the same for a robot that never moves, mean of exp(-c²/std²) for the command c. S is 0 for standing still and
    1 for perfect tracking, whatever the ranges and std are. An episode that ends by a failure counts as long as a
    longest one, and scores nothing in its rest. After ``passes`` judgements in a row with S >= ``threshold`` the range
    grows by ``step`` to both sides; episodes that began before count no more. An axis whose range is not at its
    limit and has not grown in ``patience`` judgements is stuck: ``<axis>_stuck`` is 1, and training warns.

    Args:
        env: the environment.
        limit_ranges: [low, high] that each axis grows to; other axes stay as they are.
        std: by axis, m/s or rad/s: error that leaves 1/e of the score.
        step: by axis, growth to each side, m/s or rad/s.
        command_name: the command: v_x, v_y, w_z.
        threshold: skill from which on a judgement is passed.
        min_episodes: fewest episodes of a judgement.
        passes: judgements in a row that must be passed.
        patience: judgements without growth after which an axis is stuck.
        command_threshold: m/s or rad/s, up to which an axis is not told to move.
        asset_cfg: the robot.
    """

    def __init__(
        self,
        env: Env,
        limit_ranges: Annotated[Mapping[str, Interval], NotEmpty()],
        std: Mapping[str, Positive],
        step: Mapping[str, Positive],
        command_name: str = "base_velocity",
        threshold: Share = 0.7,
        min_episodes: Count = 256,
        passes: Count = 3,
        patience: Count = 20,
        command_threshold: NonNegative = 0.02,
        asset_cfg: SceneEntityCfg = _ROBOT,
    ) -> None:
        self._env, self._command, self._asset = env, command_name, asset_cfg.name
        self._limits = {axis: (float(low), float(high)) for axis, (low, high) in limit_ranges.items()}
        for error in self._mistakes(env, {"std": std, "step": step}):
            raise error
        self._names = tuple(self._limits)
        self._columns = [_AXES.index(axis) for axis in self._names]
        self._variances = tuple(float(std[axis]) ** 2 for axis in self._names)
        self._steps = {axis: float(step[axis]) for axis in self._names}
        self._threshold, self._least, self._passes, self._patience = threshold, min_episodes, passes, patience
        self._moves_from = command_threshold
        shape = (3, len(self._names), env.num_envs)
        self._sums = torch.zeros(shape, device=env.device)  # score, still and steps of the present episodes
        self._total = torch.zeros(shape[:2], device=env.device)  # of those that have ended
        self._counts = torch.ones(env.num_envs, dtype=torch.bool, device=env.device)  # begun since the last growth
        self._ended = 0
        self._streak = dict.fromkeys(self._names, 0)
        self._idle = dict.fromkeys(self._names, 0)
        self._skill = dict.fromkeys(self._names, 0.0)
        env.observers.append(self.observe)

    def observe(self) -> None:
        """Add this step to the present episodes."""
        data = self._env.scene[self._asset].data
        command = self._env.command_manager.get_command(self._command)
        velocity = torch.cat((data.root_lin_vel_b[:, :2], data.root_ang_vel_b[:, 2:]), dim=1)
        for row, (column, variance) in enumerate(zip(self._columns, self._variances, strict=True)):
            told = command[:, column]
            moves = (told.abs() > self._moves_from).to(told.dtype)
            self._sums[0, row] += moves * torch.exp(-(told - velocity[:, column]).square() / variance)
            self._sums[1, row] += moves * torch.exp(-told.square() / variance)
            self._sums[2, row] += moves

    def __call__(self, env: Env, env_ids: torch.Tensor) -> dict[str, float]:
        """Add the episodes that end, and judge when there are enough."""
        length = env.episode_length_buf[env_ids]
        failed = env.termination_manager.terminated[env_ids] & (length > 0)
        rest = torch.where(failed, env.max_episode_length / length.clamp(min=1), 1.0).to(self._total.dtype)
        counted = self._counts[env_ids] & (length > 0)
        sums = self._sums[:, :, env_ids].to(self._total.dtype)
        sums[1:] *= rest  # a failure scores nothing in what would have been left
        self._total += (sums * counted).sum(dim=2)
        self._sums[:, :, env_ids] = 0.0
        fill_rows(self._counts, env_ids, True)
        self._ended += int(counted.sum())
        if self._ended >= self._least:
            self._judge(env)
        ranges = self._ranges(env)
        highs = {axis: float(ranges[axis][1]) for axis in self._names}
        skills = {f"{axis}_skill": self._skill[axis] for axis in self._names}
        stuck = {f"{axis}_stuck": float(self._idle[axis] >= self._patience) for axis in self._names}
        return highs | skills | stuck

    def _judge(self, env: Env) -> None:
        ranges, grown = self._ranges(env), False
        for axis, total in zip(self._names, self._total.unbind(dim=1), strict=True):
            score, still, steps = map(float, total)
            if steps - still <= 0.0:  # nobody was told to move
                continue
            self._skill[axis] = (score - still) / (steps - still)
            lowest, highest = self._limits[axis]
            low, high = ranges[axis]
            passed = self._skill[axis] >= self._threshold
            self._streak[axis] = self._streak[axis] + 1 if passed else 0
            self._idle[axis] = 0 if (low, high) == (lowest, highest) else self._idle[axis] + 1
            if self._streak[axis] >= self._passes and (low, high) != (lowest, highest):
                ranges[axis] = [max(low - self._steps[axis], lowest), min(high + self._steps[axis], highest)]
                self._streak[axis], self._idle[axis], grown = 0, 0, True
        if grown:
            self._counts.fill_(False)
        self._total.zero_()
        self._ended = 0

    def _ranges(self, env: Env) -> dict[str, Any]:
        ranges: dict[str, Any] = getattr(env.command_manager.get_term(self._command), "ranges", {})
        return ranges

    def _mistakes(self, env: Env, by_axis: Mapping[str, Mapping[str, float]]) -> Iterator[ConfigError]:
        """Yield axes without a range, a std or a step, and ranges beyond their limits."""
        ranges = self._ranges(env)
        known = [axis for axis in _AXES if axis in ranges]
        for axis, (lowest, highest) in self._limits.items():
            key = f"limit_ranges.{axis}"
            if axis not in known:
                expected = f"one of {', '.join(known)}" if known else "a command with ranges of velocities"
                message = f"'{self._command}' has no range '{axis}'"
                yield ConfigError(message, key=key, expected=expected, nearest=nearest_name(axis, known))
            elif ranges[axis][0] < lowest or ranges[axis][1] > highest:
                first = f"{list(ranges[axis])} of '{self._command}'"
                message = f"{first} lies beyond {[lowest, highest]}"
                yield ConfigError(message, key=key, expected=f"a range around {first}")
            for name, values in by_axis.items():
                if axis not in values:
                    yield ConfigError("is missing", key=f"{name}.{axis}", expected="a number above 0")
