"""A digest of a recording's content. Runs that did the same have the same digest."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Iterator
from contextlib import suppress
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from wheelleg_exp.recording.layout import DOCUMENTS, HIDDEN, STEP, TRAINING
from wheelleg_exp.recording.reading.arrow_values import is_list, python_values
from wheelleg_exp.recording.reading.recording_contents import Contents, columns, latest

if TYPE_CHECKING:
    from hashlib import _Hash


_VALUES_AT_ONCE = 1 << 16  # values that are converted to Python values at a time

# Entities that depend on the place and time of a run: texts, and wall-clock times.
LEFT_OUT = (DOCUMENTS, f"{TRAINING}/Perf")


def recording_digest(path: Path, *, without: Iterable[str] = LEFT_OUT) -> str:
    """Return a sha256 over the content of a recording, to the last bit of every number.

    The bytes of two files always differ, in row ids and chunk boundaries. The digest contains neither, nor the
    recording's name, id, properties and layout.

    Args:
        path: the recording.
        without: entity paths that are left out together with all paths below them.

    Raises:
        RunDirectoryError: the file is not a recording.
    """
    digest = hashlib.sha256()
    for entity, part in entity_digests(path, without=without).items():
        digest.update(f"{entity}\0{part}\0".encode())
    return digest.hexdigest()


def entity_digests(path: Path, *, without: Iterable[str] = LEFT_OUT) -> dict[str, str]:
    """Return a sha256 of each entity's content by its path, to find the entities in which two recordings differ.

    Raises:
        RunDirectoryError: the file is not a recording.
    """
    contents, left_out = Contents(path), tuple(without)
    names = {entity.strip("/"): entity for entity in contents.pieces}
    return {name: _digest(contents, names[name]) for name in sorted(names) if _counts(name, left_out)}


def _counts(name: str, left_out: Iterable[str]) -> bool:
    below = any(name == path or name.startswith(f"{path}/") for path in left_out)
    return bool(name) and not name.startswith(HIDDEN) and not below


def _digest(contents: Contents, entity: str) -> str:
    digest = hashlib.sha256()
    for name, array in [*_static(contents, entity), *_rows(contents, entity)]:
        digest.update(f"{name}\0{array.type}\0{len(array)}\0".encode())
        _update(digest, array)
    return digest.hexdigest()


def _static(contents: Contents, entity: str) -> Iterator[tuple[str, pa.Array]]:
    """Yield the static components, each as it was last written."""
    found = latest(contents.batches(entity, static=True))
    yield from ((f"static {name}", found[name]) for name in sorted(found))


def _rows(contents: Contents, entity: str) -> Iterator[tuple[str, pa.Array]]:
    """Yield the columns over time, sorted by step."""
    tables = [columns(batch) for batch in contents.batches(entity, static=False)]
    with suppress(pa.ArrowException):  # one name has several types, which this program never writes
        tables = [pa.concat_tables(tables, promote_options="default")] if tables else []
    for table in tables:
        rows = table.sort_by([(STEP, "ascending")]) if table.column_names.count(STEP) == 1 else table
        for place in sorted(range(rows.num_columns), key=rows.column_names.__getitem__):
            yield rows.column_names[place], rows.column(place).combine_chunks()


def _update(digest: _Hash, array: pa.Array) -> None:
    """Add an array's content to a digest: the valid values, the lengths of lists, and the bytes of the values."""
    if isinstance(array, pa.ChunkedArray):
        array = pa.concat_arrays(array.chunks)
    digest.update(np.asarray(array.is_valid()).tobytes())
    kind = array.type
    if is_list(kind):
        digest.update(np.asarray(pc.fill_null(pc.list_value_length(array), 0), dtype=np.int64).tobytes())
        _update(digest, array.flatten())
    elif pa.types.is_struct(kind):
        for part in array.flatten():
            _update(digest, part)
    elif pa.types.is_floating(kind) or pa.types.is_integer(kind):
        digest.update(np.asarray(array.drop_null()).tobytes())
    elif pa.types.is_temporal(kind) and not pa.types.is_interval(kind):
        digest.update(np.asarray(array.drop_null().cast(pa.int32() if kind.bit_width == 32 else pa.int64())).tobytes())
    else:
        known = array.drop_null()
        for data in chain.from_iterable(
            python_values(known[i : i + _VALUES_AT_ONCE]) for i in range(0, len(known), _VALUES_AT_ONCE)
        ):
            text = data if isinstance(data, bytes) else str(data).encode()
            digest.update(len(text).to_bytes(8, "little") + text)
