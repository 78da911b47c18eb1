"""Harder ground for robots that get far, and wider commands for those that follow them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Annotated, Any

import torch

from wheelleg_exp.constraints import Interval, NotEmpty, Positive, Share
from wheelleg_exp.errors import ConfigError, nearest_name
from wheelleg_exp.managers import Env, SceneEntityCfg, TermBase

_ROBOT = SceneEntityCfg("robot")


def terrain_levels_vel(
    env: Env, env_ids: torch.Tensor, asset_cfg: SceneEntityCfg = _ROBOT, command_name: str = "base_velocity"
) -> torch.Tensor:
    """Send robots to harder or easier tiles by how far they got in the episode that ends; returns the mean level.

    Up goes who is further from the tile's middle than half its edge along x; down who has not come half as far as the
    last command would have taken it in a longest episode. On ground without tiles nothing moves.
    """
    terrain = env.scene.terrain
    position = env.scene[asset_cfg.name].data.root_pos_w[env_ids, :2]
    distance = torch.linalg.vector_norm(position - env.scene.env_origins[env_ids, :2], dim=1)
    speed = torch.linalg.vector_norm(env.command_manager.get_command(command_name)[env_ids, :2], dim=1)
    up = distance > terrain.size[0] / 2
    down = (distance < 0.5 * speed * env.max_episode_length_s) & ~up
    terrain.update_env_origins(env_ids, up, down)
    return terrain.terrain_levels.float().mean()


class command_range_levels(TermBase):
    """Widen the ranges of a command each time that it has been followed well; returns the highs.

    Over the episodes that end, the tracking reward's sum is held against what a perfect robot would earn in a longest
    episode, so that early falls count as well. Not more often than once in a longest episode the mean is looked at:
    above ``threshold`` every range grows by ``step`` to both sides, up to ``limit_ranges``. Not in Isaac Lab's
    library; others call it ``lin_vel_cmd_levels`` and ``ang_vel_cmd_levels``.

    Args:
        env: the environment.
        reward_term_name: the reward for following, at most 1 before its weight.
        limit_ranges: [low, high] that each axis grows to; other axes stay as they are.
        command_name: the command.
        step: growth to each side, in the axis' unit.
        threshold: share of the perfect reward.
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
        self._sum = torch.zeros((), device=env.device)
        self._count = 0
        self._looked_at = 0
        env.reward_manager.episode_sums(reward_term_name)
        for error in self._strangers(env):
            raise error

    def __call__(self, env: Env, env_ids: torch.Tensor) -> dict[str, float]:
        """Add the episodes that end, and widen the ranges when it is time."""
        self._sum += env.reward_manager.episode_sums(self._reward)[env_ids].sum()
        self._count += len(env_ids)
        ranges = self._ranges(env)
        if env.common_step_counter - self._looked_at >= env.max_episode_length:
            perfect = float(env.reward_manager.get_term_cfg(self._reward).fields["weight"]) * env.max_episode_length_s
            if float(self._sum) > self._threshold * perfect * self._count:
                for axis, (lowest, highest) in self._limits.items():
                    low, high = ranges[axis]
                    ranges[axis] = [max(low - self._step, lowest), min(high + self._step, highest)]
            self._sum.zero_()
            self._count, self._looked_at = 0, env.common_step_counter
        return {axis: ranges[axis][1] for axis in self._limits}

    def _ranges(self, env: Env) -> dict[str, Any]:
        ranges: dict[str, Any] = getattr(env.command_manager.get_term(self._command), "ranges", {})
        return ranges

    def _strangers(self, env: Env) -> Iterator[ConfigError]:
        """Yield the axes that the command has no range for, or one that does not lie within the limit."""
        ranges = self._ranges(env)
        for axis, (lowest, highest) in self._limits.items():
            key, pair = f"limit_ranges.{axis}", ranges.get(axis)
            if pair is None:
                known = ", ".join(ranges) or "nothing: the command has no ranges"
                yield ConfigError(
                    f"'{self._command}' has no range '{axis}'",
                    key=key,
                    expected=f"one of {known}",
                    nearest=nearest_name(axis, ranges),
                )
            elif pair[0] < lowest or pair[1] > highest:
                first = f"{list(pair)} of '{self._command}'"
                yield ConfigError(
                    f"{first} lies beyond {[lowest, highest]}", key=key, expected=f"a range around {first}"
                )


lin_vel_cmd_levels = command_range_levels
ang_vel_cmd_levels = command_range_levels
