"""Read a recording: tables, names, events, documents, and properties."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from wheelleg_exp.errors import RunDirectoryError, nearest_name
from wheelleg_exp.recording import layout
from wheelleg_exp.recording.layout import BRANCH, DOCUMENTS, ITERATION, OWN, SIM_TIME, STEP
from wheelleg_exp.recording.reading import number_groups
from wheelleg_exp.recording.reading.arrow_values import LONGEST_TEXT, TIMELINES, as_number, python_values
from wheelleg_exp.recording.reading.entity_rows import EntityRows
from wheelleg_exp.recording.reading.number_groups import Number, NumberNames

_COLUMNS = ("text", "level", STEP, SIM_TIME, ITERATION)
_ENV_PREFIX = re.compile(r"env ([0-9]{1,9}): (.*)", re.DOTALL)
_MOST_ENVS = 1 << 12


@dataclass(frozen=True)
class Event:
    """One message in the log of a recording.

    ``kind``, the kind of log message, is ``episodes``, ``events``, or ``recording``. ``text`` is the log message
    without the environment's name. ``level`` is the message's log level, such as ``WARN``. None means: all
    environments, an unknown step or time (s), or no training iteration.
    """

    kind: str
    text: str
    env_id: int | None
    step: int | None
    time_s: float | None
    iteration: int | None
    level: str


def _events(entity: str, rows: EntityRows) -> Iterator[Event]:
    head, _, kind = BRANCH.sub("", entity, count=1).rpartition("/")
    if head != layout.LOG or not rows.has_rows(entity):
        return
    table, branch = rows.rows(entity), BRANCH.match(entity)
    columns = (python_values(table.column(n)) if n in table.column_names else [None] * len(table) for n in _COLUMNS)
    for text, level, step, time_ns, iteration in zip(*columns, strict=True):
        if not text:
            continue
        shown = str(text[0])[:LONGEST_TEXT]
        env_id = int(branch.group(1)) if branch else None
        if prefix := _ENV_PREFIX.fullmatch(shown):
            env_id, shown = int(prefix.group(1)), prefix.group(2)
        time_s = None if time_ns is None else time_ns * 1e-9
        yield Event(kind, shown, env_id, step, time_s, iteration, str((level or ["INFO"])[0]))


def _plain_value(value: object) -> object:
    if isinstance(value, list):
        return [_plain_value(item) for item in value]
    if isinstance(value, dict):
        return {str(key): _plain_value(item) for key, item in value.items()}
    return value if isinstance(value, int | float | None) else str(value)[:LONGEST_TEXT]


class Recording(EntityRows):
    """A Rerun recording that was read from a file. ``health`` states how much of the recording's file is readable."""

    def groups(self) -> list[str]:
        """Return the names of the groups of recorded numbers, such as ``rewards`` and ``joints``."""
        return list(self._names.groups)

    def table(self, name: str, env_id: int | None = None) -> pa.Table:
        """Return a table of the rows of a Rerun entity, or of a group of entities such as ``rewards``.

        The table of an entity has the columns ``step``, ``sim_time`` (duration), ``iteration`` if it exists, and one
        list column for each component by its short name: ``scalars``, ``translation``, ``quaternion``, ``text``.

        The table of a group of entities has ``step``, ``sim_time`` (s), ``iteration`` if recorded, and one float64
        column for each number. A number that was not recorded at a control step is NaN. If the timeline ``step`` was
        not recorded, the column ``step`` contains row numbers. By default, ``env_id`` is the first recorded
        environment. An unknown name raises RunDirectoryError.
        """
        path = self._resolved(name, env_id)
        return self.rows(path) if self.has_rows(path) else self.numbers(name, env_id)

    def numbers(self, name: str, env_id: int | None = None) -> pa.Table:
        """Return the numbers of a Rerun entity or a group of entities as a table with one column for each number."""
        return self.columns_of(self._names.numbers_of(self._resolved(name, env_id)))

    def all_numbers(self, env_id: int | None = None) -> dict[str, Number]:
        """Return the numbers of an environment, and numbers that all environments share (training scalars), by name."""
        return self._names.all(self.branch(env_id))

    def columns_of(self, numbers: Sequence[Number]) -> pa.Table:
        """Return a table with the recorded timelines and one column for each element of ``numbers``."""
        return number_groups.table(self, numbers)

    def values(self, name: str, env_id: int | None = None) -> NDArray[np.float64]:
        """Return the numbers of a Rerun entity or group of entities, (rows, width), sorted by control step.

        ``values`` raises RunDirectoryError if a requested entity has no numbers or has rows of different widths.
        """
        path = self._resolved(name, env_id)
        if self.has_rows(path):
            return self.matrix(path)
        table = self.numbers(name, env_id)
        return np.stack([np.asarray(table.column(n)) for n in table.column_names if n not in TIMELINES], axis=1)

    def names(self, name: str, env_id: int | None = None) -> list[str]:
        """Return the names of the numbers in an entity or a group such as ``rewards``; [] for numbers without names."""
        path = self._path(name, env_id)
        own = self.number_names(path)
        if own or self.has_rows(path) or path not in self._names.groups:
            return own
        return [number.name for number in self._names.numbers_of(path)]

    def events(self, kind: str | None = None, env_id: int | None = None) -> list[Event]:
        """Return the recorded log messages, sorted by control step; by default of all kinds and all environments."""
        found = [event for entity in self.entities() for event in _events(entity, self)]
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
        if self.branches:
            return self.branches
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

    @cached_property
    def branches(self) -> list[int]:
        """The environment indices in entity paths such as ``env_3/base``; [] if no path starts with ``env_``."""
        matches = [BRANCH.match(f"{entity}/") for entity in self.entities()]
        return sorted({int(match.group(1)) for match in matches if match})[:_MOST_ENVS]

    def branch(self, env_id: int | None = None) -> str:
        """Return the first part of an environment's entity paths, such as ``env_3``.

        ``branch`` returns an empty text if only one environment was recorded, because entity paths then have no prefix.
        ``branch`` raises RunDirectoryError if the environment ``env_id`` was not recorded.
        """
        if env_id is not None and env_id not in self.env_ids:
            message = f"environment {env_id} was not recorded in '{self.path}'"
            raise RunDirectoryError(message, expected="one of " + ", ".join(map(str, self.env_ids)))
        chosen = self.env_ids[0] if env_id is None else env_id
        return f"env_{chosen}" if chosen in self.branches else ""

    @cached_property
    def _names(self) -> NumberNames:
        return NumberNames(self)

    def _path(self, name: str, env_id: int | None) -> str:
        path, branch = name.strip("/"), self.branch(env_id)
        below = "/".join(part for part in (branch, path) if part)
        if env_id is None and (path in self._contents.pieces or path in self._names.groups):
            return path
        return below if below in self._contents.pieces or below in self._names.groups else path

    def _resolved(self, name: str, env_id: int | None) -> str:
        path = self._path(name, env_id)
        if self.has_rows(path) or path in self._names.groups:
            return path
        names = sorted({*(e for e in self.entities() if self.has_rows(e)), *self._names.groups})
        known = [n.removeprefix(f"{self.branch(env_id)}/") for n in names]
        message = f"the recording '{self.path}' has no rows at '{name}'"
        expected = "one of: " + ", ".join(known[:40]) + (", …" if len(known) > 40 else "")
        raise RunDirectoryError(message, expected=expected, nearest=nearest_name(name.strip("/"), known))
