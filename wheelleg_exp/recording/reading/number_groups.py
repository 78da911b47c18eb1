"""The numbers of a recording by name, and groups of numbers as tables."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from wheelleg_exp.errors import RunDirectoryError
from wheelleg_exp.recording.layout import BRANCH, DOCUMENTS, GROUND, ITERATION, LOG, OVERLAY, SIM_TIME, STEP, WORLD
from wheelleg_exp.recording.reading.arrow_values import TIMELINES
from wheelleg_exp.recording.reading.entity_rows import SCALARS, EntityRows

_NOT_NUMBERS = (WORLD, OVERLAY, GROUND, DOCUMENTS, LOG)
_WIDEST, _MOST, _LETTERS = (
    1 << 16,
    1 << 20,
    1 << 26,
)  # limits: numbers of an entity, numbers of a recording, letters of group names
_PART = re.compile(r"(?:\\.|[^/\\])+", re.DOTALL)


@dataclass(frozen=True)
class Number:
    """One number of an entity.

    Attributes:
        name: the number's path below the requested group, with dots.
        entity: the number's entity.
        index: the number's index in the entity's row.
    """

    name: str
    entity: str
    index: int


class NumberNames:
    """The names of a recording's numbers.

    Args:
        rows: the recording's rows.
    """

    def __init__(self, rows: EntityRows) -> None:
        self._rows = rows
        numeric = (e for e in rows.entities() if rows.has_rows(e) and is_numeric(rows, e))
        self._entities = dict.fromkeys(numeric)
        self._by_branch: dict[str, dict[str, Number]] = {}

    @cached_property
    def groups(self) -> dict[str, list[str]]:
        """The entities below each path, in the order of the columns."""
        found: dict[str, list[str]] = {}
        room = _LETTERS
        for entity in self._entities:
            parts = parts_of(entity)
            room -= len(parts) * len(entity)
            if room < 0:
                raise self._too_many("groups")
            for depth in range(1, len(parts)):
                found.setdefault("/".join(parts[:depth]), []).append(entity)
        return {path: self._ordered(path, entities) for path, entities in found.items()}

    def numbers_of(self, path: str) -> list[Number]:
        """Return the numbers of an entity and of all entities below it."""
        own = [path] if path in self._entities else []
        depth = len(parts_of(path))
        found = (n for entity in (*own, *self.groups.get(path, ())) for n in self._numbers(entity, depth))
        return [_not_a_timeline(number) for number in self._within_bounds(found)]

    def all(self, branch: str) -> dict[str, Number]:
        """Return every number of one environment, and those that belong to no environment, by full names."""
        if branch not in self._by_branch:
            self._by_branch[branch] = {number.name: number for number in self._within_bounds(self._all(branch))}
        return self._by_branch[branch]

    def _all(self, branch: str) -> Iterator[Number]:
        depth = 1 if branch else 0
        for entity in self._entities:
            first = entity.split("/")[0]
            if first == branch:
                yield from self._numbers(entity, depth)
            elif not BRANCH.match(f"{entity}/"):
                yield from self._numbers(entity, 0)

    def _numbers(self, entity: str, depth: int) -> Iterator[Number]:
        below = [unescaped(part) for part in parts_of(entity)[depth:]]
        names = self._rows.number_names(entity)
        width = self._rows.width(entity)
        if width > _WIDEST:  # nobody reads so wide a vector by the name of each number
            return
        if width == 1 and below:
            yield Number(".".join(below), entity, 0)
            return
        for i in range(width):
            yield Number(_dotted(below, names[i] if i < len(names) else f"[{i}]"), entity, i)

    def _within_bounds(self, numbers: Iterator[Number]) -> Iterator[Number]:
        for count, number in enumerate(numbers):
            if count == _MOST:
                raise self._too_many("numbers")
            yield number

    def _too_many(self, what: str) -> RunDirectoryError:
        return RunDirectoryError(f"'{self._rows.path}' contains too many {what}", expected="a smaller recording")

    def _ordered(self, path: str, entities: list[str]) -> list[str]:
        """Return entities in the recorded order of their group's members, else sorted by name."""
        static = self._rows.static(path)
        order = {str(name): i for i, name in enumerate(static.get("terms") or static.get("names") or [])}
        depth = len(parts_of(path))
        return sorted(entities, key=lambda e: (order.get(unescaped(parts_of(e)[depth]), len(order)), e))


