"""The training scalars of the last iterations, which a killed run has written to its journal alone.

The journal is one vector an iteration, whose k-th number is of the k-th of the static ``keys``; the scalars themselves
are written every so many iterations.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from wheelleg_exp.recording.layout import ITERATION, JOURNAL, TRAINING, join_key, key_below
from wheelleg_exp.recording.reading.arrow_values import TIMELINES, python_values
from wheelleg_exp.recording.reading.recording_contents import Contents, columns

_MOST = 1 << 16  # keys


class Journal:
    """The journal of a recording; empty when it has none.

    Args:
        contents: the recording's file.
    """

    def __init__(self, contents: Contents) -> None:
        self._places: dict[str, int] = {}
        self._written = contents.pieces
        self._rows: pa.Table | None = None
        batches = [columns(batch) for batch in contents.rows(JOURNAL, static=False)]
        whole = [batch for batch in batches if {*TIMELINES, "scalars"} <= set(batch.column_names)]
        known = {key: path for path in contents.pieces if (key := key_below(TRAINING, path)) is not None}
        for batch in contents.rows(JOURNAL, static=True):
            table = columns(batch)
            keys = python_values(table.column("keys")) if "keys" in table.column_names else []
            words = [str(key) for key in ((keys[-1] if keys else None) or [])[:_MOST]]
            self._places = {known.get(word) or join_key(TRAINING, word): i for i, word in enumerate(words)}
        if whole:
            self._rows = pa.concat_tables(whole, promote_options="permissive").combine_chunks()

    @property
    def entities(self) -> set[str]:
        """The paths of the scalars that it tells of."""
        return set(self._places) if self._rows is not None else set()

    @cached_property
    def unwritten(self) -> set[str]:
        """The paths of the scalars that stand here alone."""
        missing = (entity for entity in self.entities if not any(p.count for p in self._written.get(entity, ())))
        return {entity for entity in missing if len(self._column(self._places[entity], -1))}

    def rows_after(self, entity: str, written: Sequence[pa.Table]) -> pa.Table | None:
        """Return the rows of a scalar that are behind those which were written, None when it does not tell of it."""
        if entity not in self.entities:
            return None
        known = [np.asarray(table.column(ITERATION)) for table in written if ITERATION in table.column_names]
        last = max((int(iterations.max()) for iterations in known if len(iterations)), default=-1)
        return self._column(self._places[entity], last)

    def _column(self, place: int, after: int) -> pa.Table:
        """Return one scalar as a table, past an iteration, without the iterations that have no value."""
        rows, (flat, starts, lengths) = self._rows, self._vectors
        has = lengths > place
        values = np.full(len(lengths), np.nan)
        values[has] = flat[starts[has] + place]
        iterations = np.asarray(rows.column(ITERATION).fill_null(-1))  # type: ignore[union-attr]
        kept = pa.array((iterations > after) & ~np.isnan(values))
        scalars = pa.array(values[:, None].tolist(), type=pa.list_(pa.float64()))
        return rows.set_column(rows.column_names.index("scalars"), "scalars", scalars).filter(kept)  # type: ignore[union-attr]

    @cached_property
    def _vectors(self) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.int64]]:
        """All numbers, where each row's begin, and how many it has."""
        column = self._rows.column("scalars").combine_chunks()  # type: ignore[union-attr]
        lengths = np.asarray(pc.list_value_length(column).fill_null(0), dtype=np.int64)
        return np.asarray(column.flatten(), dtype=np.float64), np.cumsum(lengths) - lengths, lengths
