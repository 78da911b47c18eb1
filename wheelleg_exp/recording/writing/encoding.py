"""Writing the messages of an rrd file, which ``messages`` describes and reads.

Written here and not by rerun's own stream because each of those leaves two threads and some megabytes in the process
for ever, waits without end when its disk is full, and adds up all streams of a process when one is closed.
"""

from __future__ import annotations

import secrets
import struct
import sys
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from wheelleg_exp.recording.reading.messages import BLUEPRINT_ACTIVATION, HEAD, LZ4, MAGIC, PROTOBUF, ROWS, STORE_INFO

_SORBET = "0.1.4"  # of the columns and their metadata
_UNPACKED, _PYTHON, _ARROW = 1, 2, 1
_ROW_ID = pa.field(
    "rerun.controls.RowId",
    pa.binary(16),
    nullable=False,
    metadata={
        "ARROW:extension:name": "rerun.datatypes.TUID",
        "ARROW:extension:metadata": '{"namespace":"row"}',
        "rerun:kind": "control",
        "rerun:is_sorted": "true",
    },
)

Column = tuple[pa.Field, pa.Array]


@dataclass(frozen=True)
class Store:
    """What rows belong to.

    Attributes:
        kind: ``messages.RECORDING`` or ``messages.BLUEPRINT``.
        id: its identity.
        application: the application that it is of.
    """

    kind: int
    id: str
    application: str

    @property
    def encoded(self) -> bytes:
        """The store as a message names it."""
        return _number(1, self.kind) + _bytes(2, self.id.encode()) + _bytes(3, _bytes(1, self.application.encode()))


class Ids:
    """Identities that rise, and that no other process gives."""

    def __init__(self) -> None:
        self._time, self._next = time.time_ns(), secrets.randbits(62)

    def take(self, count: int = 1) -> NDArray[np.uint64]:
        """Return as many new identities, (count, 2): a time, ns, and a number."""
        self._time = max(self._time, time.time_ns())
        found = np.empty((count, 2), dtype=np.uint64)
        found[:, 0], found[:, 1] = self._time, np.arange(self._next, self._next + count)
        self._next += count
        return found


def header() -> bytes:
    """Return what a file begins with."""
    numbers = [int(word) for word in version("rerun-sdk").split(".")[:3]]
    return MAGIC + bytes([*numbers, 0, _UNPACKED, PROTOBUF, 0, 0])


def store_info(store: Store, ids: Ids) -> bytes:
    """Return the message that announces a store."""
    language = b"".join(_number(i, part) for i, part in enumerate(sys.version_info[:3], start=1))
    source = _number(1, _PYTHON) + _bytes(2, _bytes(1, language))
    identity = _identity(*ids.take()[0].tolist())
    return _message(STORE_INFO, _bytes(1, identity) + _bytes(2, _bytes(2, store.encoded) + _bytes(5, source)))


def activation(store: Store) -> bytes:
    """Return the message that makes a blueprint, which stands before it, the layout that is opened."""
    return _message(BLUEPRINT_ACTIVATION, _bytes(1, store.encoded) + _number(2, 1) + _number(3, 1))


def new_rows(store: Store, entity: str, columns: Sequence[Column], ids: Ids) -> bytes:
    """Return the message of new rows.

    Args:
        store: what they belong to.
        entity: where they stand, a path with its escapes.
        columns: the timelines and components; without a timeline they hold at all times.
        ids: where their identities come from.

    Raises:
        ValueError: the columns are of different lengths.
    """
    count = len(columns[0][1])
    numbers = pa.py_buffer(ids.take(count).astype(">u8").tobytes())
    rows = pa.FixedSizeBinaryArray.from_buffers(_ROW_ID.type, count, [None, numbers])
    chunk = "chunk_{:016X}{:016x}".format(*ids.take()[0].tolist())
    about = {"rerun:entity_path": f"/{entity.strip('/')}", "rerun:id": chunk, "sorbet:version": _SORBET}
    schema = pa.schema([_ROW_ID, *(field for field, _ in columns)], metadata=about)
    batch = pa.RecordBatch.from_arrays([rows, *(array for _, array in columns)], schema=schema)
    batch.validate()
    return rows_message(store, batch)


def rows_message(store: Store, batch: pa.RecordBatch) -> bytes:
    """Return the message of rows that have their identities."""
    with pa.BufferOutputStream() as sink:
        with pa.ipc.new_stream(sink, batch.schema) as stream:
            stream.write_batch(batch)
        plain = sink.getvalue()
    identity = batch.schema.metadata[b"rerun:id"].decode().removeprefix("chunk_")
    is_static = all((field.metadata or {}).get(b"rerun:kind") != b"index" for field in batch.schema)
    parts = [
        _bytes(1, store.encoded),
        _number(2, LZ4),
        _number(3, plain.size),
        _number(4, _ARROW),
        _bytes(5, pa.Codec("lz4_raw").compress(plain, asbytes=True)),
        _bytes(6, _identity(int(identity[:16], 16), int(identity[16:], 16))),
        _number(7, int(is_static)),
    ]
    return _message(ROWS, b"".join(parts))


def timeline(name: str, values: pa.Array) -> Column:
    """Return a timeline's column; ``values`` are int64, durations or moments."""
    numbers = np.asarray(values.view(pa.int64()))
    about = {"rerun:kind": "index", "rerun:index_name": name}
    if (numbers[1:] >= numbers[:-1]).all():
        about["rerun:is_sorted"] = "true"
    return pa.field(name, values.type, metadata=about), values


def component(descriptor: Any, values: pa.Array) -> Column:
    """Return a component's column from one list of values a row; ``descriptor`` is rerun's."""
    about = {
        "rerun:kind": "data",
        "rerun:component": descriptor.component,
        "rerun:archetype": descriptor.archetype,
        "rerun:component_type": descriptor.component_type,
    }
    known = {key: value for key, value in about.items() if value is not None}
    return pa.field(descriptor.component, values.type, metadata=known), values


def one_row(archetypes: Iterable[Any]) -> list[Column]:
    """Return archetypes (or lists of component batches) of rerun's as the columns of one row."""
    found: dict[str, Column] = {}
    for archetype in archetypes:
        batches = archetype.as_component_batches() if hasattr(archetype, "as_component_batches") else archetype
        for batch in batches:
            values = batch.as_arrow_array()
            lists = pa.ListArray.from_arrays(pa.array([0, len(values)], pa.int32()), values)
            found[batch.component_descriptor().component] = component(batch.component_descriptor(), lists)
    return list(found.values())


def _message(kind: int, payload: bytes) -> bytes:
    return HEAD.pack(kind, len(payload)) + payload


def _identity(moment: int, number: int) -> bytes:
    return struct.pack("<BQBQ", 1 << 3 | 1, moment, 2 << 3 | 1, number)


def _number(field: int, value: int) -> bytes:
    return _varint(field << 3) + _varint(value)


def _bytes(field: int, data: bytes) -> bytes:
    return _varint(field << 3 | 2) + _varint(len(data)) + data


def _varint(value: int) -> bytes:
    digits = bytearray()
    while value > 0x7F:
        digits.append(value & 0x7F | 0x80)
        value >>= 7
    digits.append(value)
    return bytes(digits)
