"""Read a recording: tables, names, events, documents, and properties."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from wheelleg_exp.errors import RunDirectoryError, nearest_name
from wheelleg_exp.recording.layout import (
    BRANCH,
    DOCUMENTS,
    ITERATION,
    LOG,
    OWN,
    PROPERTIES,
    SIM_TIME,
    STEP,
    TRAINING,
    join,
    key_below,
)
from wheelleg_exp.recording.reading import number_groups
from wheelleg_exp.recording.reading.arrow_values import LONGEST_TEXT, as_number, python_values
from wheelleg_exp.recording.reading.entity_rows import EntityRows
from wheelleg_exp.recording.reading.number_groups import Number, NumberNames

_COLUMNS = ("text", "level", STEP, SIM_TIME, ITERATION)
_ENV_PREFIX = re.compile(r"env ([0-9]{1,9}): (.*)", re.DOTALL)


@dataclass(frozen=True)
class Event:
    """One line of a recording's log.

    Attributes:
        kind: ``episodes``, ``events`` or ``recording``.
        text: the text without the name of the environment.
        env_id: the environment; None for all.
        step: control step; None when unknown.
        time_s: simulated time; None when unknown.
        iteration: training iteration; None outside of training.
        level: severity by rerun's names.
    """

    kind: str
    text: str
    env_id: int | None
    step: int | None
    time_s: float | None
    iteration: int | None
    level: str


def read_events(rows: EntityRows) -> list[Event]:
    """Return all of them by step."""
    told = (entity for entity in rows.entities() if _kind(entity) and rows.has_rows(entity))
    found = [event for entity in told for event in _events_of(entity, rows.rows(entity))]
    return sorted(found, key=lambda event: -1 if event.step is None else event.step)


def _kind(entity: str) -> str | None:
    """Return the kind of an entity's events: ``episodes`` for ``env_3/log/episodes``; None for other entities."""
    head, _, kind = BRANCH.sub("", entity, count=1).rpartition("/")
    return kind if head == LOG else None


def _events_of(entity: str, table: pa.Table) -> list[Event]:
    kind, branch = _kind(entity) or "", BRANCH.match(entity)
    fallback = int(branch.group(1)) if branch else None
    columns = (python_values(table.column(n)) if n in table.column_names else [None] * len(table) for n in _COLUMNS)
    rows = (dict(zip(_COLUMNS, row, strict=True)) for row in zip(*columns, strict=True))
    return [_event(row, kind, fallback) for row in rows if row["text"]]


def _event(row: dict[str, Any], kind: str, fallback: int | None) -> Event:
    text = str(row["text"][0])[:LONGEST_TEXT]
    said = _ENV_PREFIX.fullmatch(text)
    return Event(
        kind=kind,
        text=said.group(2) if said else text,
        env_id=int(said.group(1)) if said else fallback,
        step=row[STEP],
        time_s=None if row[SIM_TIME] is None else row[SIM_TIME] * 1e-9,
        iteration=row[ITERATION],
        level=str((row["level"] or ["INFO"])[0]),
    )


Properties = Mapping[str, Mapping[str, Any]]


_MOST_ENVS = 1 << 12


def read_properties(rows: EntityRows, entities: Iterable[str]) -> Properties:
    """Return the properties by name; a list of one value becomes the value."""
    found: dict[str, Mapping[str, Any]] = {}
    for entity in entities:
        root, _, name = entity.partition("/")
        if root == PROPERTIES:
            values = rows.static(entity)
            found[name or "RecordingInfo"] = {k: _plain_value(v[0] if len(v) == 1 else v) for k, v in values.items()}
    return found


def _plain_value(value: Any) -> Any:
    """Return a property's value as texts, numbers, lists and mappings."""
    if isinstance(value, list):
        return [_plain_value(item) for item in value]
    if isinstance(value, dict):
        return {str(key): _plain_value(item) for key, item in value.items()}
    return value if isinstance(value, int | float | None) else str(value)[:LONGEST_TEXT]


