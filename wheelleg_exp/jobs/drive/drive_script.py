"""Read a drive script, and write a finished drive as a script that repeats it.

A script is a YAML list of commands. Each entry starts at ``at`` (default: the end of the previous entry) and lasts
for ``for`` (default: 0), both in simulated seconds. An axis keeps its value until another entry names it.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from wheelleg_exp.errors import ConfigError, nearest_name
from wheelleg_exp.files import read_text
from wheelleg_exp.jobs.drive.drive_controls import Axis, Controls, Push, Request, Reset
from wheelleg_exp.plain_data import Unreadable, yaml_tree, yaml_value

_TIMES = ("at", "for")
_ACTIONS = ("push", "reset", "stop")
_NUMBER = "a number"


@dataclass(frozen=True)
class Entry:
    """The commands and requests at one moment.

    Attributes:
        at: simulated time from the start, s.
        values: commands by axis name.
        requests: actions that happen once.
        stops: whether every axis that ``values`` does not name goes to rest.
    """

    at: float
    values: Mapping[str, float]
    requests: Sequence[Request] = ()
    stops: bool = False


@dataclass(frozen=True)
class Script:
    """A drive.

    Attributes:
        entries: in order of time.
        duration_s: the end, s.
        text: the file.
    """

    entries: list[Entry]
    duration_s: float
    text: str = field(default="", repr=False)


class ScriptPlayer:
    """Sets the commands and requests of a script at the right control steps."""

    def __init__(self, script: Script, controls: Controls, step_dt: float) -> None:
        self._script, self._controls = script, controls
        # The first step at or after the moment. Rounding comes first, because 0.1 s / (1 / 60 s) must be step 6.
        self._steps = [math.ceil(round(entry.at / step_dt, 6)) for entry in script.entries]
        self.last_step = math.ceil(round(script.duration_s / step_dt, 6))
        self._next = 0

    def before(self, step: int) -> None:
        """Set what is due before a control step, counted from 0."""
        due = bisect_left(self._steps, step + 1)
        for entry in self._script.entries[self._next : due]:
            if entry.stops:
                self._controls.stop()
            for name, value in entry.values.items():
                self._controls.set(name, value)
            for request in entry.requests:
                self._controls.request(request)
        self._next = max(due, self._next)


def read_script(path: Path, axes: Sequence[Axis]) -> Script:
    """Read a script.

    Raises:
        ConfigError: the file is not a list of entries, or an entry has an unknown key or a value out of range; the
            error
            names the line.
        RunDirectoryError: the file cannot be read.
    """
    text = read_text(path)
    try:
        value, tree = yaml_value(text), yaml_tree(text)
    except Unreadable as error:
        line = "" if error.line is None else f":{error.line}"
        raise ConfigError(f"is not YAML: {error.problem}", key="--script", where=f"{path}{line}") from error
    if not isinstance(value, list) or not value or not isinstance(tree, yaml.SequenceNode):
        raise ConfigError("is not a list of commands", key="--script", where=str(path), expected=_example(axes))
    places = [_Place(path, node) for node in tree.value]
    entries: list[Entry] = []
    end = 0.0
    for index, (item, place) in enumerate(zip(value, places, strict=True)):
        if not isinstance(item, dict):
            raise ConfigError("is not a command", key=f"[{index}]", where=place.of(), expected=_example(axes))
        entry, end = _entry(item, place, {axis.name: axis for axis in axes}, entries[-1].at if entries else 0.0, end)
        entries.append(entry)
    if "for" not in value[-1]:
        raise ConfigError("does not give the end of the drive", where=places[-1].of(), key="for", expected="seconds")
    return Script(entries, end, text)


class _Place:
    """The lines of an entry's keys."""

    def __init__(self, path: Path, node: yaml.Node) -> None:
        self._path, self._line = path, node.start_mark.line + 1
        pairs = node.value if isinstance(node, yaml.MappingNode) else []
        self._lines = {key.value: key.start_mark.line + 1 for key, _ in pairs}

    def of(self, key: Any = None) -> str:
        return f"{self._path}:{self._lines.get(key, self._line)}"


