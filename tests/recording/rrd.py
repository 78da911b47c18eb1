"""Files of rerun's format by hand: every byte of a hostile recording is chosen, and the same in every run."""

from __future__ import annotations

import gzip
import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pyarrow as pa

HEADER = b"RRF2" + bytes([0, 41, 0, 0, 1, 2, 0, 0])
END, STORE_INFO, ROWS, ACTIVATION = range(4)
PLAIN, LZ4 = 1, 2
STEP, SIM_TIME, ITERATION = "step", "sim_time", "iteration"


def healthy() -> bytes:
    """Return the bytes of a whole recording as rerun 0.41 wrote it: ``inspection.synthetic.play``."""
    return gzip.decompress(Path(__file__).with_name("play.rrd.gz").read_bytes())


def varint(value: int) -> bytes:
    return bytes([value & 0x7F | 0x80]) + varint(value >> 7) if value > 0x7F else bytes([value])


def number(field: int, value: int) -> bytes:
    return varint(field << 3) + varint(value)


def data(field: int, content: bytes, *, length: int | None = None) -> bytes:
    return varint(field << 3 | 2) + varint(len(content) if length is None else length) + content


def message(kind: int, payload: bytes, *, length: int | None = None) -> bytes:
    return struct.pack("<QQ", kind, len(payload) if length is None else length) + payload


def store(kind: int = 1, name: str = "r", application: str = "wheelleg") -> bytes:
    return number(1, kind) + data(2, name.encode()) + data(3, data(1, application.encode()))


def announced(**of: Any) -> bytes:
    source = number(1, 2) + data(2, data(1, number(1, 3) + number(2, 11) + number(3, 7)))
    return message(STORE_INFO, data(1, bytes(18)) + data(2, data(2, store(**of)) + data(5, source)))


def packed(content: bytes, *, how: int = LZ4, size: int | None = None, of: bytes | None = None) -> bytes:
    """Return the message of rows whose Arrow stream is ``content``."""
    body = pa.Codec("lz4_raw").compress(content, asbytes=True) if how == LZ4 else content
    head = data(1, store() if of is None else of) + number(2, how)
    return message(ROWS, head + number(3, len(content) if size is None else size) + number(4, 1) + data(5, body))


def stream(batch: pa.RecordBatch) -> bytes:
    with pa.BufferOutputStream() as sink:
        with pa.ipc.new_stream(sink, batch.schema) as writer:
            writer.write_batch(batch)
        return sink.getvalue().to_pybytes()


def batch(entity: str, columns: Mapping[str, pa.Array], times: Mapping[str, pa.Array]) -> pa.RecordBatch:
    count = max((len(values) for values in (*columns.values(), *times.values())), default=0)
    ids = pa.array([struct.pack(">QQ", 1, i) for i in range(count)], pa.binary(16))
    fields = [pa.field("rerun.controls.RowId", ids.type, metadata={"rerun:kind": "control"})]
    fields += [pa.field(n, v.type, metadata={"rerun:kind": "index", "rerun:index_name": n}) for n, v in times.items()]
    fields += [pa.field(n, v.type, metadata={"rerun:kind": "data", "rerun:component": n}) for n, v in columns.items()]
    about = {"rerun:entity_path": entity, "rerun:id": f"chunk_{1:032x}", "sorbet:version": "0.1.4"}
    arrays = [ids, *times.values(), *columns.values()]
    return pa.RecordBatch.from_arrays(arrays, schema=pa.schema(fields, metadata=about))


def lists(values: list[Any], kind: pa.DataType | None = None) -> pa.Array:
    """Return a component with one value a row."""
    return pa.array([[value] for value in values], pa.list_(kind) if kind is not None else None)


def steps(count: int, **others: pa.Array) -> dict[str, pa.Array]:
    moments = pa.array([20_000_000 * (i + 1) for i in range(count)], pa.duration("ns"))
    return {STEP: pa.array(range(1, count + 1), pa.int64()), SIM_TIME: moments, **others}


def rows(
    entity: str, columns: Mapping[str, pa.Array], times: Mapping[str, pa.Array] | None = None, **how: Any
) -> bytes:
    """Return the message of rows; ``times`` of None counts steps, none at all is what holds at all times."""
    count = max((len(values) for values in columns.values()), default=0)
    return packed(stream(batch(entity, columns, steps(count) if times is None else times)), **how)


def numbers(entity: str, values: list[float], times: Mapping[str, pa.Array] | None = None) -> bytes:
    return rows(entity, {"Scalars:scalars": lists(values, pa.float64())}, times)


def static(entity: str, **columns: pa.Array) -> bytes:
    return rows(entity, columns, {})
