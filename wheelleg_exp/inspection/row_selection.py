"""Rows of a recording that a question uses, and lengths of time such as ``0.5s``, ``200ms``, ``30steps``."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass

import numpy as np
import pyarrow as pa

from wheelleg_exp.errors import WheellegError
from wheelleg_exp.recording.layout import ITERATION, SIM_TIME, STEP
from wheelleg_exp.recording.reading.recording_reader import Recording

_WORDS = re.compile(r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*([a-z]*)\s*")
_SECONDS = {"": 1.0, "s": 1.0, "ms": 1e-3}
_STEPS = ("step", "steps")


@dataclass(frozen=True)
class Length:
    """A length of simulated time, or a number of control steps.

    Attributes:
        value: seconds, or steps.
        is_steps: whether the value is in steps.
    """

    value: float
    is_steps: bool

    def steps(self, step_dt: float | None) -> int:
        """Return the nearest number of control steps of ``step_dt`` seconds.

        Raises:
            WheellegError: the value is in seconds, and the duration of a step is unknown.
        """
        if self.is_steps:
            return round(self.value)
        if not step_dt:
            raise WheellegError(
                "the duration of a control step is not in this recording",
                key=f"{self.value:g}s",
                expected="steps: 30steps",
            )
        return round(self.value / step_dt)


def parse_length(text: str, key: str) -> Length:
    """Return the length of a text; without a unit, in seconds.

    Raises:
        WheellegError: the text is not a length.
    """
    match = _WORDS.fullmatch(text)
    if match and match.group(2) in (*_SECONDS, *_STEPS) and math.isfinite(float(match.group(1))):
        value, unit = float(match.group(1)), match.group(2)
        return Length(value, True) if unit in _STEPS else Length(value * _SECONDS[unit], False)
    raise WheellegError(
        f"'{text}' is not a length of time", key=key, expected="a number with s, ms or steps, such as 0.5s"
    )


_CLOSE = 1e-6  # s: recorded times are whole microseconds


@dataclass(frozen=True)
class Selection:
    """A selection of rows. An attribute that is None does not restrict it.

    A time stands for the nearest control step, so that printed times can be typed.

    ``iterations`` is the first and last training iteration. ``begin`` and ``end`` are the first and last moment,
    both included.
    """

    env_id: int | None = None
    iterations: tuple[int, int] | None = None
    begin: Length | None = None
    end: Length | None = None

    @property
    def is_all(self) -> bool:
        """Whether every row is selected."""
        return self == Selection()

    def env_ids(self, recording: Recording) -> list[int]:
        """Return the selected environments.

        Raises:
            RunDirectoryError: the selected one was not recorded.
        """
        if self.env_id is None:
            return list(recording.env_ids)
        recording.branch(self.env_id)
        return [self.env_id]

    def apply(self, table: pa.Table) -> pa.Table:
        """Return the selected rows of a table with the timelines ``step``, ``sim_time`` (s) and ``iteration``.

        Raises:
            WheellegError: the table lacks a timeline.
        """
        mask = np.ones(len(table), dtype=bool)
        if self.iterations is not None:
            values = _timeline(table, ITERATION, "--iteration")
            mask &= (values >= self.iterations[0]) & (values <= self.iterations[1])
        for bound, key in ((self.begin, "--from"), (self.end, "--to")):
            if bound is not None:
                values = _timeline(table, STEP if bound.is_steps else SIM_TIME, key)
                room = 0.0 if bound.is_steps else _half_step(table)
                mask &= values >= bound.value - room if key == "--from" else values <= bound.value + room
        return table if mask.all() else table.filter(pa.array(mask))

    def has(self, step: int | None, time_s: float | None, iteration: int | None) -> bool:
        """Return whether a moment is selected; an unknown moment is not."""
        if self.iterations is not None:
            first, last = self.iterations
            if iteration is None or not first <= iteration <= last:
                return False
        lower = [(bound, +1) for bound in (self.begin,) if bound is not None]
        for bound, sign in [*lower, *((bound, -1) for bound in (self.end,) if bound is not None)]:
            value = step if bound.is_steps else time_s
            room = 0.0 if bound.is_steps or not step or time_s is None else max(0.5 * time_s / step, _CLOSE)
            if value is None or sign * (value - bound.value) < -room:
                return False
        return True


def nothing_chosen(recording: Recording) -> WheellegError:
    """Return the error for a selection without rows. It names the recorded range."""
    spans = []
    for name, words in ((SIM_TIME, "times from {:.3f} to {:.3f} s"), (STEP, "steps {:.0f} to {:.0f}")):
        reach = recording.reach(name)
        spans += [words.format(*reach)] if reach is not None else []
    reach = recording.reach(ITERATION)
    spans += [f"iterations {reach[0]:.0f} to {reach[1]:.0f}"] if reach is not None else []
    return WheellegError("no recorded row is selected", expected=", ".join(spans) or "a recording with rows")


def require_order(selection: Selection) -> None:
    """Raise WheellegError if a selection ends before its start."""
    begin, end = selection.begin, selection.end
    if begin is not None and end is not None and begin.is_steps == end.is_steps and begin.value > end.value:
        raise WheellegError("the end is before --from", key="--to", expected=f"{begin.value:g} or later")


def _half_step(table: pa.Table) -> float:
    """Return half the duration of a control step, s, if all steps of the table have the same duration."""
    if STEP not in table.column_names or not len(table):
        return _CLOSE
    ends = [tuple(float(table.column(name)[row].as_py()) for name in (STEP, SIM_TIME)) for row in (0, len(table) - 1)]
    lengths = [time_s / step if step > 0 else 0.0 for step, time_s in ends]
    is_regular = math.isclose(*lengths, rel_tol=1e-3)  # steps of another tool's recording can be irregular
    return max(0.5 * lengths[1], _CLOSE) if is_regular else _CLOSE


def parse_iterations(text: str) -> tuple[int, int]:
    """Return the first and last iteration of a text such as ``50`` or ``50-60``.

    Raises:
        WheellegError: the text is neither.
    """
    first, _, last = text.partition("-")
    if first.isdecimal() and (last.isdecimal() or text == first):
        if last and int(last) < int(first):
            raise WheellegError(f"'{text}' ends before its start", key="--iteration", expected=f"{last}-{first}")
        return int(first), int(last or first)
    expected = "a number, or a range such as 50-60"
    raise WheellegError(f"'{text}' is not an iteration", key="--iteration", expected=expected)


def _timeline(table: pa.Table, name: str, key: str) -> np.ndarray:
    if name not in table.column_names:
        have = [column for column in (STEP, SIM_TIME, ITERATION) if column in table.column_names]
        raise WheellegError(f"the numbers have no timeline '{name}'", key=key, expected="one of " + ", ".join(have))
    return np.asarray(table.column(name))
