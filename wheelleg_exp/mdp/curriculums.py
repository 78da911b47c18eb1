"""Curriculum terms change settings while a policy learns; the training log contains the terms' return values."""

from __future__ import annotations

import copy
import inspect
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Annotated, Any, ClassVar

import torch

from wheelleg_exp.constraints import Count, Interval, Natural, NonNegative, NotEmpty, Positive, Share
from wheelleg_exp.errors import ConfigError, nearest_name
from wheelleg_exp.managers import Env, SceneEntityCfg, TermBase
from wheelleg_exp.mdp.config_address import Part, look_up, parse, require_writable, terms_of, write
from wheelleg_exp.mdp.root_motion import level_velocity
from wheelleg_exp.sim.ids import fill_rows
from wheelleg_exp.terms.term_binding import resolve_target


def modify_reward_weight(env: Env, env_ids: torch.Tensor, term_name: str, weight: float, num_steps: Natural) -> float:
    """Set a reward term's weight after ``num_steps`` control steps of training; return the present weight."""
    del env_ids  # A reward term has the same weight in all environments, so the weight does not depend on ``env_ids``.
    term = env.reward_manager.get_term_cfg(term_name)
    if env.common_step_counter > num_steps:
        term.fields["weight"] = weight
    return float(term.fields["weight"])


class action_delay_levels(TermBase):
    """Raise a robot's level after an episode that it survives, lower it after a fall; return the mean level.

    Delays are shortest at level 0, and in their full ranges from level 0.5 on: a robot that cannot stand yet learns
    slowly if its actions are late. ``push_by_adding_velocity`` can also depend on the level. Not in Isaac Lab.

    Args:
        num_episodes: survived episodes from level 0 to level 1. A fall at the start of an episode lowers the level as
            much as a survived episode raises it, and a later fall lowers it less.
        max_tilt: a robot with a larger tilt at the end of its episode counts as fallen, rad; null for no limit. Tasks
            in which no fall ends an episode need it.

    Attributes:
        level: each robot's level, from 0 to 1, (N,).
    """

    def __init__(self, env: Env, num_episodes: Count, max_tilt: Positive | None = None) -> None:
        self._num_episodes = num_episodes
        self._max_tilt = math.inf if max_tilt is None else max_tilt
        self.level = self.buffer("level", torch.zeros(env.num_envs, device=env.device))

    def __call__(self, env: Env, env_ids: torch.Tensor) -> torch.Tensor:
        share = env.episode_length_buf[env_ids] / env.max_episode_length
        change = torch.where(env.termination_manager.time_outs[env_ids], 1.0, share - 1.0)
        tilt = torch.acos((-env.scene.robot.data.projected_gravity_b[env_ids, 2]).clamp(-1.0, 1.0))
        change = torch.where(tilt > self._max_tilt, -1.0, change)
        self.level[env_ids] = (self.level[env_ids] + change / self._num_episodes).clamp(0.0, 1.0)
        for delay in env.action_manager.delays.values():
            delay.share.copy_((2.0 * self.level).clamp(max=1.0))
        return self.level.mean()


_NO_CHANGE = object()
_SECTIONS = ("commands", "actions", "observations", "events", "rewards", "terminations")
_MANAGERS = {section: f"{section.removesuffix('s')}_manager" for section in _SECTIONS}


