"""Compare two recordings: equal entities, the first difference, and its size."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wheelleg_exp.inspection.recorded_numbers import Statistics, statistics
from wheelleg_exp.recording.layout import SIM_TIME, STEP
from wheelleg_exp.recording.reading.number_groups import Number
from wheelleg_exp.recording.reading.recording_digest import entity_digests
from wheelleg_exp.recording.reading.recording_reader import Recording


@dataclass(frozen=True)
class Parting:
    """The first difference of a number.

    ``step`` is the control step; None if the values are equal and only the rows differ. ``time_s`` is the simulated
    time, s; None if unknown.
    """

    step: int | None
    time_s: float | None
    first: float | None
    second: float | None


@dataclass(frozen=True)
class NumberDifference:
    """A number that differs between two recordings.

    ``parting`` is its first difference among the common steps. ``largest`` is its largest absolute difference
    there.
    """

    name: str
    parting: Parting
    largest: float | None
    rows: tuple[int, int]
    first: Statistics
    second: Statistics


@dataclass(frozen=True)
class RecordingComparison:
    """The bitwise comparison of two recordings by entity.

    ``only_first`` and ``only_second`` are the paths of entities in only one recording. ``numbers`` are the numbers
    that differ, the earliest difference first.
    """

    equal: list[str]
    different: list[str]
    only_first: list[str]
    only_second: list[str]
    numbers: list[NumberDifference]

    @property
    def is_equal(self) -> bool:
        """Whether the recordings have the same content."""
        return not (self.different or self.only_first or self.only_second)

    def as_dict(self) -> dict[str, Any]:
        """Return the comparison as a plain mapping."""
        return {"is_equal": self.is_equal, **asdict(self)}


def compare(first: Recording, second: Recording) -> RecordingComparison:
    """Compare two recordings, without texts, properties, and wall-clock times.

    Raises:
        RunDirectoryError: rows are damaged or too large.
    """
    a, b = entity_digests(first.path), entity_digests(second.path)
    different = [entity for entity in a if entity in b and a[entity] != b[entity]]
    numbers = dict(_number_differences(first, second, set(different)))
    return RecordingComparison(
        equal=[entity for entity in a if entity in b and a[entity] == b[entity]],
        different=different,
        only_first=[entity for entity in a if entity not in b],
        only_second=[entity for entity in b if entity not in a],
        numbers=sorted(numbers.values(), key=_earliest),
    )


def _number_differences(
    first: Recording, second: Recording, entities: set[str]
) -> Iterator[tuple[tuple[str, str], NumberDifference]]:
    """Yield the numbers that differ by entity and name. A number without an environment occurs once."""
    for env_id in sorted({*first.env_ids} & {*second.env_ids}):
        mine, theirs = first.all_numbers(env_id), second.all_numbers(env_id)
        several = len(first.env_ids) > 1
        for name in mine.keys() & theirs.keys():
            if mine[name].entity in entities:
                shown = f"env_{env_id}.{name}" if several and mine[name].entity.startswith(f"env_{env_id}/") else name
                found = _difference(shown, (first, mine[name]), (second, theirs[name]))
                if found is not None:
                    yield (mine[name].entity, shown), found


def _difference(
    name: str, first: tuple[Recording, Number], second: tuple[Recording, Number]
) -> NumberDifference | None:
    (steps_a, a), (steps_b, b) = _series(*first), _series(*second)
    _, at_a, at_b = np.intersect1d(steps_a, steps_b, return_indices=True)
    both_a, both_b = a[at_a], b[at_b]
    # Compare bits, not values: NaN equals NaN, and -0.0 differs from 0.0.
    unlike = both_a.view(np.int64) != both_b.view(np.int64)
    if not unlike.any() and np.array_equal(steps_a, steps_b):
        return None
    row = int(np.argmax(unlike)) if unlike.any() else None
    sizes = np.abs(both_a - both_b)[unlike]
    finite = sizes[np.isfinite(sizes)]
    return NumberDifference(
        name=name,
        parting=_parting(first, steps_a, at_a, row, both_a, both_b),
        largest=float(finite.max()) if len(finite) else None,
        rows=(len(a), len(b)),
        first=statistics(a),
        second=statistics(b),
    )


def _parting(
    first: tuple[Recording, Number],
    steps: NDArray[np.int64],
    places: NDArray[np.intp],
    row: int | None,
    a: NDArray[np.float64],
    b: NDArray[np.float64],
) -> Parting:
    if row is None:
        return Parting(None, None, None, None)
    table = first[0].numbers(first[1].entity)
    place = int(places[row])
    time_s = table.column(SIM_TIME)[place].as_py() if SIM_TIME in table.column_names else None
    return Parting(int(steps[place]), time_s, float(a[row]), float(b[row]))


def _series(recording: Recording, number: Number) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return the steps and values of a number."""
    table = recording.rows(number.entity)
    values = np.ascontiguousarray(recording.values(number.entity)[:, number.index])
    steps = np.asarray(table.column(STEP)) if STEP in table.column_names else np.arange(len(values))
    return steps, values


def _earliest(found: NumberDifference) -> tuple[float, str]:
    step = found.parting.step
    return (float("inf") if step is None else step, found.name)
