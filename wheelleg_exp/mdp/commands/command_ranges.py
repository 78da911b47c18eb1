"""Base class of commands that draw each component from a range, and a command without components."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TypeVar

import torch

from wheelleg_exp.errors import ConfigError
from wheelleg_exp.managers import CommandTerm, Env, bounds
from wheelleg_exp.sim.class_members import alias_of

AxisT = TypeVar("AxisT", bound=str)
CommandT = TypeVar("CommandT", bound=CommandTerm)


def command_of(env: Env, name: str, kind: type[CommandT], skill: str, key: str = "command_name") -> CommandT:
    """Return the command term ``name``; raise ConfigError for one that is not a ``kind``, and thus lacks a skill."""
    term = env.command_manager.get_term(name)
    if not isinstance(term, kind):
        message = f"the command '{name}' does not {skill}"
        expected = f"a command of wheelleg_exp.mdp.commands.{kind.__name__}"
        raise ConfigError(message, key=key, expected=expected)
    return term


class _Ranges:
    """A command's ranges as attributes, because terms written for Isaac Lab read ``command.cfg.ranges.lin_vel_x``."""

    def __init__(self, ranges: dict[str, list[float]]) -> None:
        vars(self)["_ranges"] = ranges

    def __getattr__(self, axis: str) -> tuple[float, float] | None:
        ranges = vars(self)["_ranges"]
        return (ranges[axis][0], ranges[axis][1]) if axis in ranges else None

    def __setattr__(self, axis: str, value: Sequence[float]) -> None:
        vars(self)["_ranges"][axis] = [float(value[0]), float(value[1])]


@dataclass(frozen=True)
class CommandSettings:
    """A command's settings in the form of Isaac Lab's ``command.cfg``, for terms that were written for Isaac Lab.

    Attributes:
        ranges: [low, high] by axis as attributes; a new range applies from the next draw.
        limit_ranges: the widest ranges that a curriculum may set, like ``ranges``.
    """

    ranges: _Ranges
    resampling_time_range: tuple[float, float]
    limit_ranges: _Ranges


class RangedCommand(CommandTerm):
    """A command with one range [low, high] for each axis; a range that is set applies from the next draw."""

    ranges: dict[str, list[float]]
    limit_ranges: dict[str, list[float]] = {}  # noqa: RUF012

    @property
    def cfg(self) -> CommandSettings:
        """Settings of the command under their names in Isaac Lab; the attributes of ``cfg.ranges`` can be set."""
        return CommandSettings(_Ranges(self.ranges), self._time_range, _Ranges(self.limit_ranges))

    def take_ranges(self, ranges: Mapping[AxisT, Sequence[float] | None], axes: Sequence[AxisT]) -> None:
        """Store the ranges [low, high] of the command's axes; an axis without a range gets the value 0."""
        self._axes = tuple(axes)
        present = {str(axis): list(pair) for axis, pair in ranges.items() if pair is not None}
        self.ranges = self.setting("ranges", present)
        with torch.inference_mode(False):  # Tensors made in inference mode cannot be changed in place.
            self._bounds = self.number("_bounds", self._present(), saved=False)
        self._note()

    def bounds(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the lower and the upper bounds (k,) of all axes of the command, in the order of the axes."""
        self.read_settings()
        return self._bounds

    def read_settings(self) -> None:
        """Copy changed ranges into the stored tensors of bounds, whose memory CUDA graphs read."""
        if self.ranges != self._taken:
            for mine, present in zip(self._bounds, self._present(), strict=True):
                mine.copy_(present)
            self._note()

    def _present(self) -> tuple[torch.Tensor, torch.Tensor]:
        return bounds(self.ranges, self._axes, "ranges", self.time_left.device)

    def _note(self) -> None:
        taken = {axis: list(pair) for axis, pair in self.ranges.items()}
        self._taken = self.number("_taken", taken, saved=False)


class NullCommand(CommandTerm):
    """A command without components, for a config that must contain a command."""

    def __init__(self, env: Env, generator: torch.Generator) -> None:
        super().__init__(env, (1.0, 1.0), (), generator)
        self._nothing = torch.zeros(env.num_envs, 0, device=env.device)

    command = alias_of("_nothing", "The empty command, (N, 0).")

    def errors(self) -> torch.Tensor:
        return self.error_sums

    def draw(self, env_ids: torch.Tensor) -> None:
        pass

    def compute(self, dt: float) -> torch.Tensor:
        del dt
        return self.errors()

    def finish_episode(self, env_ids: torch.Tensor) -> dict[str, torch.Tensor]:
        del env_ids
        return {}
