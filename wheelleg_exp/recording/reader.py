"""Reading a recording back: what it holds, as tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from wheelleg_exp.errors import RunDirectoryError, nearest_name
from wheelleg_exp.recording import events, groups, statics
from wheelleg_exp.recording.contents import TIMELINES, Contents, columns, is_component, short
from wheelleg_exp.recording.events import Event
from wheelleg_exp.recording.groups import Names, Number
from wheelleg_exp.recording.health import Health
from wheelleg_exp.recording.journal import Journal
from wheelleg_exp.recording.layout import DOCUMENTS, SIM_TIME, STEP, join, key_below

SCALARS = "scalars"
BYTES_LIMIT = 1 << 29
_HIDDEN = "__"


class Recording:
    """A recording, read from its file as far as that is whole; ``health`` says how far that is.

    Opening it reads the file once, to know what it holds; rows are read when they are asked for, and only those of
    the entities asked for.

    Args:
        path: the file.
        recording_id: which recording of a file that holds several.
        limit: most bytes of rows that are read of one entity.

    Raises:
        RunDirectoryError: the file is missing, empty, no recording, or holds several and none is chosen.
    """

    def __init__(self, path: Path, *, recording_id: str | None = None, limit: int = BYTES_LIMIT) -> None:
        self.path = Path(path)
        self._limit = limit
        self._contents = Contents(self.path, recording_id)
        self.recording_id = self._contents.recording_id
        self._tables: dict[str, pa.Table] = {}
        self._groups: dict[str, pa.Table] = {}
        self._held = 0  # bytes of the tables
        self._numbers: dict[str, dict[str, Number]] = {}
        self._statics: dict[str, dict[str, pa.Array]] = {}

    def entities(self) -> list[str]:
        """Return the paths that hold something, without a leading slash, sorted."""
        return list(self._entities)

    def groups(self) -> list[str]:
        """Return the paths above those that hold numbers, as ``table`` takes them: ``rewards``, ``joints``."""
        return list(self._names.groups)

    def timelines(self) -> list[str]:
        """Return the names of the timelines."""
        found = {name for e in self.entities() for name in self.columns(e)}
        return [name for name in TIMELINES if name in found]

    def reach(self, timeline: str) -> tuple[float, float] | None:
        """Return the first and last time on a timeline, ``sim_time`` in s; None when nothing stands on it."""
        found = self._contents.reach.get(timeline)
        scale = 1e-9 if timeline == SIM_TIME else 1.0
        return None if found is None else (found[0] * scale, found[1] * scale)

    def columns(self, entity: str) -> set[str]:
        """Return the names of the timelines and components of what was recorded over time at an entity."""
        path = entity.strip("/")
        pieces = [piece for piece in self._contents.pieces.get(path, ()) if not piece.is_static]
        if not pieces and path in self._journal.unwritten:
            return {*TIMELINES, SCALARS}
        return {short(name) for piece in pieces for name in piece.columns}

    def archetypes(self, entity: str) -> set[str]:
        """Return the archetypes of what holds at all times at an entity: ``Boxes3D``, ``SeriesLines``."""
        pieces = self._contents.pieces.get(entity.strip("/"), ())
        names = (name for piece in pieces if piece.is_static for name in piece.columns)
        return {name.split(":", 1)[0] for name in names if ":" in name}

    def table(self, name: str, env_id: int | None = None) -> pa.Table:
        """Return what was recorded over time at an entity, or at a group of them, sorted by step.

        Args:
            name: an entity, or a group: ``rewards``, ``base``, ``joints/<joint>``, ``training``, …
            env_id: which recorded environment; by default the first.

        Returns:
            Of an entity: columns ``step``, ``sim_time`` (duration), ``iteration`` where there is one, and one list
            column a component, by its short name: ``scalars``, ``translation``, ``quaternion``, ``vectors``, ``text``.
            Of a group: ``step``, ``sim_time`` (s), ``iteration`` where there is one, and one float64 column a number,
            whose name is its path below the group with dots; NaN where a number has no row at a step. What has no
            ``step`` is counted by rows.

        Raises:
            RunDirectoryError: there is neither, or it is larger than the limit.
        """
        path = self._resolved(name, env_id)
        if self.has_rows(path):
            return self.rows(path)
        return self.numbers(name, env_id)

    def rows(self, entity: str) -> pa.Table:
        """Return what ``table`` returns of an entity whose whole path is given (KeyError when it has no rows)."""
        if not self.has_rows(entity):
            raise KeyError(entity)
        if entity not in self._tables:
            self._tables[entity] = self._kept(self._read(entity))
        return self._tables[entity]

    def numbers(self, name: str, env_id: int | None = None) -> pa.Table:
        """Return the numbers of an entity or a group as ``table`` returns those of a group (raises as that)."""
        path = self._resolved(name, env_id)
        if path not in self._groups:
            self._groups[path] = self._kept(self.columns_of(self._names.numbers_of(path)))
        return self._groups[path]

    def all_numbers(self, env_id: int | None = None) -> dict[str, Number]:
        """Return every number of an environment, and those of none, by its name with dots: ``rewards.alive``."""
        branch = self.branch(env_id)
        if branch not in self._numbers:
            self._numbers[branch] = {number.name: number for number in self._names.all(branch)}
        return self._numbers[branch]

    def columns_of(self, numbers: Sequence[Number]) -> pa.Table:
        """Return numbers as ``table`` returns those of a group (RunDirectoryError when they are too many)."""
        self._require_small(8 * sum(self.count(number.entity) for number in numbers), f"{len(numbers)} numbers")
        return groups.table(self, numbers)

    def values(self, name: str, env_id: int | None = None) -> NDArray[np.float64]:
        """Return the numbers of an entity or group, (rows, width), sorted by step.

        Raises:
            RunDirectoryError: there are none, or their width changes.
        """
        path = self._resolved(name, env_id)
        if self.has_rows(path):
            return self._matrix(path)
        return groups.matrix(self, self._names.numbers_of(path))

    def names(self, name: str, env_id: int | None = None) -> list[str]:
        """Return the names of the numbers of an entity or group; empty when they have none."""
        path = self._path(name, env_id)
        own = [str(word) for word in self.static(path).get("names", [])]
        if own or self.has_rows(path) or path not in self._names.groups:
            return own
        return [number.name for number in self._names.numbers_of(path)]

    def static(self, entity: str) -> dict[str, list[Any]]:
        """Return what holds at all times at an entity, by component; empty when there is nothing."""
        return {name: array[0].as_py() or [] for name, array in self.static_arrays(entity).items()}

    def static_arrays(self, entity: str) -> dict[str, pa.Array]:
        """Return what holds at all times at an entity as one-row list arrays, by component."""
        path = entity.strip("/")
        if path not in self._statics:
            self._statics[path] = _latest(self._contents.rows(path, static=True))
        return dict(self._statics[path])

    def has_rows(self, entity: str) -> bool:
        """Return whether something was recorded over time at an entity."""
        path = entity.strip("/")
        written = any(piece.count for piece in self._contents.pieces.get(path, ()) if not piece.is_static)
        return written or path in self._journal.unwritten

    def count(self, entity: str) -> int:
        """Return how many rows were recorded over time at an entity."""
        path = entity.strip("/")
        if path in self._journal.entities:
            return len(self.rows(path))
        return sum(piece.count for piece in self._contents.pieces.get(path, ()) if not piece.is_static)

    def events(self, kind: str | None = None, env_id: int | None = None) -> list[Event]:
        """Return what was told in words, by step.

        Args:
            kind: ``episodes``, ``events`` or ``recording``; by default all.
            env_id: of which environment; by default of all.
        """
        found = events.read(self)
        return [e for e in found if kind in (None, e.kind) and (env_id is None or e.env_id in (None, env_id))]

    def documents(self) -> list[str]:
        """Return the names of the texts."""
        keys = (key_below(DOCUMENTS, entity) for entity in self.entities())
        return [key for key in keys if key is not None]

    def document(self, name: str) -> str | None:
        """Return a text by its name, None when there is none."""
        text = self.static(join(DOCUMENTS, name)).get("text")
        return str(text[0]) if text else None

    @property
    def journal_entities(self) -> set[str]:
        """The training scalars whose last rows stand in the journal, perhaps alone."""
        return self._journal.entities

    @property
    def health(self) -> Health:
        """How whole the file is."""
        return self._contents.health

    @cached_property
    def properties(self) -> Mapping[str, Mapping[str, Any]]:
        """The properties of the recording by name: ``wheelleg``, ``robot``; a list of one stands for itself."""
        return statics.properties(self, self._contents.pieces)

    @cached_property
    def purpose(self) -> str | None:
        """``training``, ``play`` or ``evaluation``; None for a recording of another tool."""
        return statics.purpose(self)

    @cached_property
    def env_ids(self) -> list[int]:
        """The recorded environments; [0] when it does not say."""
        return statics.env_ids(self)

    @cached_property
    def step_dt(self) -> float | None:
        """Simulated time of a control step, s; None when it is not known."""
        return statics.step_dt(self)

    def branch(self, env_id: int | None = None) -> str:
        """Return the path in front of an environment's data; empty when one alone was recorded.

        Raises:
            RunDirectoryError: that environment was not recorded.
        """
        if env_id is not None and env_id not in self.env_ids:
            raise RunDirectoryError(
                f"environment {env_id} was not recorded in '{self.path}'",
                expected="one of " + ", ".join(map(str, self.env_ids)),
            )
        return statics.branch(self, self.env_ids[0] if env_id is None else env_id)

    @cached_property
    def _entities(self) -> list[str]:
        found = {*self._contents.pieces, *self._journal.unwritten}
        return sorted(e for e in found if e and not e.startswith(_HIDDEN))

    @cached_property
    def branches(self) -> list[int]:
        """The environments that have a branch of their own, because several were recorded."""
        return statics.branches(self)

    @cached_property
    def _journal(self) -> Journal:
        return Journal(self._contents)

    @cached_property
    def _names(self) -> Names:
        return Names(self)

    def _path(self, name: str, env_id: int | None) -> str:
        """Return the path that ``name`` stands for: itself, or what it is below the environment's branch."""
        path, branch = name.strip("/"), self.branch(env_id)
        below = join_plain(branch, path)
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

    def _kept(self, table: pa.Table) -> pa.Table:
        """Return a table that is about to be kept, after forgetting those before it when they are many."""
        if self._held > self._limit:
            self._tables.clear()
            self._groups.clear()
            self._held = 0
        self._held += table.nbytes
        return table

    def _read(self, entity: str) -> pa.Table:
        tables, size = [], 0
        for batch in self._contents.rows(entity, static=False):
            size += batch.nbytes
            self._require_small(size, f"'{entity}'")
            tables.append(columns(batch))
        tables += [rows for rows in (self._journal.rows_after(entity, tables),) if rows is not None]
        try:
            return _sorted(pa.concat_tables(tables, promote_options="permissive").combine_chunks())
        except (pa.ArrowException, ValueError, TypeError) as error:
            raise self._mixed(entity) from error

    def _mixed(self, entity: str) -> RunDirectoryError:
        return RunDirectoryError(
            f"the rows of '{entity}' of '{self.path}' are not of one kind", expected="a recording that was not changed"
        )

    def _require_small(self, size: int, what: str) -> None:
        if size > self._limit:
            raise RunDirectoryError(
                f"{what} of '{self.path}' take more than the {self._limit / 2**20:.3g} MiB that are read at once",
                expected="fewer numbers, or a smaller recording",
            )

    def _matrix(self, entity: str) -> NDArray[np.float64]:
        table = self.rows(entity)
        if SCALARS not in table.column_names:
            raise RunDirectoryError(f"'{entity}' of '{self.path}' holds no numbers", expected="an entity with scalars")
        column = table.column(SCALARS).combine_chunks()
        try:
            flat, width = np.asarray(column.flatten(), dtype=np.float64), len(column[0].as_py() or [])
        except (pa.ArrowException, ValueError, TypeError, AttributeError) as error:
            raise self._mixed(entity) from error
        if len(flat) != len(table) * width:
            raise RunDirectoryError(f"the rows of '{entity}' of '{self.path}' differ in width")
        return flat.reshape(len(table), -1)


def join_plain(*parts: str) -> str:
    """Return a path of parts that are paths themselves."""
    return "/".join(part for part in parts if part)


def _sorted(table: pa.Table) -> pa.Table:
    """Return the rows by step, in the order of the file where steps are equal."""
    if STEP not in table.column_names:
        return table
    steps = np.asarray(table.column(STEP))
    if (steps[1:] >= steps[:-1]).all():
        return table
    return table.take(np.argsort(steps, kind="stable"))


def _latest(batches: Any) -> dict[str, pa.Array]:
    """Return each component's last row."""
    found: dict[str, pa.Array] = {}
    for batch in batches:
        for i, field in enumerate(batch.schema):
            if is_component(field) and len(batch):
                found[short(field.name)] = batch.column(i)[-1:]
    return found