def read_purpose(properties: Properties, entities: Iterable[str]) -> str | None:
    """Return the purpose; a recording without properties has the first format, or another tool wrote it."""
    said = properties.get(OWN, {}).get("purpose")
    if isinstance(said, str):
        return said
    parts = {BRANCH.sub("", entity).split("/")[0] for entity in entities}
    return "training" if TRAINING in parts else "play" if {"rewards", "terminations"} <= parts else None


def read_env_ids(rows: EntityRows, properties: Properties, branches: list[int]) -> list[int]:
    """Return the recorded environments."""
    said = properties.get(OWN, {}).get("env_ids")
    ids = said if isinstance(said, list) else [said]
    if ids and len(ids) <= _MOST_ENVS and all(isinstance(i, int) and i >= 0 for i in ids):
        return list(dict.fromkeys(ids))
    if branches:
        return branches
    spoke = [event.env_id for event in read_events(rows) if event.env_id is not None]
    return spoke[:1] or [0]


def read_step_dt(rows: EntityRows, properties: Properties) -> float | None:
    """Return the simulated time of a control step, s."""
    said = properties.get(OWN, {}).get("step_dt")
    if (given := as_number(said)) is not None and math.isfinite(given) and given > 0:
        return given
    for entity in rows.entities():
        if rows.has_rows(entity):
            table = rows.rows(entity)
            if {STEP, SIM_TIME} <= set(table.column_names):
                steps = np.asarray(table.column(STEP))
                times = np.asarray(table.column(SIM_TIME).cast("int64").fill_null(0))
                if len(steps) and steps[-1] > 0 and times[-1] > 0:
                    return float(times[-1] / steps[-1] * 1e-9)
    return None


def read_branches(entities: Iterable[str]) -> list[int]:
    """Return the environments with a branch of their own."""
    matches = [BRANCH.match(f"{entity}/") for entity in entities]
    return sorted({int(match.group(1)) for match in matches if match})[:_MOST_ENVS]


