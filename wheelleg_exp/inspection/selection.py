"""Which rows of a recording are looked at."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pyarrow as pa

from wheelleg_exp.errors import WheellegError
from wheelleg_exp.inspection.spans import Length
from wheelleg_exp.recording.layout import ITERATION, SIM_TIME, STEP
from wheelleg_exp.recording.reader import Recording

_CLOSE = 1e-7  # far below a step: times are written in whole nanoseconds


@dataclass(frozen=True)
class Selection:
    """A choice of rows; what is None chooses nothing.

    Attributes:
        env_id: the recorded environment.
        iterations: the first and last training iteration.
        begin, end: from when to when, both included.
    """

    env_id: int | None = None
    iterations: tuple[int, int] | None = None
    begin: Length | None = None
    end: Length | None = None

    @property
    def is_all(self) -> bool:
        """Whether every row is chosen."""
        return self == Selection()

    def env_ids(self, recording: Recording) -> list[int]:
        """Return the chosen environments.

        Raises:
            RunDirectoryError: the chosen one was not recorded.
        """
        if self.env_id is None:
            return list(recording.env_ids)
        recording.branch(self.env_id)
        return [self.env_id]

    def apply(self, table: pa.Table) -> pa.Table:
        """Return the chosen rows of a table with the timelines ``step``, ``sim_time`` (s) and ``iteration``.

        Raises:
            WheellegError: the table has no such timeline.
        """
        mask = np.ones(len(table), dtype=bool)
        if self.iterations is not None:
            values = _timeline(table, ITERATION, "--iteration")
            mask &= (values >= self.iterations[0]) & (values <= self.iterations[1])
        for bound, key in ((self.begin, "--from"), (self.end, "--to")):
            if bound is not None:
                values = _timeline(table, STEP if bound.is_steps else SIM_TIME, key)
                mask &= values >= bound.value - _CLOSE if key == "--from" else values <= bound.value + _CLOSE
        return table if mask.all() else table.filter(pa.array(mask))

    def has(self, step: int | None, time_s: float | None, iteration: int | None) -> bool:
        """Return whether a moment is chosen; one that is not known is not."""
        if self.iterations is not None and not (iteration is not None and _within(iteration, *self.iterations)):
            return False
        lower = [(bound, +1) for bound in (self.begin,) if bound is not None]
        for bound, sign in [*lower, *((bound, -1) for bound in (self.end,) if bound is not None)]:
            value = step if bound.is_steps else time_s
            if value is None or sign * (value - bound.value) < -_CLOSE:
                return False
        return True


def _within(value: float, first: float, last: float) -> bool:
    return first <= value <= last


def parse_iterations(text: str) -> tuple[int, int]:
    """Return the first and last iteration that a text says: ``50``, or ``50-60``.

    Raises:
        WheellegError: it says none.
    """
    first, _, last = text.partition("-")
    if first.isdecimal() and (last.isdecimal() or text == first):
        return int(first), int(last or first)
    raise WheellegError(f"'{text}' is no iteration", key="--iteration", expected="a number, or a range such as 50-60")


def _timeline(table: pa.Table, name: str, key: str) -> np.ndarray:
    if name not in table.column_names:
        have = [column for column in (STEP, SIM_TIME, ITERATION) if column in table.column_names]
        raise WheellegError(f"there is no timeline '{name}' here", key=key, expected="one of " + ", ".join(have))
    return np.asarray(table.column(name))
