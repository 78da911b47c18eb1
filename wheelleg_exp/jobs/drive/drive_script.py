"""Commands and requests of a drive; read a drive script, and write a finished drive as a drive script.

A command axis is one component of the robot's command, such as the forward speed, with a range of values.

A drive script is a YAML list of timed entries with commands and requests. Each entry starts at ``at`` (default: the end
of the previous entry) and lasts for ``for`` (default: 0), in simulated seconds. A command keeps its value until a later
entry changes it.
"""

from __future__ import annotations

import math
import threading
from bisect import bisect_left
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, TypeGuard, get_args

import yaml

from wheelleg_exp.env import ManagerBasedRLEnv
from wheelleg_exp.errors import ConfigError, nearest_name
from wheelleg_exp.files import read_text
from wheelleg_exp.plain_data import Unreadable, yaml_tree, yaml_value
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


Trigger = Literal["step", "bump"]
RobotRequest = Push | Jump | Reset
Request = RobotRequest | Choose | Finish


class Controls:
    """The user's commands and pending requests; thread-safe. ``speed`` is simulated seconds per second of real time.

    ``trigger`` is that of the jump command (``step`` or ``bump``); None if the robot cannot jump after a bump.
    """

    def __init__(self, axes: Sequence[Axis]) -> None:
        self.axes = {axis.name: axis for axis in axes}
        self.paused = False
        self.speed = 1.0
        self.trigger: Trigger | None = None
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


_TIMES = ("at", "for")
_ACTIONS = ("push", "jump", "trigger", "reset", "stop")


@dataclass(frozen=True)
class Entry:
    """One entry of a drive script: the commands and requests at the simulated time ``at``, s."""

    at: float  # simulated time, s
    values: Mapping[str, float]
    requests: Sequence[Request] = ()
    trigger: Trigger | None = None
    stops: bool = False  # With ``stops``, commands that the entry omits become 0, or the middle of a range without 0.


@dataclass(frozen=True)
class Script:
    """A drive script: its entries in order of time, and its duration."""

    entries: list[Entry]
    duration_s: float


class ScriptPlayer:
    """Applies each command and request of a drive script before the control step at which it is due."""

    def __init__(self, script: Script, controls: Controls, step_dt: float) -> None:
        self._script, self._controls = script, controls
        # A drive script's entry applies from the first control step at or after the entry's time.
        # Round ``at / step_dt``, so that a floating-point error does not delay a script entry by one control step.
        self._steps = [math.ceil(round(entry.at / step_dt, 6)) for entry in script.entries]
        self.last_step = math.ceil(round(script.duration_s / step_dt, 6))
        self._next = 0

    def before(self, step: int) -> None:
        """Apply the drive script's commands and requests that are due before a control step; steps count from 0."""
        due = bisect_left(self._steps, step + 1)
        for entry in self._script.entries[self._next : due]:
            if entry.stops:
                self._controls.stop()
            self._controls.trigger = entry.trigger or self._controls.trigger
            for name, value in entry.values.items():
                self._controls.set(name, value)
            for request in entry.requests:
                self._controls.request(request)
        self._next = max(due, self._next)


def read_script(path: Path, axes: Sequence[Axis], *, missing: Collection[str] = ()) -> Script:
    """Read a drive script; ConfigError names its wrong line. The actions ``missing`` are unknown keys."""
    names = [*_TIMES, *(axis.name for axis in axes), *(name for name in _ACTIONS if name not in missing)]
    text = read_text(path)
    try:
        value, tree = yaml_value(text), yaml_tree(text)
    except Unreadable as error:
        line = "" if error.line is None else f":{error.line}"
        raise ConfigError(f"the file is not YAML: {error.problem}", key="--script", where=f"{path}{line}") from error
    if not isinstance(value, list) or not value or not isinstance(tree, yaml.SequenceNode):
        message = "the script is not a list of commands"
        raise ConfigError(message, key="--script", where=str(path), expected=_example(axes))
    places = [_Place(path, node) for node in tree.value]
    entries: list[Entry] = []
    end = 0.0
    for index, (item, place) in enumerate(zip(value, places, strict=True)):
        if not isinstance(item, dict):
            message = "the script entry is not a command"
            raise ConfigError(message, key=f"[{index}]", where=place.of(), expected=_example(axes))
        for key in item:
            if key not in names:
                expected, nearest = "one of " + ", ".join(names), nearest_name(str(key), names)
                message, where = "unknown key in a script", place.of(key)
                raise ConfigError(message, key=str(key), where=where, expected=expected, nearest=nearest)
        at, before = _seconds(item, "at", place, default=end), entries[-1].at if entries else 0.0
        if at < before:
            message = f"{at:g} s is before the command above"
            raise ConfigError(message, key="at", where=place.of("at"), expected=f"at least {before:g}")
        values = {axis.name: _value(axis, item[axis.name], place) for axis in axes if axis.name in item}
        trigger = item.get("trigger")
        if trigger not in (None, *get_args(Trigger)):
            message, expected = f"unknown trigger {trigger!r}", " or ".join(get_args(Trigger))
            raise ConfigError(message, key="trigger", where=place.of("trigger"), expected=expected)
        entries.append(Entry(at, values, list(_requests(item, place)), trigger, _flag(item, "stop", place)))
        end = at + _seconds(item, "for", place, default=0.0)
    if "for" not in value[-1]:
        message = "the last entry does not give the end of the drive"
        raise ConfigError(message, where=places[-1].of(), key="for", expected="seconds")
    return Script(entries, end)


