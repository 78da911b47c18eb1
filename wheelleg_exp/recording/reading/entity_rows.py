"""The rows of a recording by entity."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from wheelleg_exp.errors import RunDirectoryError
from wheelleg_exp.recording.layout import HIDDEN, SIM_TIME, STEP
from wheelleg_exp.recording.reading.arrow_values import LONGEST_TEXT, TIMELINES, python_values, short_name
from wheelleg_exp.recording.reading.journal import Journal
from wheelleg_exp.recording.reading.recording_contents import Contents, Health, columns, latest

SCALARS = "scalars"
BYTES_LIMIT = 1 << 29


class EntityRows:
    """What a file holds at each entity; rows are read when they are asked for.

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
        self._tables: dict[tuple[str, str], pa.Table] = {}
        self._held = 0  # bytes of the tables
        self._statics: dict[str, dict[str, pa.Array]] = {}

    def entities(self) -> list[str]:
        """Return the paths that hold something, without a leading slash, sorted."""
        return list(self._entities)

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
        return {short_name(name) for piece in pieces for name in piece.columns}

    def archetypes(self, entity: str) -> set[str]:
        """Return the archetypes of what holds at all times at an entity: ``Boxes3D``, ``SeriesLines``."""
        pieces = self._contents.pieces.get(entity.strip("/"), ())
        names = (name for piece in pieces if piece.is_static for name in piece.columns)
        return {name.split(":", 1)[0] for name in names if ":" in name}

    def rows(self, entity: str) -> pa.Table:
        """Return what ``table`` returns of an entity whose whole path is given (KeyError when it has no rows)."""
        if not self.has_rows(entity):
            raise KeyError(entity)
        return self._kept("rows", entity, self._read)

    def matrix(self, entity: str) -> NDArray[np.float64]:
        """Return the numbers of an entity whose whole path is given, (rows, width); raises as ``values``."""
        table = self.rows(entity)
        if SCALARS not in table.column_names:
            raise RunDirectoryError(f"'{entity}' of '{self.path}' holds no numbers", expected="an entity with scalars")
        column = table.column(SCALARS).combine_chunks()
        try:
            flat, width = np.asarray(column.flatten(), dtype=np.float64), self.width(entity)
        except (pa.ArrowException, ValueError, TypeError, AttributeError) as error:
            raise self._mixed(entity) from error
        if len(flat) != len(table) * width:
            raise RunDirectoryError(f"the rows of '{entity}' of '{self.path}' differ in width")
        return flat.reshape(len(table), -1)

    def width(self, entity: str) -> int:
        """Return how many numbers the first row of an entity has."""
        lengths = pc.list_value_length(self.rows(entity).column(SCALARS).slice(0, 1))
        return (lengths[0].as_py() or 0) if len(lengths) else 0

    def number_names(self, entity: str) -> list[str]:
        """Return the names that an entity gives its numbers; empty when it gives none."""
        return [str(word)[:LONGEST_TEXT] for word in self.static(entity).get("names", [])]

    def static(self, entity: str) -> dict[str, list[Any]]:
        """Return what holds at all times at an entity, by component; empty when there is nothing."""
        return {name: python_values(array)[0] or [] for name, array in self.static_arrays(entity).items()}

    def static_arrays(self, entity: str) -> dict[str, pa.Array]:
        """Return what holds at all times at an entity as one-row list arrays, by component."""
        path = entity.strip("/")
        if path not in self._statics:
            self._statics[path] = latest(self._contents.rows(path, static=True))
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

    @property
    def journal_entities(self) -> set[str]:
        """The training scalars whose last rows stand in the journal, perhaps alone."""
        return self._journal.entities

    @property
    def health(self) -> Health:
        """How whole the file is."""
        return self._contents.health

    @cached_property
    def _entities(self) -> list[str]:
        found = {*self._contents.pieces, *self._journal.unwritten}
        return sorted(e for e in found if e and not e.startswith(HIDDEN))

    @cached_property
    def _journal(self) -> Journal:
        return Journal(self._contents)

    def _kept(self, kind: str, path: str, read: Callable[[str], pa.Table]) -> pa.Table:
        """Return a table that is read once; those that were kept before it are forgotten when they are many."""
        if (kind, path) not in self._tables:
            table = read(path)
            if self._held > self._limit:
                self._tables.clear()
                self._held = 0
            self._held += table.nbytes
            self._tables[kind, path] = table
        return self._tables[kind, path]

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


def _sorted(table: pa.Table) -> pa.Table:
    """Return the rows by step, in the order of the file where steps are equal."""
    if STEP not in table.column_names:
        return table
    if table.column(STEP).null_count:  # what has no step stands nowhere among what has
        table = table.filter(table.column(STEP).is_valid())
    steps = np.asarray(table.column(STEP))
    if (steps[1:] >= steps[:-1]).all():
        return table
    return table.take(np.argsort(steps, kind="stable"))