class modify_env_param(TermBase):
    """Change the environment's setting at ``address`` with the function ``modify_fn``, and log numeric settings.

    The address is dotted, with ``[i]`` for list elements: ``event_manager.cfg.push_robot.params.velocity_range.x[1]``.
    Checkpoints contain the changed value.

    Args:
        address: address of the value.
        modify_fn: dotted name of the function, or a node that builds it, such as one of ``wheelleg_exp.mdp.schedules``.
            It is called as ``modify_fn(env, env_ids, old_value, **modify_params)``, and returns the new value, or
            ``modify_env_param.NO_CHANGE``.
        modify_params: further arguments of the function, by name.
    """

    NO_CHANGE: ClassVar[Any] = _NO_CHANGE

    def __init__(
        self,
        env: Env,
        address: str,
        modify_fn: str | Callable[..., object],
        modify_params: Mapping[str, object] | None = None,
    ) -> None:
        self._env = env
        self._parts = self.parts_of(address)
        self._params = dict(modify_params or {})
        self._modify = resolve_target(modify_fn, "modify_fn") if isinstance(modify_fn, str) else modify_fn
        if not callable(self._modify):
            message = f"{modify_fn!r} cannot be called"
            raise ConfigError(message, key="modify_fn", expected="the dotted name of a function")
        try:
            inspect.signature(self._modify).bind(env, None, None, **self._params)
        except TypeError as error:
            message = f"'{getattr(self._modify, '__name__', type(self._modify).__name__)}': {error}"
            raise ConfigError(message, key="modify_params", expected="the arguments of modify_fn") from None
        require_writable(env, self._parts)
        # A checkpoint already saves each manager term's settings, so a curriculum term saves only other settings.
        self._is_saved = bool(terms_of(env, self._parts))
        self._first = None if self._is_saved else copy.deepcopy(look_up(env, self._parts))
        self._has_written = self.number("_has_written", False)
        self._value: Any = self.number("_value", None)

    def parts_of(self, address: str) -> tuple[Part, ...]:
        """Split a setting's address, such as ``a.b[2].c``, into names and indices."""
        return parse(address)

    def __call__(self, env: Env, env_ids: torch.Tensor) -> float | None:
        present = look_up(env, self._parts)
        value = self._modify(env, env_ids, present, **self._params)
        if value is not _NO_CHANGE:
            # Copy the new value, because checkpoints cannot restore a list that is also in ``modify_params``.
            write(env, self._parts, value if value is present else copy.deepcopy(value))
            self._has_written = True
        present = look_up(env, self._parts)
        return float(present) if isinstance(present, (int, float)) else None

    def state_dict(self) -> dict[str, object]:
        saves = self._has_written and not self._is_saved
        self._value = copy.deepcopy(look_up(self._env, self._parts)) if saves else None
        return super().state_dict()

    def load_state_dict(self, saved: Mapping[str, object]) -> None:
        super().load_state_dict(saved)
        if not self._is_saved:
            write(self._env, self._parts, copy.deepcopy(self._value if self._has_written else self._first))


class modify_term_cfg(modify_env_param):
    """Call a function that changes a setting of a manager term; see ``modify_env_param``.

    The address starts with the section: ``rewards.alive.weight``, ``commands.base_velocity.ranges.lin_vel_x``,
    ``observations.policy.base_ang_vel.noise.n_max``; as in Isaac Lab, also ``rewards.alive.params.NAME``.
    """

    def parts_of(self, address: str) -> tuple[Part, ...]:
        section, *rest = parse(address)
        if section not in _MANAGERS:
            known, nearest = "one of " + ", ".join(_MANAGERS), nearest_name(str(section), _MANAGERS)
            message = f"'{section}' is not a section with terms"
            raise ConfigError(message, key="address", expected=known, nearest=nearest)
        return (_MANAGERS[str(section)], *rest)


_ROBOT = SceneEntityCfg("robot")


def terrain_levels_vel(
    env: Env, env_ids: torch.Tensor, asset_cfg: SceneEntityCfg = _ROBOT, command_name: str = "base_velocity"
) -> torch.Tensor:
    """Move robots to harder or easier terrain tiles by the distance covered in the episode; return the mean level.

    A robot moves up if its distance from the tile's centre exceeds half the tile's length along x, and down if it
    covered less than half of what its last command demands in a full episode. Without tiles, there is no effect.
    """
    terrain = env.scene.terrain
    if terrain.terrain_origins is None:
        return torch.zeros((), device=env.device)
    position = env.scene[asset_cfg.name].data.root_pos_w[env_ids, :2]
    distance = torch.linalg.vector_norm(position - env.scene.env_origins[env_ids, :2], dim=1)
    speed = torch.linalg.vector_norm(env.command_manager.get_command(command_name)[env_ids, :2], dim=1)
    up = distance > terrain.size[0] / 2
    down = (distance < 0.5 * speed * env.max_episode_length_s) & ~up
    terrain.update_env_origins(env_ids, up, down)
    return terrain.terrain_levels.float().mean()


