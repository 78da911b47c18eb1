"""The numbers of a recording by name, and groups of them as tables."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from wheelleg_exp.recording.layout import DOCUMENTS, GROUND, ITERATION, OVERLAY, SIM_TIME, STEP, WORLD

if TYPE_CHECKING:
    from wheelleg_exp.recording.reader import Recording

_NOT_NUMBERS = (WORLD, OVERLAY, GROUND, DOCUMENTS, "log")
_TIMES = (STEP, SIM_TIME, ITERATION)
_PART = re.compile(r"(?:\\.|[^/\\])+", re.DOTALL)


@dataclass(frozen=True)
class Number:
    """One number of an entity.

    Attributes:
        name: its path below what it was asked for by, with dots.
        entity: where it stands.
        index: its place in the entity's row.
    """

    name: str
    entity: str
    index: int


class Names:
    """What numbers there are.

    Args:
        recording: the recording.
    """

    def __init__(self, recording: Recording) -> None:
        self._recording = recording
        self._entities = [e for e in recording.entities() if recording.has_rows(e) and is_numeric(recording, e)]

    @cached_property
    def groups(self) -> dict[str, list[str]]:
        """The entities below each path, in the order in which they are read."""
        found: dict[str, list[str]] = {}
        for entity in self._entities:
            parts = parts_of(entity)
            for depth in range(1, len(parts)):
                found.setdefault("/".join(parts[:depth]), []).append(entity)
        return {path: self._ordered(path, entities) for path, entities in found.items()}

    def numbers_of(self, path: str) -> list[Number]:
        """Return the numbers of an entity and of all below it."""
        own = [path] if path in self._entities else []
        depth = len(parts_of(path))
        found = [n for entity in (*own, *self.groups.get(path, ())) for n in self._numbers(entity, depth)]
        return [_told_apart(number) for number in found]

    def all(self, branch: str) -> Iterator[Number]:
        """Yield every number of one environment, and those of none, by names that begin at the top."""
        depth = 1 if branch else 0
        for entity in self._entities:
            first = entity.split("/")[0]
            if first == branch:
                yield from self._numbers(entity, depth)
            elif not re.fullmatch(r"env_\d+", first):
                yield from self._numbers(entity, 0)

    def _numbers(self, entity: str, depth: int) -> Iterator[Number]:
        below = [plain(part) for part in parts_of(entity)[depth:]]
        names = self._recording.names(entity)
        width = width_of(self._recording, entity)
        if width == 1 and below:
            yield Number(".".join(below), entity, 0)
            return
        for i in range(width):
            yield Number(_dotted(below, names[i] if i < len(names) else f"[{i}]"), entity, i)

    def _ordered(self, path: str, entities: list[str]) -> list[str]:
        """Return entities in the order that the recording gives for the members of their group, else by name."""
        static = self._recording.static(path)
        order = {str(name): i for i, name in enumerate(static.get("terms") or static.get("names") or [])}
        depth = len(parts_of(path))
        return sorted(entities, key=lambda e: (order.get(plain(parts_of(e)[depth]), len(order)), e))


def _told_apart(number: Number) -> Number:
    """Return a number whose name is not that of a timeline: ``episode/step`` becomes ``episode.step``."""
    if number.name not in _TIMES:
        return number
    name = ".".join(plain(part) for part in parts_of(number.entity)[-2:])
    return Number(name, number.entity, number.index)


def is_numeric(recording: Recording, entity: str) -> bool:
    """Return whether an entity's rows are numbers (and not shapes, poses or words)."""
    return entity.split("/")[0] not in _NOT_NUMBERS and "scalars" in recording.columns(entity)


def width_of(recording: Recording, entity: str) -> int:
    """Return how many numbers the first row of an entity has."""
    first = recording.rows(entity).column("scalars")[0].as_py()
    return len(first or [])


def parts_of(path: str) -> list[str]:
    """Return the parts of an entity path, with their escapes."""
    return _PART.findall(path)


def plain(part: str) -> str:
    """Return a part of an entity path without its escapes."""
    return re.sub(r"\\(.)", r"\1", part)


def _dotted(below: list[str], name: str) -> str:
    """Return a number's name below a group; ``term[3]`` of the entity ``term`` does not say the term twice."""
    if name.startswith("["):
        return ".".join(below) + name
    if below and name.startswith(f"{below[-1]}["):
        below = below[:-1]
    return ".".join([*below, name])


def table(recording: Recording, numbers: Sequence[Number]) -> pa.Table:
    """Return numbers as columns beside their timelines, by step; NaN where one has no row."""
    timeline = _timeline(recording, [n.entity for n in numbers])
    columns = {name: pa.array(column) for name, column in timeline.columns.items()}
    for number in numbers:
        values = recording.values(number.entity)[:, number.index]
        columns[_free(number.name, columns)] = pa.array(timeline.placed(number.entity, values))
    return pa.table(columns)


def matrix(recording: Recording, numbers: Sequence[Number]) -> NDArray[np.float64]:
    """Return numbers as (rows, width), by step; NaN where one has no row."""
    timeline = _timeline(recording, [n.entity for n in numbers])
    return np.stack([timeline.placed(n.entity, recording.values(n.entity)[:, n.index]) for n in numbers], axis=1)


@dataclass(frozen=True)
class _Timeline:
    """The steps of several entities together.

    Attributes:
        columns: ``step``, ``sim_time`` (s), ``iteration`` as far as there are.
        rows: for each entity the rows in which its own stand; None when they are all of them.
    """

    columns: dict[str, NDArray]
    rows: dict[str, NDArray[np.int64] | None]

    def placed(self, entity: str, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return an entity's values among all rows."""
        rows = self.rows[entity]
        if rows is None:
            return values
        found = np.full(len(next(iter(self.columns.values()))), np.nan)
        found[rows] = values
        return found


def _timeline(recording: Recording, entities: Sequence[str]) -> _Timeline:
    own = {entity: _times(recording, entity) for entity in dict.fromkeys(entities)}
    first = next(iter(own.values()))
    keys = {entity: times.get(STEP, np.arange(_length(times))) for entity, times in own.items()}
    same = next(iter(keys.values()))
    if all(np.array_equal(steps, same) for steps in keys.values()):
        return _Timeline(first or {STEP: same}, dict.fromkeys(own))
    steps = np.unique(np.concatenate(list(keys.values())))
    rows = {entity: np.searchsorted(steps, key) for entity, key in keys.items()}
    columns: dict[str, NDArray] = {STEP: steps}
    for name in (SIM_TIME, ITERATION):
        if all(name in times for times in own.values()):
            columns[name] = np.empty(len(steps), dtype=first[name].dtype)
            for entity, times in own.items():
                columns[name][rows[entity]] = times[name]
    return _Timeline(columns, dict(rows))


def _times(recording: Recording, entity: str) -> dict[str, NDArray]:
    """Return an entity's timelines as numbers; one that has gaps is left out."""
    table, found = recording.rows(entity), {}
    for name in _TIMES:
        if name in table.column_names and table.column(name).null_count == 0:
            values = np.asarray(table.column(name).cast("int64"))
            found[name] = values * 1e-9 if name == SIM_TIME else values
    return found or {STEP: np.arange(len(table))}


def _length(times: dict[str, NDArray]) -> int:
    return len(next(iter(times.values())))


def _free(name: str, taken: dict[str, pa.Array]) -> str:
    """Return a name for a column that is not taken."""
    return name if name not in taken else f"{name}_"