def _not_a_timeline(number: Number) -> Number:
    """Return a number that has no timeline's name: ``step`` of ``episode/step`` becomes ``episode.step``."""
    if number.name not in TIMELINES:
        return number
    name = ".".join(unescaped(part) for part in parts_of(number.entity)[-2:])
    return Number(name, number.entity, number.index)


def is_numeric(rows: EntityRows, entity: str) -> bool:
    """Return whether an entity's rows are numbers, not shapes, poses or texts."""
    return entity.split("/")[0] not in _NOT_NUMBERS and SCALARS in rows.columns(entity)


def parts_of(path: str) -> list[str]:
    """Return the parts of an entity path, with their escapes."""
    return _PART.findall(path)


def unescaped(part: str) -> str:
    """Return a part of an entity path without its escapes."""
    return re.sub(r"\\(.)", r"\1", part)


def _dotted(below: list[str], name: str) -> str:
    """Return a number's name below a group; ``term[3]`` of the entity ``term`` stays ``term[3]``."""
    if name.startswith("["):
        return ".".join(below) + name
    if below and name.startswith(f"{below[-1]}["):
        below = below[:-1]
    return ".".join([*below, name])


def table(rows: EntityRows, numbers: Sequence[Number]) -> pa.Table:
    """Return numbers as columns next to their timelines, sorted by step; NaN where a number has no row."""
    timeline = _timeline(rows, [n.entity for n in numbers])
    columns = {name: pa.array(column) for name, column in timeline.columns.items()}
    for number in numbers:
        values = rows.matrix(number.entity)[:, number.index]
        columns[_free(number.name, columns)] = pa.array(timeline.placed(number.entity, values))
    return pa.table(columns)


def matrix(rows: EntityRows, numbers: Sequence[Number]) -> NDArray[np.float64]:
    """Return numbers as (rows, width), sorted by step; NaN where a number has no row."""
    timeline = _timeline(rows, [n.entity for n in numbers])
    return np.stack([timeline.placed(n.entity, rows.matrix(n.entity)[:, n.index]) for n in numbers], axis=1)


@dataclass(frozen=True)
class _Timeline:
    """The union of the steps of several entities.

    Attributes:
        columns: ``step``, ``sim_time`` (s), ``iteration``, as far as they exist.
        rows: the indices of each entity's rows in the union; None for all rows.
    """

    columns: dict[str, NDArray]
    rows: dict[str, NDArray[np.int64] | None]

    def placed(self, entity: str, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return an entity's values at the rows of the union."""
        rows = self.rows[entity]
        if rows is None:
            return values
        found = np.full(len(next(iter(self.columns.values()))), np.nan)
        found[rows] = values
        return found


def _timeline(rows: EntityRows, entities: Sequence[str]) -> _Timeline:
    own = {entity: _times(rows, entity) for entity in dict.fromkeys(entities)}
    first = next(iter(own.values()))
    keys = {entity: times.get(STEP, np.arange(_length(times))) for entity, times in own.items()}
    same = next(iter(keys.values()))
    if all(np.array_equal(steps, same) for steps in keys.values()):
        return _Timeline(first or {STEP: same}, dict.fromkeys(own))
    steps = np.unique(np.concatenate(list(keys.values())))
    places = {entity: np.searchsorted(steps, key) for entity, key in keys.items()}
    columns: dict[str, NDArray] = {STEP: steps}
    for name in (SIM_TIME, ITERATION):
        if all(name in times for times in own.values()):
            columns[name] = np.empty(len(steps), dtype=first[name].dtype)
            for entity, times in own.items():
                columns[name][places[entity]] = times[name]
    return _Timeline(columns, dict(places))


def _times(rows: EntityRows, entity: str) -> dict[str, NDArray]:
    """Return an entity's timelines as numbers, without timelines that have gaps."""
    table, found = rows.rows(entity), {}
    for name in TIMELINES:
        if name in table.column_names and table.column(name).null_count == 0:
            values = np.asarray(table.column(name).cast("int64"))
            found[name] = values * 1e-9 if name == SIM_TIME else values
    return found or {STEP: np.arange(len(table))}


def _length(times: dict[str, NDArray]) -> int:
    return len(next(iter(times.values())))


def _free(name: str, taken: dict[str, pa.Array]) -> str:
    """Return a free name for a column."""
    return name if name not in taken else f"{name}_"