def _ranges(env: Env, command_name: str) -> dict[str, list[float]]:
    """Return the ranges [low, high] of a command by axis; the result is empty if the command has no ranges."""
    ranges: dict[str, list[float]] = getattr(env.command_manager.get_term(command_name), "ranges", {})
    return ranges


_Limits = dict[str, tuple[float, float]]


def _range_errors(command_name: str, ranges: Mapping[str, Sequence[float]], limits: _Limits) -> Iterator[ConfigError]:
    """Yield an error for each axis whose command range is missing, or is not inside the range in ``limits``."""
    for axis, (lowest, highest) in limits.items():
        key, pair = f"limit_ranges.{axis}", ranges.get(axis)
        if pair is None:
            expected = "one of " + ", ".join(ranges) if ranges else "a command with such ranges"
            message, nearest = f"'{command_name}' has no range '{axis}'", nearest_name(axis, ranges)
            yield ConfigError(message, key=key, expected=expected, nearest=nearest)
        elif pair[0] < lowest or pair[1] > highest:
            first = f"{list(pair)} of '{command_name}'"
            yield ConfigError(f"{first} is beyond {[lowest, highest]}", key=key, expected=f"a range around {first}")


class command_range_levels(TermBase):
    """Widen the ranges of a command whenever the robots track the command well; return the upper bounds of the ranges.

    Once per full episode length, the mean tracking reward of the ended episodes is divided by that of perfect tracking
    over a full episode. If this ratio exceeds ``threshold``, each range in ``limit_ranges`` grows by ``step`` on both
    sides, up to its limit. Not in Isaac Lab; some projects call it ``lin_vel_cmd_levels``.

    Args:
        reward_term_name: the tracking reward, at most 1 before its weight.
        limit_ranges: final [low, high] of each axis; axes that are missing do not change.
        step: growth on each side, in the axis' unit.
        threshold: tracking ratio above which the command ranges grow.
    """

    def __init__(
        self,
        env: Env,
        reward_term_name: str,
        limit_ranges: Annotated[Mapping[str, Interval], NotEmpty()],
        command_name: str = "base_velocity",
        step: Positive = 0.1,
        threshold: Share = 0.8,
    ) -> None:
        self._reward, self._step, self._threshold = reward_term_name, step, threshold
        self._command = command_name
        self._limits = {axis: (float(low), float(high)) for axis, (low, high) in limit_ranges.items()}
        self._sum = self.buffer("_sum", torch.zeros((), device=env.device))
        self._count = self.number("_count", 0)
        self._looked_at = self.number("_looked_at", 0)
        env.reward_manager.episode_sums(reward_term_name)
        for error in _range_errors(command_name, _ranges(env, command_name), self._limits):
            raise error

    def __call__(self, env: Env, env_ids: torch.Tensor) -> dict[str, float]:
        self._sum += env.reward_manager.episode_sums(self._reward)[env_ids].sum()
        self._count += len(env_ids)
        ranges = _ranges(env, self._command)
        if env.common_step_counter - self._looked_at >= env.max_episode_length:
            perfect = float(env.reward_manager.get_term_cfg(self._reward).fields["weight"]) * env.max_episode_length_s
            if float(self._sum) > self._threshold * perfect * self._count:
                for axis, (lowest, highest) in self._limits.items():
                    low, high = ranges[axis]
                    ranges[axis] = [max(low - self._step, lowest), min(high + self._step, highest)]
            self._sum.zero_()
            self._count, self._looked_at = 0, env.common_step_counter
        return {axis: ranges[axis][1] for axis in self._limits}


lin_vel_cmd_levels = command_range_levels
ang_vel_cmd_levels = command_range_levels


_AXES = ("lin_vel_x", "lin_vel_y", "ang_vel_z")  # ``_AXES`` lists the components of a velocity command.


