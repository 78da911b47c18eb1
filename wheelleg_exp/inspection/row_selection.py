"""Select rows of a recording by environment, iteration, and time; parse durations such as ``0.5s`` or ``30steps``."""

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
_CLOSE = 1e-6  # Recorded times are rounded to microseconds.


@dataclass(frozen=True)
class Length:
    """A length of time in simulated seconds or in control steps."""

    value: float
    is_steps: bool

    def steps(self, step_dt: float | None) -> int:
        """Return a length of time as a rounded number of control steps, each of ``step_dt`` seconds."""
        if self.is_steps:
            return round(self.value)
        if not step_dt:
            message = "the duration of a control step is not in this recording"
            raise WheellegError(message, key=f"{self.value:g}s", expected="steps: 30steps")
        return round(self.value / step_dt)


def parse_length(text: str, key: str) -> Length:
    """Parse a length of time from text, in seconds if the text has no unit."""
    match = _WORDS.fullmatch(text)
    if match and match.group(2) in (*_SECONDS, *_STEPS) and math.isfinite(float(match.group(1))):
        value, unit = float(match.group(1)), match.group(2)
        return Length(value, True) if unit in _STEPS else Length(value * _SECONDS[unit], False)
    expected = "a number with s, ms or steps, such as 0.5s"
    raise WheellegError(f"'{text}' is not a valid duration", key=key, expected=expected)


@dataclass(frozen=True)
class Selection:
    """A selection of a recording's rows by environment, training iterations, and time, with inclusive bounds.

    An attribute that is None restricts nothing. Times up to half a control step outside ``begin`` and ``end`` (s) are
    also selected, because users enter rounded times.
    """

    env_id: int | None = None
    iterations: tuple[int, int] | None = None
    begin: Length | None = None
    end: Length | None = None

    @property
    def is_all(self) -> bool:
        return self == Selection()

    def env_ids(self, recording: Recording) -> list[int]:
        if self.env_id is None:
            return list(recording.env_ids)
        recording.branch(self.env_id)
        return [self.env_id]

    def apply(self, table: pa.Table) -> pa.Table:
        """Return the rows of ``table`` whose ``step``, ``sim_time`` (s), and ``iteration`` the selection includes."""
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
        """Return whether a row with the given control step, time, and training iteration is selected."""
        columns = {"row": [0], STEP: [step], SIM_TIME: [time_s], ITERATION: [iteration]}
        try:
            return len(self.apply(pa.table({name: values for name, values in columns.items() if values != [None]}))) > 0
        except WheellegError:  # A row without a time, for example, is not in a selection of times.
            return False


def nothing_chosen(recording: Recording) -> WheellegError:
    """Return the error for a selection without rows, which tells the user the recorded times and iterations."""
    words = {SIM_TIME: "times from {:.3f} to {:.3f} s", STEP: "steps {:.0f} to {:.0f}"}
    words[ITERATION] = "iterations {:.0f} to {:.0f}"
    spans = [text.format(*reach) for name, text in words.items() if (reach := recording.reach(name)) is not None]
    return WheellegError("no recorded row is selected", expected=", ".join(spans) or "a recording with rows")


def require_order(selection: Selection) -> None:
    """Raise WheellegError if the end of a selection is before its start."""
    begin, end = selection.begin, selection.end
    if begin is not None and end is not None and begin.is_steps == end.is_steps and begin.value > end.value:
        raise WheellegError("the end --to is before the start --from", key="--to", expected=f"{begin.value:g} or later")


def _half_step(table: pa.Table) -> float:
    if STEP not in table.column_names or not len(table):
        return _CLOSE
    ends = [tuple(float(table.column(name)[row].as_py()) for name in (STEP, SIM_TIME)) for row in (0, len(table) - 1)]
    lengths = [time_s / step if step > 0 else 0.0 for step, time_s in ends]
    # If control steps of another program differ in duration, the tolerance of selected times is only ``_CLOSE``.
    return max(0.5 * lengths[1], _CLOSE) if math.isclose(*lengths, rel_tol=1e-3) else _CLOSE


def parse_iterations(text: str) -> tuple[int, int]:
    """Parse training iterations such as ``50`` or ``50-60``, and return the first and the last iteration."""
    first, _, last = text.partition("-")
    if first.isdecimal() and (last.isdecimal() or text == first):
        if last and int(last) < int(first):
            message = f"the iteration range '{text}' ends before its start"
            raise WheellegError(message, key="--iteration", expected=f"{last}-{first}")
        return int(first), int(last or first)
    expected = "a number, or a range such as 50-60"
    raise WheellegError(f"'{text}' is not a training iteration or a range", key="--iteration", expected=expected)


def _timeline(table: pa.Table, name: str, key: str) -> np.ndarray:
    if name not in table.column_names:
        have = [column for column in (STEP, SIM_TIME, ITERATION) if column in table.column_names]
        raise WheellegError(f"the recording has no timeline '{name}'", key=key, expected="one of " + ", ".join(have))
    return np.asarray(table.column(name))