class _Place:
    def __init__(self, path: Path, node: yaml.Node) -> None:
        self._path, self._line = path, node.start_mark.line + 1
        pairs = node.value if isinstance(node, yaml.MappingNode) else []
        self._lines = {key.value: key.start_mark.line + 1 for key, _ in pairs}

    def of(self, key: str | int | None = None) -> str:
        return f"{self._path}:{self._lines.get(key, self._line)}"


def _seconds(item: Mapping[str, object], key: str, place: _Place, *, default: float) -> float:
    value = item.get(key, default)
    if not _is_number(value) or value < 0.0:
        raise ConfigError(f"invalid time in seconds: {value!r}", key=key, where=place.of(key), expected="at least 0")
    return float(value)


def _value(axis: Axis, value: object, place: _Place) -> float:
    expected = f"a number from {axis.low:g} to {axis.high:g} (env.commands.{axis.term}.ranges.{axis.component})"
    if not _is_number(value):
        raise ConfigError(f"{value!r} is not a number", key=axis.name, where=place.of(axis.name), expected=expected)
    if not axis.low <= value <= axis.high:
        message = f"{value:g} is outside the command range of the training"
        raise ConfigError(message, key=axis.name, where=place.of(axis.name), expected=expected)
    return float(value)


def _requests(item: Mapping[str, object], place: _Place) -> Iterator[Request]:
    if _flag(item, "reset", place):
        yield Reset()
    if _flag(item, "jump", place):
        yield Jump()
    if "push" in item:
        push = item["push"]
        parts = push if isinstance(push, list) and len(push) == 2 else [push]
        speeds = [part for part in parts if _is_number(part)]
        if len(speeds) != len(parts):
            expected = "m/s forwards, or [forwards, to the left]"
            raise ConfigError(f"{push!r} is not a speed in m/s", key="push", where=place.of("push"), expected=expected)
        yield Push(*map(float, speeds))


def _flag(item: Mapping[str, object], key: str, place: _Place) -> bool:
    value = item.get(key, False)
    if not isinstance(value, bool):
        raise ConfigError(f"the value {value!r} is not true or false", key=key, where=place.of(key), expected="true")
    return value


def _is_number(value: object) -> TypeGuard[float]:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)


def _example(axes: Sequence[Axis]) -> str:
    shown = f"{axes[0].name}: {axes[0].high:g}" if axes else "push: 0.1"
    return f"entries such as '- {{at: 1.0, {shown}, for: 2.0}}'"


class DriveLog:
    """Records each changed command and each user request with the control step at which it was applied."""

    def __init__(self, step_dt: float) -> None:
        self._step_dt = step_dt
        self._entries: list[tuple[int, dict[str, object]]] = []
        self._values: dict[str, object] = {}

    def commanded(self, step: int, values: Mapping[str, object]) -> None:
        """Record the commands and the trigger of jumps that apply in a control step."""
        changed = {name: value for name, value in values.items() if self._values.get(name) != value}
        if changed:
            self._entries.append((step, changed))
            self._values = dict(values)

    def asked(self, step: int, request: RobotRequest) -> None:
        """Record a request that the user made before a control step."""
        name = type(request).__name__.lower()
        self._entries.append((step, {name: [request.x, request.y] if isinstance(request, Push) else True}))

    def script(self, steps: int) -> list[dict[str, object]]:
        """Return the recorded commands, pushes, and resets of ``steps`` control steps as timed YAML entries."""
        entries = [{"at": self._time(step), **deed} for step, deed in self._entries] or [{"at": 0.0}]
        entries[-1]["for"] = round(self._time(steps) - self._time(self._entries[-1][0] if self._entries else 0), 6)
        return entries

    def _time(self, step: int) -> float:
        return round(step * self._step_dt, 6)