class command_levels_by_skill(TermBase):
    """Widen a velocity command's range on axes with good tracking; return each range's upper bound and tracking score.

    The skill of an axis is S = (score - still) / (1 - still): score is the mean of exp(-e²/std²) for the velocity error
    e, and still that of exp(-c²/std²) for the command c. So S is 0 for a robot that stands still, and 1 for perfect
    tracking. After a failure, the remaining steps of a full-length episode count with the score 0.

    Each axis is evaluated separately, over at least ``min_episodes`` episodes that started after the last growth of a
    range, without the steps in which its command is at most ``command_threshold``. A range grows by ``step`` on both
    sides after ``passes`` successive evaluations with a skill of at least ``threshold``. If a range below its limit
    does not grow in ``patience`` evaluations, training warns and logs ``<axis>_stuck`` = 1.

    Args:
        limit_ranges: final [low, high] of each axis; axes that are missing do not change.
        std: by axis, m/s or rad/s: error at which the score is 1/e.
        step: by axis, growth on each side, m/s or rad/s.
        command_name: the command: v_x, v_y, w_z.
        threshold: smallest skill that passes an evaluation.
        min_episodes: smallest number of episodes in an evaluation.
        passes: number of passed evaluations in a row before a range grows.
        patience: number of evaluations without growth after which an axis is stuck.
        command_threshold: m/s or rad/s; smaller commands do not count.
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
        ranges = {axis: pair for axis, pair in _ranges(env, command_name).items() if axis in _AXES}
        for error in _range_errors(command_name, ranges, self._limits):
            raise error
        for name, values in (("std", std), ("step", step)):
            for axis in (axis for axis in self._limits if axis not in values):
                message = f"{name} has no value for the axis '{axis}'"
                raise ConfigError(message, key=f"{name}.{axis}", expected="a number above 0")
        self._names = tuple(self._limits)
        self._columns = [_AXES.index(axis) for axis in self._names]
        self._variances = tuple(float(std[axis]) ** 2 for axis in self._names)
        self._steps = {axis: float(step[axis]) for axis in self._names}
        self._threshold, self._least, self._passes, self._patience = threshold, min_episodes, passes, patience
        self._moves_from = command_threshold
        shape = (3, len(self._names), env.num_envs)
        # ``_sums`` adds up three values per episode: tracking score, score of a robot at rest, and number of steps.
        self._sums = self.buffer("_sums", torch.zeros(shape, device=env.device))
        self._total = self.buffer("_total", torch.zeros(shape[:2], device=env.device))  # over ended episodes
        # ``_counts[i]`` is False if environment i's episode started before the last growth of a command range.
        self._counts = self.buffer("_counts", torch.ones(env.num_envs, dtype=torch.bool, device=env.device))
        self._ended = self.number("_ended", 0)
        self._streak = self.number("_streak", dict.fromkeys(self._names, 0))
        self._idle = self.number("_idle", dict.fromkeys(self._names, 0))
        self._skill = self.number("_skill", dict.fromkeys(self._names, 0.0))
        env.observers.append(self.observe)

    def observe(self) -> None:
        """Add the tracking scores of the present control step to the sums over the present episodes."""
        data = self._env.scene[self._asset].data
        command = self._env.command_manager.get_command(self._command)
        velocity = torch.cat((data.root_lin_vel_b[:, :2], data.root_ang_vel_b[:, 2:]), dim=1)
        for row, (column, variance) in enumerate(zip(self._columns, self._variances, strict=True)):
            wanted = command[:, column]
            moves = (wanted.abs() > self._moves_from).to(wanted.dtype)
            self._sums[0, row] += moves * torch.exp(-(wanted - velocity[:, column]).square() / variance)
            self._sums[1, row] += moves * torch.exp(-wanted.square() / variance)
            self._sums[2, row] += moves

    def __call__(self, env: Env, env_ids: torch.Tensor) -> dict[str, float]:
        length = env.episode_length_buf[env_ids]
        failed = env.termination_manager.terminated[env_ids] & (length > 0)
        rest = torch.where(failed, env.max_episode_length / length.clamp(min=1), 1.0).to(self._total.dtype)
        counted = self._counts[env_ids] & (length > 0)
        sums = self._sums[:, :, env_ids].to(self._total.dtype)
        sums[1:] *= rest  # The steps that a failed episode lacks count with a tracking score of 0.
        self._total += (sums * counted).sum(dim=2)
        self._sums[:, :, env_ids] = 0.0
        fill_rows(self._counts, env_ids, True)
        self._ended += int(counted.sum())
        if self._ended >= self._least:
            self._judge(env)
        ranges = _ranges(env, self._command)
        highs = {axis: float(ranges[axis][1]) for axis in self._names}
        skills = {f"{axis}_skill": self._skill[axis] for axis in self._names}
        stuck = {f"{axis}_stuck": float(self._idle[axis] >= self._patience) for axis in self._names}
        return highs | skills | stuck

    def _judge(self, env: Env) -> None:
        ranges, grown = _ranges(env, self._command), False
        for axis, total in zip(self._names, self._total.unbind(dim=1), strict=True):
            score, still, steps = map(float, total)
            if steps - still <= 0.0:  # If all commands on an axis were 0, its tracking skill would be 0 / 0.
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


class terrain_levels_by_distance(TermBase):
    """Move robots to harder or easier terrain tiles by the distance covered along the command; return tile levels.

    The covered distance is the time integral of the velocity along the command, in horizontal axes that turn with the
    robot. A robot moves up if it covered at least the share ``up`` of the commanded distance, which after a failure
    counts up to the full episode length, and down if it covered at most the share ``down``. If the commanded distance
    is below ``min_distance``, it moves only down, after a failure. From the hardest row, it moves up to a random row.
    Without tiles, there is no effect. Training warns and logs ``stuck`` = 1 if the mean level stays in the lower half
    and does not rise for ``patience`` full-length episodes.

    Args:
        command_name: the command, whose first two components are a planar velocity, m/s.
        up: smallest share of the commanded distance with which a robot moves up.
        down: largest share with which it moves down.
        min_distance: m, shortest commanded distance of an episode that counts.
        patience: full-length episodes without an increase of the mean level.
    """

    def __init__(
        self,
        env: Env,
        command_name: str = "base_velocity",
        up: Share = 0.7,
        down: Share = 0.35,
        min_distance: NonNegative = 0.2,
        patience: Count = 20,
        asset_cfg: SceneEntityCfg = _ROBOT,
    ) -> None:
        if down >= up:
            raise ConfigError(f"down is {down:g}", key="down", expected=f"less than up, {up:g}")
        env.command_manager.get_term(command_name)
        self._env, self._command, self._asset = env, command_name, asset_cfg.name
        self._up, self._down, self._least, self._patience = up, down, min_distance, patience
        self._commanded = self.buffer("_commanded", torch.zeros(env.num_envs, device=env.device))
        self._covered = self.buffer("_covered", torch.zeros(env.num_envs, device=env.device))
        self._best = self.number("_best", -1.0)
        self._best_at = self.number("_best_at", 0)
        env.observers.append(self.observe)

    def observe(self) -> None:
        """Add the commanded and the covered distance of this control step to the sums over the present episodes."""
        command = self._env.command_manager.get_command(self._command)[:, :2]
        speed = torch.linalg.vector_norm(command, dim=1)
        forwards, sideways = level_velocity(self._env.scene[self._asset].data)
        along = (command[:, 0] * forwards + command[:, 1] * sideways) / speed.clamp(min=1e-9)
        self._commanded += speed * self._env.step_dt
        self._covered += torch.where(speed > 0.0, along, 0.0) * self._env.step_dt

    def __call__(self, env: Env, env_ids: torch.Tensor) -> dict[str, float | torch.Tensor]:
        terrain = env.scene.terrain
        length = env.episode_length_buf[env_ids]
        lived = length > 0
        failed = env.termination_manager.terminated[env_ids] & lived
        rest = torch.where(failed, env.max_episode_length / length.clamp(min=1), 1.0)
        commanded, covered = self._commanded[env_ids] * rest, self._covered[env_ids]
        counts = commanded >= self._least
        up = lived & counts & (covered >= self._up * commanded)
        down = lived & torch.where(counts, covered <= self._down * commanded, failed)
        terrain.update_env_origins(env_ids, up, down)
        fill_rows(self._commanded, env_ids, 0.0)
        fill_rows(self._covered, env_ids, 0.0)
        if terrain.terrain_origins is None:
            return {}
        levels = terrain.terrain_levels.float()
        mean = float(levels.mean())
        if mean > self._best:
            self._best, self._best_at = mean, env.common_step_counter
        waited = env.common_step_counter - self._best_at > self._patience * env.max_episode_length
        low = mean < 0.5 * (terrain.max_terrain_level - 1)
        return {"mean": mean, "highest": levels.max(), "stuck": float(waited and low)}