class Recording(EntityRows):
    """A recording, read from its file as far as possible; ``health`` says how far.

    Arguments and errors are those of ``EntityRows``.
    """

    def groups(self) -> list[str]:
        """Return the groups of numbers, which ``table`` accepts: ``rewards``, ``joints``."""
        return list(self._names.groups)

    def table(self, name: str, env_id: int | None = None) -> pa.Table:
        """Return the rows of an entity, or of a group of entities, sorted by step.

        Args:
            name: an entity, or a group: ``rewards``, ``base``, ``joints/<joint>``, ``training``, …
            env_id: the recorded environment; by default the first.

        Returns:
            For an entity: columns ``step``, ``sim_time`` (duration), ``iteration`` if it exists, and one list column
            for each component by its short name: ``scalars``, ``translation``, ``quaternion``, ``vectors``, ``text``.
            For a group: ``step``, ``sim_time`` (s), ``iteration`` if it exists, and one float64 column for each number.
            Its name is the path below the group with dots. Steps without a row have NaN. Rows without a ``step`` are
            numbered.

        Raises:
            RunDirectoryError: neither an entity nor a group has the name.
        """
        path = self._resolved(name, env_id)
        if self.has_rows(path):
            return self.rows(path)
        return self.numbers(name, env_id)

    def numbers(self, name: str, env_id: int | None = None) -> pa.Table:
        """Return the numbers of an entity or a group, as ``table`` does for a group; raises as ``table``."""
        path = self._resolved(name, env_id)
        return self.columns_of(self._names.numbers_of(path))

    def all_numbers(self, env_id: int | None = None) -> dict[str, Number]:
        """Return every number of an environment, and those of no environment, by names such as ``rewards.alive``."""
        return self._names.all(self.branch(env_id))

    def columns_of(self, numbers: Sequence[Number]) -> pa.Table:
        """Return numbers as columns, as ``table`` does for a group."""
        return number_groups.table(self, numbers)

    def values(self, name: str, env_id: int | None = None) -> NDArray[np.float64]:
        """Return the numbers of an entity or group, (rows, width), sorted by step.

        Raises:
            RunDirectoryError: the entity or group has no numbers, or their width changes.
        """
        path = self._resolved(name, env_id)
        return self.matrix(path) if self.has_rows(path) else number_groups.matrix(self, self._names.numbers_of(path))

    def names(self, name: str, env_id: int | None = None) -> list[str]:
        """Return the names of the numbers of an entity or group; empty when the numbers have no names."""
        path = self._path(name, env_id)
        own = self.number_names(path)
        if own or self.has_rows(path) or path not in self._names.groups:
            return own
        return [number.name for number in self._names.numbers_of(path)]

    def events(self, kind: str | None = None, env_id: int | None = None) -> list[Event]:
        """Return the events, sorted by step.

        Args:
            kind: ``episodes``, ``events`` or ``recording``; by default all.
            env_id: the environment; by default all.
        """
        found = read_events(self)
        return [e for e in found if kind in (None, e.kind) and (env_id is None or e.env_id in (None, env_id))]

    def documents(self) -> list[str]:
        """Return the names of the texts."""
        keys = (key_below(DOCUMENTS, entity) for entity in self.entities())
        return [key for key in keys if key is not None]

    def document(self, name: str) -> str | None:
        """Return a text by its name; None when it does not exist."""
        text = self.static(join(DOCUMENTS, name)).get("text")
        return str(text[0]) if text else None

    @cached_property
    def properties(self) -> Mapping[str, Mapping[str, Any]]:
        """The properties of the recording by name: ``wheelleg``, ``robot``; a list of one value becomes the value."""
        return read_properties(self, self._contents.pieces)

    @cached_property
    def purpose(self) -> str | None:
        """``training``, ``play`` or ``evaluation``; None for a recording of another tool."""
        return read_purpose(self.properties, self.entities())

    @cached_property
    def env_ids(self) -> list[int]:
        """The recorded environments; [0] when unknown."""
        return read_env_ids(self, self.properties, self.branches)

    @cached_property
    def step_dt(self) -> float | None:
        """Simulated time of a control step, s; None when unknown."""
        return read_step_dt(self, self.properties)

    @cached_property
    def branches(self) -> list[int]:
        """The environments with a branch of their own; empty when one environment was recorded."""
        return read_branches(self.entities())

    def branch(self, env_id: int | None = None) -> str:
        """Return the path prefix of an environment's data; empty when one environment was recorded.

        Raises:
            RunDirectoryError: the environment was not recorded.
        """
        if env_id is not None and env_id not in self.env_ids:
            raise RunDirectoryError(
                f"environment {env_id} was not recorded in '{self.path}'",
                expected="one of " + ", ".join(map(str, self.env_ids)),
            )
        chosen = self.env_ids[0] if env_id is None else env_id
        return f"env_{chosen}" if chosen in self.branches else ""

    @cached_property
    def _names(self) -> NumberNames:
        return NumberNames(self)

    def _path(self, name: str, env_id: int | None) -> str:
        """Return the full path of ``name``, which may be relative to the environment's branch."""
        path, branch = name.strip("/"), self.branch(env_id)
        below = "/".join(part for part in (branch, path) if part)
        if env_id is None and (path in self._contents.pieces or path in self._names.groups):
            return path
        return below if below in self._contents.pieces or below in self._names.groups else path

    def _resolved(self, name: str, env_id: int | None) -> str:
        """Return the path of an entity with rows or of a group."""
        path = self._path(name, env_id)
        if self.has_rows(path) or path in self._names.groups:
            return path
        names = sorted({*(e for e in self.entities() if self.has_rows(e)), *self._names.groups})
        known = [n.removeprefix(f"{self.branch(env_id)}/") for n in names]
        raise RunDirectoryError(
            f"the recording '{self.path}' has no rows at '{name}'",
            expected="one of: " + ", ".join(known[:40]) + (", …" if len(known) > 40 else ""),
            nearest=nearest_name(name.strip("/"), known),
        )
