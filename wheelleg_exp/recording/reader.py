"""Reading a recording back: what it holds, as tables."""

from __future__ import annotations

from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from rerun.chunk import Chunk, RrdReader

from wheelleg_exp.errors import RunDirectoryError, nearest_name
from wheelleg_exp.recording.earlier import open_reader
from wheelleg_exp.recording.layout import DOCUMENTS, ITERATION, SIM_TIME, STEP, join
from wheelleg_exp.run.files import for_people

_MAGIC = b"RRF"
_TIMELINES = (STEP, SIM_TIME, ITERATION)
_HIDDEN = "__"


class Recording:
    """A recording in memory, read from its file; one whose writer was killed is read as far as it was flushed.

    Args:
        path: the file.

    Raises:
        RunDirectoryError: the file is missing, empty, no recording, or ends in the middle of a message.
    """

    def __init__(self, path: Path) -> None:
        self.path = Path(path)
        _require_recording(self.path)
        try:
            self._load(open_reader(self.path))
        except (RuntimeError, ValueError, OSError) as error:
            raise RunDirectoryError(
                f"the recording '{self.path}' is damaged: {str(error).splitlines()[0]}",
                expected="a recording that was not cut off or changed",
            ) from error

    def entities(self) -> list[str]:
        """Return the paths that hold something, without a leading slash, sorted."""
        return sorted({*self._rows, *self._static} - {""})

    def timelines(self) -> list[str]:
        """Return the names of the timelines."""
        found = {name for batches in self._rows.values() for b in batches for name in b.schema.names}
        return [name for name in _TIMELINES if name in found]

    def table(self, entity: str) -> pa.Table:
        """Return what was recorded over time at an entity, sorted by step.

        Returns:
            Columns ``step``, ``sim_time`` (duration), ``iteration`` where there is one, and one list column a
            component, by its short name: ``scalars``, ``translation``, ``quaternion``, ``vectors``, ``text``, …

        Raises:
            RunDirectoryError: nothing was recorded over time at this entity.
        """
        batches = self._rows.get(entity.strip("/"))
        if not batches:
            names = sorted(self._rows)
            raise RunDirectoryError(
                f"the recording '{self.path}' has no rows at '{entity}'",
                expected="one of: " + ", ".join(names),
                nearest=nearest_name(entity.strip("/"), names),
            )
        tables = [pa.Table.from_batches([batch]) for batch in batches]
        joined = pa.concat_tables(tables, promote_options="default").combine_chunks()
        return joined.sort_by([(STEP, "ascending")]) if STEP in joined.column_names else joined

    def values(self, entity: str) -> NDArray[np.float64]:
        """Return the numbers of an entity, (rows, width), sorted by step.

        Raises:
            RunDirectoryError: there are none, or their width changes.
        """
        table = self.table(entity)
        if "scalars" not in table.column_names:
            raise RunDirectoryError(f"'{entity}' of '{self.path}' holds no numbers", expected="an entity with scalars")
        column = table.column("scalars").combine_chunks()
        flat = np.asarray(column.flatten())
        if len(table) and len(flat) != len(table) * len(column[0]):
            raise RunDirectoryError(f"the rows of '{entity}' of '{self.path}' differ in width")
        return flat.reshape(len(table), -1)

    def names(self, entity: str) -> list[str]:
        """Return the names of the numbers of an entity; empty when they have none."""
        return [str(name) for name in self.static(entity).get("names", [])]

    def static(self, entity: str) -> dict[str, list[Any]]:
        """Return what holds at all times at an entity, by component; empty when there is nothing."""
        return {name: array[0].as_py() or [] for name, array in self.static_arrays(entity).items()}

    def static_arrays(self, entity: str) -> dict[str, pa.Array]:
        """Return what holds at all times at an entity as one-row list arrays, by component."""
        return dict(self._static.get(entity.strip("/"), {}))

    def has_rows(self, entity: str) -> bool:
        """Return whether something was recorded over time at an entity."""
        return entity.strip("/") in self._rows

    def document(self, name: str) -> str | None:
        """Return a text by its name, None when there is none."""
        text = self.static(join(DOCUMENTS, name)).get("text")
        return str(text[0]) if text else None

    def _load(self, reader: RrdReader) -> None:
        found = reader.recordings()
        if len(found) != 1:
            raise ValueError(f"it holds {len(found)} recordings instead of one")
        self.recording_id: str = found[0].recording_id
        self._rows: dict[str, list[pa.RecordBatch]] = defaultdict(list)
        self._static: dict[str, dict[str, pa.Array]] = defaultdict(dict)
        for chunk in reader.stream():
            entity = chunk.entity_path.strip("/")
            if not entity.startswith(_HIDDEN):
                self._take(entity, chunk)

    def _take(self, entity: str, chunk: Chunk) -> None:
        batch = chunk.to_record_batch()
        if chunk.is_static:
            for name in batch.schema.names:
                if is_component(batch.schema.field(name)) and len(batch):
                    self._static[entity][short(name)] = batch.column(name)[-1:]
            return
        kept = [i for i, f in enumerate(batch.schema) if f.name in _TIMELINES or is_component(f)]
        names = [short(batch.schema.field(i).name) for i in kept]
        self._rows[entity].append(pa.RecordBatch.from_arrays([batch.column(i) for i in kept], names=names))


def short(name: str) -> str:
    """Return a column's name without its archetype: ``Scalars:scalars`` is ``scalars``."""
    return name.rsplit(":", 1)[-1]


def is_component(field: pa.Field) -> bool:
    """Return whether a column of a chunk holds data."""
    return (field.metadata or {}).get(b"rerun:kind") == b"data"


def _require_recording(path: Path) -> None:
    with for_people(path, "read"), path.open("rb") as file:
        head = file.read(4)
    if not head:
        raise RunDirectoryError(f"the recording '{path}' is empty", expected="a rerun recording")
    if not head.startswith(_MAGIC):
        raise RunDirectoryError(f"'{path}' is no rerun recording", expected="a file that begins with 'RRF'")
