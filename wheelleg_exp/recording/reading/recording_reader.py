"""Read a recording: the rows of each Rerun entity, numbers by name and in groups, events, documents, properties."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from wheelleg_exp.errors import RunDirectoryError, nearest_name
from wheelleg_exp.recording import layout
from wheelleg_exp.recording.layout import BRANCH, DOCUMENTS, ITERATION, OWN, SIM_TIME, STEP, unescaped
from wheelleg_exp.recording.reading.arrow_values import (
    LONGEST_TEXT,
    TIMELINES,
    as_number,
    python_values,
    short_name,
)
from wheelleg_exp.recording.reading.recording_contents import Contents, Health, columns, latest

SCALARS = "scalars"
_NOT_NUMBERS = (layout.WORLD, layout.OVERLAY, layout.GROUND, layout.DOCUMENTS, layout.LOG)
# A damaged recording can contain huge tables, so limit the number of columns and the length of column names.
_WIDEST, _MOST, _LETTERS = 1 << 16, 1 << 20, 1 << 26
Column = NDArray[np.int64] | NDArray[np.float64]
_PART = re.compile(r"(?:\\.|[^/\\])+", re.DOTALL)
_COLUMNS = ("text", "level", STEP, SIM_TIME, ITERATION)
_ENV_PREFIX = re.compile(r"env ([0-9]{1,9}): (.*)", re.DOTALL)
_MOST_ENVS = 1 << 12


@dataclass(frozen=True)
class Number:
    """One number of an entity: its dotted name below the requested group, and its index in the entity's row."""

    name: str
    entity: str
    index: int


@dataclass(frozen=True)
class Event:
    """One message in the log of a recording.

    ``kind`` is ``episodes``, ``events``, or ``recording``; ``level`` is a log level such as ``WARN``. None means: all
    environments, an unknown step or time (s), or no training iteration.
    """

    kind: str
    text: str
    env_id: int | None
    step: int | None
    time_s: float | None
    iteration: int | None
    level: str


