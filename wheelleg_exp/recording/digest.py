"""A digest of what a recording holds, the same for every run that did the same."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from wheelleg_exp.recording.layout import DOCUMENTS
from wheelleg_exp.recording.reader import Recording

if TYPE_CHECKING:
    from hashlib import _Hash


def recording_digest(path: Path, *, without: Iterable[str] = (DOCUMENTS,)) -> str:
    """Return a sha256 over the content of a recording, to the last bit of every number.

    The bytes of two files always differ, by row ids and chunk boundaries; neither is part of the content, nor are
    the recording's name and id and its layout. Texts are left out unless asked for, because they tell of a run's
    time and place.

    Args:
        path: the recording.
        without: first parts of the entity paths that are left out.

    Raises:
        RunDirectoryError: the file is no whole recording.
    """
    digest = hashlib.sha256()
    for entity, part in entity_digests(path, without=without).items():
        digest.update(f"{entity}\0{part}\0".encode())
    return digest.hexdigest()


def entity_digests(path: Path, *, without: Iterable[str] = (DOCUMENTS,)) -> dict[str, str]:
    """Return a sha256 of each entity's content, to tell where two recordings part.

    Raises:
        RunDirectoryError: the file is no whole recording.
    """
    recording, left_out = Recording(path), set(without)
    return {e: _digest(recording, e) for e in recording.entities() if e.split("/")[0] not in left_out}


def _digest(recording: Recording, entity: str) -> str:
    digest = hashlib.sha256()
    for name, array in _columns(recording, entity):
        digest.update(f"{name}\0{array.type}\0{len(array)}\0".encode())
        _update(digest, array)
    return digest.hexdigest()


def _columns(recording: Recording, entity: str) -> Iterator[tuple[str, pa.Array]]:
    for name, array in sorted(recording.static_arrays(entity).items()):
        yield f"static {name}", array
    if recording.has_rows(entity):
        table = recording.table(entity)
        for name in sorted(table.column_names):
            yield name, table.column(name).combine_chunks()


def _update(digest: _Hash, array: pa.Array) -> None:
    """Feed an array's content: which values are there, the lengths of lists, and the bytes of the values."""
    if isinstance(array, pa.ChunkedArray):
        array = pa.concat_arrays(array.chunks)
    digest.update(np.asarray(array.is_valid()).tobytes())
    kind = array.type
    if pa.types.is_list(kind) or pa.types.is_large_list(kind) or pa.types.is_fixed_size_list(kind):
        digest.update(np.asarray(pc.fill_null(pc.list_value_length(array), 0), dtype=np.int64).tobytes())
        _update(digest, array.flatten())
    elif pa.types.is_struct(kind):
        for part in array.flatten():
            _update(digest, part)
    elif pa.types.is_floating(kind) or pa.types.is_integer(kind):
        digest.update(np.asarray(array.drop_null()).tobytes())
    elif pa.types.is_duration(kind):
        digest.update(np.asarray(array.drop_null().cast(pa.int64())).tobytes())
    else:
        for value in array.drop_null():
            data = value.as_py()
            text = data if isinstance(data, bytes) else str(data).encode()
            digest.update(len(text).to_bytes(8, "little") + text)