def _entry(
    item: Mapping[Any, Any], place: _Place, axes: Mapping[str, Axis], before: float, end: float
) -> tuple[Entry, float]:
    """Return an entry and its end; ``before`` and ``end`` are start and end of the previous entry."""
    for key in item:
        if key not in (*_TIMES, *_ACTIONS, *axes):
            names = [*_TIMES, *axes, *_ACTIONS]
            raise ConfigError(
                "unknown key in a script",
                key=str(key),
                where=place.of(key),
                expected="one of " + ", ".join(names),
                nearest=nearest_name(str(key), names),
            )
    at = _seconds(item, "at", place, default=end)
    if at < before:
        raise ConfigError(
            f"{at:g} s is before the command above", key="at", where=place.of("at"), expected=f"at least {before:g}"
        )
    values = {name: _value(axes[name], item[name], place) for name in item if name in axes}
    return Entry(at, values, list(_requests(item, place)), _flag(item, "stop", place)), at + _seconds(
        item, "for", place, default=0.0
    )


def _seconds(item: Mapping[Any, Any], key: str, place: _Place, *, default: float) -> float:
    value = item.get(key, default)
    if not _is_number(value) or value < 0.0:
        raise ConfigError(f"{value!r} is not a time", key=key, where=place.of(key), expected="seconds, at least 0")
    return float(value)


def _value(axis: Axis, value: Any, place: _Place) -> float:
    expected = f"{_NUMBER} from {axis.low:g} to {axis.high:g} ({axis.key})"
    if not _is_number(value):
        raise ConfigError(f"{value!r} is not a number", key=axis.name, where=place.of(axis.name), expected=expected)
    if not axis.low <= value <= axis.high:
        raise ConfigError(
            f"{value:g} is outside the range of the training",
            key=axis.name,
            where=place.of(axis.name),
            expected=expected,
        )
    return float(value)


def _requests(item: Mapping[Any, Any], place: _Place) -> Iterator[Request]:
    if _flag(item, "reset", place):
        yield Reset()
    if "push" in item:
        push = item["push"]
        parts = push if isinstance(push, list) and len(push) == 2 else [push]
        if not all(map(_is_number, parts)):
            expected = "m/s forwards, or [forwards, to the left]"
            raise ConfigError(f"{push!r} is not a push", key="push", where=place.of("push"), expected=expected)
        yield Push(*map(float, parts))


def _flag(item: Mapping[Any, Any], key: str, place: _Place) -> bool:
    value = item.get(key, False)
    if not isinstance(value, bool):
        raise ConfigError(f"{value!r} is not true or false", key=key, where=place.of(key), expected="true")
    return value


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)


def _example(axes: Sequence[Axis]) -> str:
    shown = f"{axes[0].name}: {axes[0].high:g}" if axes else "push: 0.1"
    return f"entries such as '- {{at: 1.0, {shown}, for: 2.0}}'"


class DriveLog:
    """Records changes of commands and requests, by control step."""

    def __init__(self, step_dt: float) -> None:
        self._step_dt = step_dt
        self._entries: list[tuple[int, dict[str, Any]]] = []
        self._values: dict[str, float] = {}

    def commanded(self, step: int, values: Mapping[str, float]) -> None:
        """Record the commands of a step."""
        changed = {name: value for name, value in values.items() if self._values.get(name) != value}
        if changed:
            self._note(step, changed)
            self._values = dict(values)

    def asked(self, step: int, request: Reset | Push) -> None:
        """Record a request before a step."""
        self._note(step, {"push": [request.x, request.y]} if isinstance(request, Push) else {"reset": True})

    def script(self, steps: int) -> list[dict[str, Any]]:
        """Return the entries of a script with so many steps."""
        entries = [{"at": self._time(step), **deed} for step, deed in self._entries] or [{"at": 0.0}]
        last = self._entries[-1][0] if self._entries else 0
        entries[-1]["for"] = round(self._time(steps) - self._time(last), 6)
        return entries

    def _note(self, step: int, deed: dict[str, Any]) -> None:
        self._entries.append((step, deed))

    def _time(self, step: int) -> float:
        return round(step * self._step_dt, 6)
