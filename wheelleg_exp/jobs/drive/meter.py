"""Figures of a drive: how well commands were followed, how far it went, how often the robot fell."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch

from wheelleg_exp.env import ManagerBasedRLEnv
from wheelleg_exp.jobs.drive.axes import Axis
from wheelleg_exp.jobs.drive.controls import Push, Reset

# What an axis of a command is measured by, of the robot's data: the first row is the driven robot's.
_MEASURES: dict[str, Callable[[Any], torch.Tensor]] = {
    "lin_vel_x": lambda data: data.root_lin_vel_b[:, 0],
    "lin_vel_y": lambda data: data.root_lin_vel_b[:, 1],
    "ang_vel_z": lambda data: data.root_ang_vel_b[:, 2],
    "pitch": lambda data: torch.asin(data.projected_gravity_b[:, 0].clamp(-1.0, 1.0)),
    "roll": lambda data: torch.atan2(-data.projected_gravity_b[:, 1], -data.projected_gravity_b[:, 2]),
}


class DriveMeter:
    """Sums what a drive shows, step by step; see ``definitions.drive``.

    Args:
        env: the environment, of one robot.
        axes: what may be commanded.

    Attributes:
        height_m: height of the root link's origin above the ground below it, of the last step.
        measured: what the robot did in it, for the axes that are known: m/s, rad/s, m and rad, by name.
    """

    def __init__(self, env: ManagerBasedRLEnv, axes: Sequence[Axis]) -> None:
        self._env, self._axes = env, list(axes)
        self._steps, self._distance = 0, 0.0
        self._squares: defaultdict[str, float] = defaultdict(float)
        self._reward = self._height = 0.0
        self.height_m, self.measured = self._look()
        self._ended: Counter[str] = Counter()
        self._requests: Counter[str] = Counter()
        self._place: torch.Tensor | None = None

    @property
    def falls(self) -> int:
        """How many episodes have ended by themselves."""
        return sum(self._ended.values())

    def observe(self, commanded: Mapping[str, float]) -> None:
        """Take up a step that was done under commands."""
        place = self._env.scene.robot.data.root_pos_w[0, :2].clone()
        if self._place is not None:
            self._distance += float(torch.linalg.vector_norm(place - self._place))
        self._place = place
        self._steps += 1
        self._reward += float(self._env.reward_buf[0])
        self.height_m, self.measured = self._look()
        self._height += self.height_m
        for name, value in self.measured.items():
            self._squares[name] += (value - commanded[name]) ** 2

    def ended(self, by: str) -> None:
        """Note that an episode has ended, and by what."""
        self._ended[by] += 1

    def asked(self, request: Reset | Push) -> None:
        """Note a request that is done."""
        self._requests[type(request).__name__] += 1

    def began(self) -> None:
        """Note that the robot stands elsewhere: the way there was not driven."""
        self._place = None

    def figures(self) -> dict[str, Any]:
        """Return the figures as plain values."""
        count = max(self._steps, 1)
        return {
            "duration_s": self._steps * self._env.step_dt,
            "steps": self._steps,
            "distance_m": self._distance,
            "falls": dict(self._ended),
            "resets": self._requests[Reset.__name__],
            "pushes": self._requests[Push.__name__],
            "height_mean_m": self._height / count,
            "reward": self._reward,
            "tracking_rmse": {name: (total / count) ** 0.5 for name, total in self._squares.items()},
        }

    def _look(self) -> tuple[float, dict[str, float]]:
        """Return height and measures; once a step, because rays that ask for the ground touch the engine."""
        scene, measured = self._env.scene, {}
        position = scene.robot.data.root_pos_w
        height = float((position[:, 2] - scene.terrain.height_at(position[:, :2]))[0])
        for axis in self._axes:
            if axis.component == "height":
                measured[axis.name] = height
            elif axis.component in _MEASURES:
                measured[axis.name] = float(_MEASURES[axis.component](scene.robot.data)[0])
        return height, measured
