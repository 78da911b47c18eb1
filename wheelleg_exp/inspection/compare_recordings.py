"""Compare two Rerun recordings: find equal entities, and the first and the largest difference of each number."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import NDArray

from wheelleg_exp.inspection.recorded_numbers import Statistics, statistics
from wheelleg_exp.recording.layout import SIM_TIME, STEP
from wheelleg_exp.recording.reading.recording_digest import entity_digests
from wheelleg_exp.recording.reading.recording_reader import Number, Recording


@dataclass(frozen=True)
class Parting:
    """The first control step at which a number differs, with its time (s) and both values; None without one."""

    step: int | None
    time_s: float | None
    first: float | None
    second: float | None


@dataclass(frozen=True)
class NumberDifference:
    """A recorded number that differs, where it first differs, and the largest difference at equal control steps."""

    name: str
    parting: Parting
    largest: float | None
    rows: tuple[int, int]
    first: Statistics
    second: Statistics


@dataclass(frozen=True)
class RecordingComparison:
    """A bitwise comparison of two recordings: their entities, and the numbers that differ, the earliest first."""

    equal: list[str]
    different: list[str]
    only_first: list[str]
    only_second: list[str]
    numbers: list[NumberDifference]

    @property
    def is_equal(self) -> bool:
        """Whether both recordings contain the same entities with bitwise equal rows."""
        return not (self.different or self.only_first or self.only_second)

    def as_dict(self) -> dict[str, object]:
        return {"is_equal": self.is_equal, **asdict(self)}


def compare(first: Recording, second: Recording) -> RecordingComparison:
    """Compare two Rerun recordings bit by bit, except for texts, properties, and wall-clock times."""
    a, b = entity_digests(first.path), entity_digests(second.path)
    different = [entity for entity in a if entity in b and a[entity] != b[entity]]
    numbers: dict[tuple[str, str], NumberDifference] = {}
    for env_id in sorted({*first.env_ids} & {*second.env_ids}):
        mine, theirs = first.all_numbers(env_id), second.all_numbers(env_id)
        for name in mine.keys() & theirs.keys():
            entity = mine[name].entity
            if entity in different:
                of_env = len(first.env_ids) > 1 and entity.startswith(f"env_{env_id}/")
                shown = f"env_{env_id}.{name}" if of_env else name
                found = _difference(shown, (first, mine[name]), (second, theirs[name]))
                if found is not None:
                    numbers[entity, shown] = found
    ordered = sorted(numbers.values(), key=lambda n: (math.inf if n.parting.step is None else n.parting.step, n.name))
    equal = [entity for entity in a if entity in b and a[entity] == b[entity]]
    return RecordingComparison(equal, different, [e for e in a if e not in b], [e for e in b if e not in a], ordered)


def _difference(
    name: str, first: tuple[Recording, Number], second: tuple[Recording, Number]
) -> NumberDifference | None:
    (steps_a, a), (steps_b, b) = _series(*first), _series(*second)
    _, at_a, at_b = np.intersect1d(steps_a, steps_b, return_indices=True)
    both_a, both_b = a[at_a], b[at_b]
    # Compare the bits of the recordings' floats, so that NaN equals NaN, and -0.0 differs from 0.0.
    unlike = both_a.view(np.int64) != both_b.view(np.int64)
    if not unlike.any() and np.array_equal(steps_a, steps_b):
        return None
    parting = Parting(None, None, None, None)
    if unlike.any():
        row = int(np.argmax(unlike))
        place, table = int(at_a[row]), first[0].numbers(first[1].entity)
        time_s = table.column(SIM_TIME)[place].as_py() if SIM_TIME in table.column_names else None
        parting = Parting(int(steps_a[place]), time_s, float(both_a[row]), float(both_b[row]))
    sizes = np.abs(both_a - both_b)[unlike]
    finite = sizes[np.isfinite(sizes)]
    largest = float(finite.max()) if len(finite) else None
    return NumberDifference(name, parting, largest, (len(a), len(b)), statistics(a), statistics(b))


def _series(recording: Recording, number: Number) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    table = recording.rows(number.entity)
    values = np.ascontiguousarray(recording.values(number.entity)[:, number.index])
    steps = np.asarray(table.column(STEP)) if STEP in table.column_names else np.arange(len(values))
    return steps, values
