"""Compute a hash of a recording's rows: two runs that recorded equal rows have equal hashes."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable
from contextlib import suppress
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from wheelleg_exp.recording.layout import DOCUMENTS, HIDDEN, STEP, TRAINING
from wheelleg_exp.recording.reading.arrow_values import is_list, python_values
from wheelleg_exp.recording.reading.recording_contents import Contents, columns, latest

# A recording's digest omits recorded texts and wall-clock times, because these differ between equal runs.
LEFT_OUT = (DOCUMENTS, f"{TRAINING}/Perf")


def entity_digests(path: Path, *, without: Iterable[str] = LEFT_OUT) -> dict[str, str]:
    """Return a sha256 over the rows of each Rerun entity, by the entity's path.

    Row ids and chunk boundaries have no effect. ``without`` omits entities and all entities below them.
    """
    contents, left_out = Contents(path), tuple(without)
    names = {entity.strip("/"): entity for entity in contents.pieces}
    heads = (HIDDEN, *(f"{path}/" for path in left_out))
    counted = [name for name in sorted(names) if name and name not in left_out and not name.startswith(heads)]
    return {name: _digest(contents, names[name]) for name in counted}


def _digest(contents: Contents, entity: str) -> str:
    digest = hashlib.sha256()
    static = latest(contents.batches(entity, static=True))
    arrays = [(f"static {name}", static[name]) for name in sorted(static)]
    tables = [columns(batch) for batch in contents.batches(entity, static=False)]
    with suppress(pa.ArrowException):  # Arrow cannot concatenate tables whose columns have different types.
        tables = [pa.concat_tables(tables, promote_options="default")] if tables else []
    for table in tables:
        rows = table.sort_by([(STEP, "ascending")]) if table.column_names.count(STEP) == 1 else table
        places = sorted(range(rows.num_columns), key=rows.column_names.__getitem__)
        arrays += [(rows.column_names[i], rows.column(i).combine_chunks()) for i in places]
    for name, array in arrays:
        digest.update(f"{name}\0{array.type}\0{len(array)}\0".encode())
        _update(digest.update, array)
    return digest.hexdigest()


def _update(update: Callable[[bytes], object], array: pa.Array) -> None:
    """Add the content of an array to a digest: the valid values, the lengths of lists, and the bytes of the values."""
    if isinstance(array, pa.ChunkedArray):
        array = pa.concat_arrays(array.chunks)
    update(np.asarray(array.is_valid()).tobytes())
    kind = array.type
    if is_list(kind):
        update(np.asarray(pc.fill_null(pc.list_value_length(array), 0), dtype=np.int64).tobytes())
        _update(update, array.flatten())
    elif pa.types.is_struct(kind):
        for part in array.flatten():
            _update(update, part)
    elif pa.types.is_floating(kind) or pa.types.is_integer(kind):
        update(np.asarray(array.drop_null()).tobytes())
    elif pa.types.is_temporal(kind) and not pa.types.is_interval(kind):
        update(np.asarray(array.drop_null().cast(pa.int32() if kind.bit_width == 32 else pa.int64())).tobytes())
    else:
        for data in python_values(array.drop_null()):
            text = data if isinstance(data, bytes) else str(data).encode()
            update(len(text).to_bytes(8, "little") + text)
