"""Read the recorded rows of each Rerun entity."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from wheelleg_exp.errors import RunDirectoryError
from wheelleg_exp.recording.layout import HIDDEN, SIM_TIME, STEP
from wheelleg_exp.recording.reading.arrow_values import LONGEST_TEXT, TIMELINES, python_values, short_name
from wheelleg_exp.recording.reading.recording_contents import Contents, Health, columns, latest

SCALARS = "scalars"


class EntityRows:
    """Gives access to the recorded rows of each Rerun entity in a recording's file.

    ``EntityRows`` raises RunDirectoryError if the file is missing, empty, or not a recording. ``recording_id`` must
    select one recording if the file contains several.
    """

    def __init__(self, path: Path, *, recording_id: str | None = None) -> None:
        self.path = Path(path)
        self._contents = Contents(self.path, recording_id)
        self.recording_id = self._contents.recording_id
        self._tables: dict[str, pa.Table] = {}
        self._statics: dict[str, dict[str, pa.Array]] = {}

    def entities(self) -> list[str]:
        """Return the sorted paths of the Rerun entities, without a leading slash. Hidden entities are excluded."""
        return sorted(entity for entity in self._contents.pieces if entity and not entity.startswith(HIDDEN))

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

    def matrix(self, entity: str) -> NDArray[np.float64]:
        """Return a Rerun entity's numbers, (rows, width); raise RunDirectoryError if the rows differ in width."""
        table = self.rows(entity)
        if SCALARS not in table.column_names:
            message = f"'{entity}' of '{self.path}' contains no numbers"
            raise RunDirectoryError(message, expected="an entity with scalars")
        column = table.column(SCALARS).combine_chunks()
        try:
            flat, width = np.asarray(column.flatten(), dtype=np.float64), self.width(entity)
        except (pa.ArrowException, ValueError, TypeError, AttributeError) as error:
            raise self._mixed(entity) from error
        if len(flat) != len(table) * width:
            raise RunDirectoryError(f"the rows of '{entity}' in '{self.path}' contain different numbers of values")
        return flat.reshape(len(table), -1)

    def width(self, entity: str) -> int:
        """Return the length of a Rerun entity's first row of numbers, such as 3 for a vector; 0 without rows."""
        lengths = pc.list_value_length(self.rows(entity).column(SCALARS).slice(0, 1))
        return (lengths[0].as_py() or 0) if len(lengths) else 0

    def number_names(self, entity: str) -> list[str]:
        return [str(word)[:LONGEST_TEXT] for word in self.static(entity).get("names", [])]

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

    def _mixed(self, entity: str) -> RunDirectoryError:
        message = f"the rows of '{entity}' of '{self.path}' have different types"
        return RunDirectoryError(message, expected="a recording that is not damaged")