class Recording:
    """A Rerun recording that was read from a file. ``health`` states how much of the recording's file is readable.

    ``recording_id`` must select one of several recordings. A missing or foreign file raises RunDirectoryError.
    """

    def __init__(self, path: Path, *, recording_id: str | None = None) -> None:
        self.path = Path(path)
        self._contents = Contents(self.path, recording_id)
        self.recording_id = self._contents.recording_id
        self._tables: dict[str, pa.Table] = {}
        self._statics: dict[str, dict[str, pa.Array]] = {}
        self._by_branch: dict[str, dict[str, Number]] = {}

    # --- entities ---

    def entities(self) -> list[str]:
        """Return the sorted paths of the Rerun entities, without a leading slash. Hidden entities are excluded."""
        return sorted(entity for entity in self._contents.pieces if entity and not entity.startswith(layout.HIDDEN))

    def timelines(self) -> list[str]:
        found = {name for e in self.entities() for name in self.columns(e)}
        return [name for name in TIMELINES if name in found]

    def reach(self, timeline: str) -> tuple[float, float] | None:
        """Return the first and the last value of a timeline (in s for ``sim_time``); None for an empty timeline."""
        found = self._contents.reach.get(timeline)
        scale = 1e-9 if timeline == SIM_TIME else 1.0
        return None if found is None else (found[0] * scale, found[1] * scale)

    def columns(self, entity: str) -> set[str]:
        """Return the names of a Rerun entity's timelines and of its components that change over time."""
        pieces = [piece for piece in self._contents.pieces.get(entity.strip("/"), ()) if not piece.is_static]
        return {short_name(name) for piece in pieces for name in piece.names}

    def archetypes(self, entity: str) -> set[str]:
        """Return the names of the Rerun archetypes, such as ``Boxes3D``, that an entity's static data contains."""
        pieces = self._contents.pieces.get(entity.strip("/"), ())
        names = (name for piece in pieces if piece.is_static for name in piece.names)
        return {name.split(":", 1)[0] for name in names if ":" in name}

    def rows(self, entity: str) -> pa.Table:
        """Return a Rerun entity's values over time, sorted by step; raise KeyError for an entity without values."""
        if not self.has_rows(entity):
            raise KeyError(entity)
        if entity not in self._tables:
            tables = [columns(batch) for batch in self._contents.rows(entity, static=False)]
            try:
                table = pa.concat_tables(tables, promote_options="permissive").combine_chunks()
                if STEP in table.column_names:
                    # Drop recorded rows without a control step number, because rows are sorted by this number.
                    table = table.filter(table.column(STEP).is_valid()) if table.column(STEP).null_count else table
                    steps = np.asarray(table.column(STEP))
                    if not (steps[1:] >= steps[:-1]).all():
                        table = table.take(np.argsort(steps, kind="stable"))
            except (pa.ArrowException, ValueError, TypeError) as error:
                raise self._mixed(entity) from error
            self._tables[entity] = table
        return self._tables[entity]

    def static(self, entity: str) -> dict[str, list[object]]:
        """Return the static data of a Rerun entity by component; an empty dictionary if it has none."""
        path = entity.strip("/")
        if path not in self._statics:
            self._statics[path] = latest(self._contents.rows(path, static=True))
        values = {name: python_values(array)[0] for name, array in self._statics[path].items()}
        return {name: value if isinstance(value, list) else [] for name, value in values.items()}

    def has_rows(self, entity: str) -> bool:
        """Return whether a Rerun entity has rows over time, not only static data."""
        return self.count(entity) > 0

    def count(self, entity: str) -> int:
        """Return the number of a Rerun entity's rows over time; static rows are not counted."""
        pieces = self._contents.pieces.get(entity.strip("/"), ())
        return sum(piece.batch.num_rows for piece in pieces if not piece.is_static)

    @property
    def health(self) -> Health:
        """The state of the recording's file: complete, truncated, or damaged."""
        return self._contents.health

    # --- numbers ---

    def is_numeric(self, entity: str) -> bool:
        """Return whether a Rerun entity contains recorded numbers, and not shapes, poses, or texts."""
        return entity.split("/")[0] not in _NOT_NUMBERS and SCALARS in self.columns(entity)

    def groups(self) -> list[str]:
        """Return the names of the groups of recorded numbers, such as ``rewards`` and ``joints``."""
        return list(self._groups)

    def table(self, name: str, env_id: int | None = None) -> pa.Table:
        """Return a table of the rows of a Rerun entity, or of a group of entities such as ``rewards``.

        An entity has the columns ``step``, ``sim_time`` (duration), ``iteration`` if it exists, and one list column for
        each component by its short name: ``scalars``, ``translation``, ``quaternion``, ``text``. A group has ``step``,
        ``sim_time`` (s), ``iteration`` if recorded, and one float64 column for each number, NaN where it was not
        recorded. Without the timeline ``step``, the column contains row numbers. ``env_id`` defaults to the first
        recorded environment. An unknown name raises RunDirectoryError.
        """
        path = self._resolved(name, env_id)
        return self.rows(path) if self.has_rows(path) else self.numbers(name, env_id)

    def numbers(self, name: str, env_id: int | None = None) -> pa.Table:
        """Return the numbers of a Rerun entity or a group of entities as a table with one column for each number."""
        return self.columns_of(self._numbers_of(self._resolved(name, env_id)))

    def all_numbers(self, env_id: int | None = None) -> dict[str, Number]:
        """Return the numbers of an environment, and numbers that all environments share (training scalars), by name."""
        branch = self.branch(env_id)
        if branch not in self._by_branch:
            depths = {e: int(bool(branch) and e.split("/")[0] == branch) for e in self._numeric}
            shared = [e for e, depth in depths.items() if depth or not BRANCH.match(f"{e}/")]
            numbers = self._within_bounds(n for e in shared for n in self._numbers(e, depths[e]))
            self._by_branch[branch] = {number.name: number for number in numbers}
        return self._by_branch[branch]

    def columns_of(self, numbers: Sequence[Number]) -> pa.Table:
        """Return a table of timelines and ``numbers``, sorted by control step, in which a missing number is NaN."""
        times, places = _timelines({entity: self._times(entity) for entity in dict.fromkeys(n.entity for n in numbers)})
        found = {name: pa.array(column) for name, column in times.items()}
        for number in numbers:
            name = number.name if number.name not in found else f"{number.name}_"
            values = self.matrix(number.entity)[:, number.index]
            if number.entity in places:
                placed = np.full(len(times[STEP]), np.nan)
                placed[places[number.entity]] = values
                values = placed
            found[name] = pa.array(values)
        return pa.table(found)

    def values(self, name: str, env_id: int | None = None) -> NDArray[np.float64]:
        """Return the numbers of an entity or a group, (rows, width); raise RunDirectoryError if there are none."""
        path = self._resolved(name, env_id)
        if self.has_rows(path):
            return self.matrix(path)
        table = self.numbers(name, env_id)
        return np.stack([np.asarray(table.column(n)) for n in table.column_names if n not in TIMELINES], axis=1)

    def matrix(self, entity: str) -> NDArray[np.float64]:
        """Return a Rerun entity's numbers, (rows, width); raise RunDirectoryError if the rows differ in width."""
        table = self.rows(entity)
        if SCALARS not in table.column_names:
            message = f"'{entity}' of '{self.path}' contains no numbers"
            raise RunDirectoryError(message, expected="an entity with scalars")
        column = table.column(SCALARS).combine_chunks()
        try:
            flat, width = np.asarray(column.flatten(), dtype=np.float64), self._width(entity)
        except (pa.ArrowException, ValueError, TypeError, AttributeError) as error:
            raise self._mixed(entity) from error
        if len(flat) != len(table) * width:
            raise RunDirectoryError(f"the rows of '{entity}' in '{self.path}' contain different numbers of values")
        return flat.reshape(len(table), -1)

    def names(self, name: str, env_id: int | None = None) -> list[str]:
        """Return the names of the numbers in an entity or a group such as ``rewards``; [] for numbers without names."""
        path = self._path(name, env_id)
        own = self._own_names(path)
        if own or self.has_rows(path) or path not in self._groups:
            return own
        return [number.name for number in self._numbers_of(path)]

    # --- events, documents, properties, environments ---

    def events(self, kind: str | None = None, env_id: int | None = None) -> list[Event]:
        """Return the recorded log messages, sorted by control step; by default of all kinds and all environments."""
        found = [event for entity in filter(self.has_rows, self.entities()) for event in self._events(entity)]
        found = [e for e in found if kind in (None, e.kind) and (env_id is None or e.env_id in (None, env_id))]
        return sorted(found, key=lambda event: -1 if event.step is None else event.step)

    def documents(self) -> list[str]:
        return [key for e in self.entities() if (key := layout.key_below(DOCUMENTS, e)) is not None]

    def document(self, name: str) -> str | None:
        """Return the recorded text document with the given name; None for an unknown name."""
        text = self.static(layout.join(DOCUMENTS, name)).get("text")
        return str(text[0]) if text else None

    @cached_property
    def properties(self) -> Mapping[str, Mapping[str, object]]:
        """The recording's properties by name: ``wheelleg``, ``robot``. A value stored as ``[5]`` becomes ``5``."""
        found: dict[str, Mapping[str, object]] = {}
        for entity in self._contents.pieces:
            root, _, name = entity.partition("/")
            if root == layout.PROPERTIES:
                values = {k: _plain_value(v[0] if len(v) == 1 else v) for k, v in self.static(entity).items()}
                found[name or "RecordingInfo"] = values
        return found

    @cached_property
    def purpose(self) -> str | None:
        """The recording's purpose: ``training``, ``play``, or ``evaluation``. None for another program's recording."""
        purpose = self.properties.get(OWN, {}).get("purpose")
        if isinstance(purpose, str):
            return purpose
        # Recordings of format 1 do not state their purpose, so guess the purpose from the names of the recorded data.
        parts = {BRANCH.sub("", entity).split("/")[0] for entity in self.entities()}
        return "training" if layout.TRAINING in parts else "play" if {"rewards", "terminations"} <= parts else None

    @cached_property
    def env_ids(self) -> list[int]:
        """The indices of the recorded environments; [0] if the recording does not state the indices."""
        stored = self.properties.get(OWN, {}).get("env_ids")
        ids = stored if isinstance(stored, list) else [stored]
        known = [i for i in ids if isinstance(i, int) and i >= 0]
        if ids and len(known) == len(ids) <= _MOST_ENVS:
            return list(dict.fromkeys(known))
        if self._branches:
            return self._branches
        return [event.env_id for event in self.events() if event.env_id is not None][:1] or [0]

    @cached_property
    def step_dt(self) -> float | None:
        """The duration of a control step, s; None if the recording does not state the duration."""
        stored = as_number(self.properties.get(OWN, {}).get("step_dt"))
        if stored is not None and math.isfinite(stored) and stored > 0:
            return stored
        for entity in filter(self.has_rows, self.entities()):
            table = self.rows(entity)
            if {STEP, SIM_TIME} <= set(table.column_names):
                steps = np.asarray(table.column(STEP))
                times = np.asarray(table.column(SIM_TIME).cast("int64").fill_null(0))
                if len(steps) and steps[-1] > 0 and times[-1] > 0:
                    return float(times[-1] / steps[-1] * 1e-9)
        return None

    def branch(self, env_id: int | None = None) -> str:
        """Return the prefix of an environment's entity paths, such as ``env_3``; empty if only one was recorded."""
        if env_id is not None and env_id not in self.env_ids:
            message = f"environment {env_id} was not recorded in '{self.path}'"
            raise RunDirectoryError(message, expected="one of " + ", ".join(map(str, self.env_ids)))
        chosen = self.env_ids[0] if env_id is None else env_id
        return f"env_{chosen}" if chosen in self._branches else ""

    @cached_property
    def _branches(self) -> list[int]:
        matches = [BRANCH.match(f"{entity}/") for entity in self.entities()]
        return sorted({int(match.group(1)) for match in matches if match})[:_MOST_ENVS]

    @cached_property
    def _numeric(self) -> dict[str, None]:
        return dict.fromkeys(e for e in self.entities() if self.has_rows(e) and self.is_numeric(e))

    @cached_property
    def _groups(self) -> dict[str, list[str]]:
        """Maps each path, such as ``joints``, to the Rerun entities with numbers below this path, in column order."""
        found: dict[str, list[str]] = {}
        room = _LETTERS
        for entity in self._numeric:
            parts = parts_of(entity)
            room -= len(parts) * len(entity)
            if room < 0:
                raise self._too_many("groups")
            for depth in range(1, len(parts)):
                found.setdefault("/".join(parts[:depth]), []).append(entity)
        for path, entities in found.items():
            static, depth = self.static(path), len(parts_of(path))
            order = {str(name): i for i, name in enumerate(static.get("terms") or static.get("names") or [])}
            names = {entity: unescaped(parts_of(entity)[depth]) for entity in entities}
            found[path] = sorted(entities, key=lambda e: (order.get(names[e], len(order)), e))
        return found

    def _numbers_of(self, path: str) -> list[Number]:
        """Return the numbers of a Rerun entity and of all entities below it."""
        own = [path] if path in self._numeric else []
        depth = len(parts_of(path))
        found = []
        numbers = (n for entity in (*own, *self._groups.get(path, ())) for n in self._numbers(entity, depth))
        for number in self._within_bounds(numbers):
            # The number `episode/step` would get the name of the timeline `step`, so name it `episode.step`.
            if number.name in TIMELINES:
                name = ".".join(unescaped(part) for part in parts_of(number.entity)[-2:])
                number = Number(name, number.entity, number.index)
            found.append(number)
        return found

    def _numbers(self, entity: str, depth: int) -> Iterator[Number]:
        below = [unescaped(part) for part in parts_of(entity)[depth:]]
        names, width = self._own_names(entity), self._width(entity)
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

    def _own_names(self, entity: str) -> list[str]:
        return [str(word)[:LONGEST_TEXT] for word in self.static(entity).get("names", [])]

    def _width(self, entity: str) -> int:
        """Return the length of a Rerun entity's first row of numbers, such as 3 for a vector; 0 without rows."""
        lengths = pc.list_value_length(self.rows(entity).column(SCALARS).slice(0, 1))
        return (lengths[0].as_py() or 0) if len(lengths) else 0

    def _within_bounds(self, numbers: Iterable[Number]) -> Iterator[Number]:
        for count, number in enumerate(numbers):
            if count == _MOST:
                raise self._too_many("numbers")
            yield number

    def _times(self, entity: str) -> dict[str, Column]:
        table, found = self.rows(entity), dict[str, Column]()
        for name in TIMELINES:
            if name in table.column_names and table.column(name).null_count == 0:
                values = np.asarray(table.column(name).cast("int64"))
                found[name] = values * 1e-9 if name == SIM_TIME else values
        return found or {STEP: np.arange(len(table))}

    def _events(self, entity: str) -> Iterator[Event]:
        head, _, kind = BRANCH.sub("", entity, count=1).rpartition("/")
        if head != layout.LOG:
            return
        table, branch = self.rows(entity), BRANCH.match(entity)
        found = (python_values(table.column(n)) if n in table.column_names else [None] * len(table) for n in _COLUMNS)
        for text, level, step, time_ns, iteration in zip(*found, strict=True):
            if not text:
                continue
            shown = str(text[0])[:LONGEST_TEXT]
            env_id = int(branch.group(1)) if branch else None
            if prefix := _ENV_PREFIX.fullmatch(shown):
                env_id, shown = int(prefix.group(1)), prefix.group(2)
            time_s = None if time_ns is None else time_ns * 1e-9
            yield Event(kind, shown, env_id, step, time_s, iteration, str((level or ["INFO"])[0]))

    def _path(self, name: str, env_id: int | None) -> str:
        path, branch = name.strip("/"), self.branch(env_id)
        below = "/".join(part for part in (branch, path) if part)
        if env_id is None and (path in self._contents.pieces or path in self._groups):
            return path
        return below if below in self._contents.pieces or below in self._groups else path

    def _resolved(self, name: str, env_id: int | None) -> str:
        path = self._path(name, env_id)
        if self.has_rows(path) or path in self._groups:
            return path
        names = sorted({*(e for e in self.entities() if self.has_rows(e)), *self._groups})
        known = [n.removeprefix(f"{self.branch(env_id)}/") for n in names]
        message = f"the recording '{self.path}' has no rows at '{name}'"
        expected = "one of: " + ", ".join(known[:40]) + (", …" if len(known) > 40 else "")
        raise RunDirectoryError(message, expected=expected, nearest=nearest_name(name.strip("/"), known))

    def _mixed(self, entity: str) -> RunDirectoryError:
        message = f"the rows of '{entity}' of '{self.path}' have different types"
        return RunDirectoryError(message, expected="a recording that is not damaged")

    def _too_many(self, what: str) -> RunDirectoryError:
        return RunDirectoryError(f"'{self.path}' contains too many {what}", expected="a smaller recording")


def parts_of(path: str) -> list[str]:
    """Return the names in a Rerun entity path, without removing their escape characters."""
    return _PART.findall(path)


def _plain_value(value: object) -> object:
    if isinstance(value, list):
        return [_plain_value(item) for item in value]
    if isinstance(value, dict):
        return {str(key): _plain_value(item) for key, item in value.items()}
    return value if isinstance(value, int | float | None) else str(value)[:LONGEST_TEXT]


def _timelines(own: dict[str, dict[str, Column]]) -> tuple[dict[str, Column], dict[str, NDArray[np.int64]]]:
    """Return the timelines of all entities together, and each entity's rows in them; {} if all rows are equal."""
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
