"""Commands and requests of a drive: which axes can be commanded, what was requested, and the commands in effect."""

from __future__ import annotations

import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from wheelleg_exp.env import ManagerBasedRLEnv
from wheelleg_exp.sim.timers import forget


@dataclass(frozen=True)
class Axis:
    """One component of a command term, such as a speed, with the component's range [low, high] in its unit."""

    name: str  # ``name`` is lin_vel_x, for example, or <term>.lin_vel_x if two command terms have this component.
    term: str
    component: str
    low: float
    high: float

    @property
    def rest(self) -> float:
        """The command without user input: 0, or the middle of a command range that does not contain 0."""
        return 0.0 if self.low <= 0.0 <= self.high else 0.5 * (self.low + self.high)

    def at(self, share: float) -> float:
        """Map a user input to a command: -1 to the smallest, 0 to the neutral, and 1 to the largest command."""
        share = min(max(share, -1.0), 1.0)
        end = self.high if share > 0.0 else self.low
        return self.rest + abs(share) * (end - self.rest)

    def bounded(self, value: float) -> float:
        """Return ``value``, clamped to the command range from ``low`` to ``high``."""
        return min(max(value, self.low), self.high)


class CommandHold:
    """Keeps an environment's commands at given values with ranges such as [0.5, 0.5], also after it resamples them."""

    def __init__(self, env: ManagerBasedRLEnv, axes: list[Axis]) -> None:
        self._env, self._axes = env, axes
        self._held: dict[str, float] = {}

    def __call__(self, values: Mapping[str, float]) -> None:
        """Set the commands, given by the names of their axes; the next observation contains the new commands."""
        changed = [axis for axis in self._axes if self._held.get(axis.name) != values[axis.name]]
        for axis in changed:
            term = self._env.command_manager.get_term(axis.term)
            term.ranges[axis.component] = [values[axis.name]] * 2  # type: ignore[attr-defined]
            term.time_left.zero_()
        if changed:
            forget()
        self._held = dict(values)


@dataclass(frozen=True)
class Push:
    """A request to add a velocity (``x`` forwards, ``y`` to the left, yaw frame, m/s) to that of the robot's base."""

    x: float
    y: float = 0.0


@dataclass(frozen=True)
class Jump:
    """Start a jump, if the task has a command for jumps."""


@dataclass(frozen=True)
class Reset:
    """Start a new episode."""


@dataclass(frozen=True)
class Choose:
    """A request for another checkpoint or ground, or for another policy, which takes over the robot as it stands."""

    checkpoint: Path | None = None
    scene: str | None = None  # ``own`` (the training's ground), or a config name in Hydra's group ``scene``
    policy: str | None = None  # a run, such as ``stock:get_up``


@dataclass(frozen=True)
class Finish:
    """End the drive."""


RobotRequest = Push | Jump | Reset
Request = RobotRequest | Choose | Finish


class Controls:
    """The user's commands and pending requests; thread-safe. ``speed`` is simulated seconds per second of real time."""

    def __init__(self, axes: Sequence[Axis]) -> None:
        self.axes = {axis.name: axis for axis in axes}
        self.paused = False
        self.speed = 1.0
        self._lock = threading.Lock()
        self._values = {axis.name: axis.rest for axis in axes}
        self._requests: list[Request] = []

    @property
    def values(self) -> dict[str, float]:
        """The commands by axis name."""
        with self._lock:
            return dict(self._values)

    def set(self, name: str, value: float) -> None:
        """Set the command of an axis, clamped to the axis's range; an unknown axis name or a NaN has no effect."""
        if name in self.axes and value == value:
            with self._lock:
                self._values[name] = self.axes[name].bounded(value)

    def steer(self, name: str, share: float) -> None:
        """Set a command as a share of its range, as gamepad sticks and keys do: -1 (low), 0 (rest), or 1 (high)."""
        if name in self.axes:
            self.set(name, self.axes[name].at(share))

    def stop(self) -> None:
        """Set every axis to rest."""
        with self._lock:
            self._values = {name: axis.rest for name, axis in self.axes.items()}

    def request(self, request: Request) -> None:
        """Queue a request of the user; the simulation carries out this request before the next control step."""
        with self._lock:
            self._requests.append(request)

    def take(self) -> list[Request]:
        """Return the queued requests of the user, oldest first, and empty the queue."""
        with self._lock:
            taken, self._requests = self._requests, []
        return taken
