"""Find recorded numbers by name, and read groups of recorded numbers as tables."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from wheelleg_exp.errors import RunDirectoryError
from wheelleg_exp.recording import layout
from wheelleg_exp.recording.layout import BRANCH, ITERATION, SIM_TIME, STEP, unescaped
from wheelleg_exp.recording.reading.arrow_values import TIMELINES
from wheelleg_exp.recording.reading.entity_rows import SCALARS, EntityRows

_NOT_NUMBERS = (layout.WORLD, layout.OVERLAY, layout.GROUND, layout.DOCUMENTS, layout.LOG)
# A damaged recording can contain huge tables, so limit the number of columns and the length of column names.
_WIDEST, _MOST, _LETTERS = 1 << 16, 1 << 20, 1 << 26
Column = NDArray[np.int64] | NDArray[np.float64]
_PART = re.compile(r"(?:\\.|[^/\\])+", re.DOTALL)


@dataclass(frozen=True)
class Number:
    """One number of an entity: its dotted name below the requested group, and its index in the entity's row."""

    name: str
    entity: str
    index: int


class NumberNames:
    """Gives access to the names of all recorded numbers of a recording."""

    def __init__(self, rows: EntityRows) -> None:
        self._rows = rows
        self._entities = dict.fromkeys(e for e in rows.entities() if rows.has_rows(e) and is_numeric(rows, e))
        self._by_branch: dict[str, dict[str, Number]] = {}

    @cached_property
    def groups(self) -> dict[str, list[str]]:
        """Maps each path, such as ``joints``, to the Rerun entities with numbers below this path, in column order."""
        found: dict[str, list[str]] = {}
        room = _LETTERS
        for entity in self._entities:
            parts = parts_of(entity)
            room -= len(parts) * len(entity)
            if room < 0:
                raise self._too_many("groups")
            for depth in range(1, len(parts)):
                found.setdefault("/".join(parts[:depth]), []).append(entity)
        for path, entities in found.items():
            static, depth = self._rows.static(path), len(parts_of(path))
            order = {str(name): i for i, name in enumerate(static.get("terms") or static.get("names") or [])}
            names = {entity: unescaped(parts_of(entity)[depth]) for entity in entities}
            found[path] = sorted(entities, key=lambda e: (order.get(names[e], len(order)), e))
        return found

    def numbers_of(self, path: str) -> list[Number]:
        """Return the numbers of a Rerun entity and of all entities below it."""
        own = [path] if path in self._entities else []
        depth = len(parts_of(path))
        numbers = (n for entity in (*own, *self.groups.get(path, ())) for n in self._numbers(entity, depth))
        found = []
        for number in self._within_bounds(numbers):
            # The number `episode/step` would get the name of the timeline `step`, so name it `episode.step`.
            if number.name in TIMELINES:
                name = ".".join(unescaped(part) for part in parts_of(number.entity)[-2:])
                number = Number(name, number.entity, number.index)
            found.append(number)
        return found

    def all(self, branch: str) -> dict[str, Number]:
        """Return the numbers of an environment, and numbers that all environments share (training scalars), by name."""
        if branch not in self._by_branch:
            depths = {e: int(bool(branch) and e.split("/")[0] == branch) for e in self._entities}
            shared = [e for e, depth in depths.items() if depth or not BRANCH.match(f"{e}/")]
            numbers = self._within_bounds(n for e in shared for n in self._numbers(e, depths[e]))
            self._by_branch[branch] = {number.name: number for number in numbers}
        return self._by_branch[branch]

    def _numbers(self, entity: str, depth: int) -> Iterator[Number]:
        below = [unescaped(part) for part in parts_of(entity)[depth:]]
        names, width = self._rows.number_names(entity), self._rows.width(entity)
        if width == 1 and below:
            yield Number(".".join(below), entity, 0)
        elif width <= _WIDEST:
            for i in range(width):
                name = names[i] if i < len(names) else f"[{i}]"
                if name.startswith("["):
                    dotted = ".".join(below) + name
                else:
                    repeats = below and name.startswith(f"{below[-1]}[")
                    dotted = ".".join([*(below[:-1] if repeats else below), name])
                yield Number(dotted, entity, i)

    def _within_bounds(self, numbers: Iterable[Number]) -> Iterator[Number]:
        for count, number in enumerate(numbers):
            if count == _MOST:
                raise self._too_many("numbers")
            yield number

    def _too_many(self, what: str) -> RunDirectoryError:
        return RunDirectoryError(f"'{self._rows.path}' contains too many {what}", expected="a smaller recording")


def is_numeric(rows: EntityRows, entity: str) -> bool:
    """Return whether a Rerun entity contains recorded numbers, and not shapes, poses, or texts."""
    return entity.split("/")[0] not in _NOT_NUMBERS and SCALARS in rows.columns(entity)


def parts_of(path: str) -> list[str]:
    """Return the names in a Rerun entity path, without removing their escape characters."""
    return _PART.findall(path)


def table(rows: EntityRows, numbers: Sequence[Number]) -> pa.Table:
    """Return a table of timelines and recorded numbers, sorted by control step, in which a missing number is NaN."""
    times, places = _timelines({entity: _times(rows, entity) for entity in dict.fromkeys(n.entity for n in numbers)})
    columns = {name: pa.array(column) for name, column in times.items()}
    for number in numbers:
        name = number.name if number.name not in columns else f"{number.name}_"
        values = rows.matrix(number.entity)[:, number.index]
        if number.entity in places:
            found = np.full(len(times[STEP]), np.nan)
            found[places[number.entity]] = values
            values = found
        columns[name] = pa.array(values)
    return pa.table(columns)


def _timelines(own: dict[str, dict[str, Column]]) -> tuple[dict[str, Column], dict[str, NDArray[np.int64]]]:
    """Return the timelines of all control steps at which any entity was recorded, and each entity's rows in them.

    If the entities were recorded at the same control steps, the second mapping is empty.
    """
    first = next(iter(own.values()))
    keys = {entity: times.get(STEP, np.arange(len(next(iter(times.values()))))) for entity, times in own.items()}
    same = next(iter(keys.values()))
    if all(np.array_equal(steps, same) for steps in keys.values()):
        return first, {}
    steps = np.unique(np.concatenate(list(keys.values())))
    places = {entity: np.searchsorted(steps, key) for entity, key in keys.items()}
    columns: dict[str, Column] = {STEP: steps}
    for name in (SIM_TIME, ITERATION):
        if all(name in times for times in own.values()):
            columns[name] = np.empty_like(first[name], shape=len(steps))
            for entity, times in own.items():
                columns[name][places[entity]] = times[name]
    return columns, places


def _times(rows: EntityRows, entity: str) -> dict[str, Column]:
    table, found = rows.rows(entity), dict[str, Column]()
    for name in TIMELINES:
        if name in table.column_names and table.column(name).null_count == 0:
            values = np.asarray(table.column(name).cast("int64"))
            found[name] = values * 1e-9 if name == SIM_TIME else values
    return found or {STEP: np.arange(len(table))}
