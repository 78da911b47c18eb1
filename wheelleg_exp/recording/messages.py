"""The messages of an rrd file: where each begins and ends, and the rows in it.

An rrd file is a header of 12 bytes (``RRF2``, the version of rerun that wrote it, options) and messages of a kind
(u64), a length (u64) and that many bytes; a closed file ends with a message that holds an index, and 32 bytes that
say where that stands. A message with rows is a protobuf message around an Arrow IPC stream, which is mostly
compressed by LZ4 (``rerun/log_msg/v1alpha1/log_msg.proto`` in rerun's sources).

Messages are read here and not by rerun's own reader because that one reads nothing of a file that is cut off, and
ends the whole process at some damaged ones. Arrow refuses damaged input, so that each message is whole or is told.
"""

from __future__ import annotations

import os
import struct
import weakref
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyarrow as pa

from wheelleg_exp.recording.checksum import xxh32

MAGIC = b"RRF2"
HEADER_SIZE = 12
SERIALIZER_AT, PROTOBUF = 9, 2  # the header's byte that says how messages are written, and how they are today
ROWS_LIMIT = 1 << 30  # bytes of one message when unpacked; what is larger is damaged or hostile

END, STORE_INFO, ROWS, BLUEPRINT_ACTIVATION = range(4)
RECORDING = 1  # the kind of a store; a blueprint is 2

_HEAD = struct.Struct("<QQ")
_FOOTER = struct.Struct("<QQI8sI")  # offset, length and checksum of the index, a mark, how many there are
_FOOTER_MARK = b"RRF2FOOT"
_CHECKSUM_SEED = 7850921
_KINDS = (b"control", b"index", b"data")
_TIMES = (pa.int64(), pa.duration("ns"), pa.timestamp("ns"))
_LZ4 = 2
_LZ4_BEST_RATIO = 255
_VARINT, _FIXED64, _BYTES, _FIXED32 = 0, 1, 2, 5


class DamagedMessageError(ValueError):
    """A message cannot be decoded."""


class File:
    """A file as far as it reached when it was opened; what is written later is not looked at.

    Args:
        path: the file.

    Raises:
        OSError: it cannot be opened.
    """

    def __init__(self, path: Path) -> None:
        self._descriptor = os.open(path, os.O_RDONLY)
        weakref.finalize(self, os.close, self._descriptor)
        self.size = os.fstat(self._descriptor).st_size

    def read(self, begin: int, end: int) -> bytes:
        """Return the bytes from ``begin`` to ``end``; fewer when the file was cut off meanwhile."""
        return os.pread(self._descriptor, end - begin, begin)


@dataclass(frozen=True, slots=True)
class Span:
    """Where a message stands.

    Attributes:
        kind: what it is.
        begin: offset of its head in the file, bytes.
        end: offset past its last byte.
    """

    kind: int
    begin: int
    end: int

    def payload(self, file: File) -> memoryview:
        """Return the bytes behind the head."""
        return memoryview(file.read(self.begin + _HEAD.size, self.end))


@dataclass(frozen=True, slots=True)
class Rows:
    """The rows of a message.

    Attributes:
        store: the kind of the store that they belong to (``RECORDING``) and its id.
        application: the application that the store says it is of.
        entity: path without a leading slash.
        batch: one column a timeline and component, whose kind stands in the fields' metadata.
    """

    store: tuple[int, str]
    application: str
    entity: str
    batch: pa.RecordBatch


def writer_version(head: bytes) -> tuple[int, int, int]:
    """Return the version of rerun that wrote a file with this header (major, minor, patch)."""
    return head[4], head[5], head[6]


def spans(file: File) -> Iterator[Span]:
    """Yield the messages that are whole, up to the first that is not."""
    begin = HEADER_SIZE
    while begin + _HEAD.size <= file.size:
        head = file.read(begin, begin + _HEAD.size)
        if len(head) < _HEAD.size:
            return
        kind, length = _HEAD.unpack(head)
        end = begin + _HEAD.size + length
        if kind > BLUEPRINT_ACTIVATION or end > file.size:
            return
        yield Span(kind, begin, end)
        begin = end


def is_closed(file: File, last: Span) -> bool:
    """Return whether the file ends as a closed one does: with an index, and where that stands."""
    if last.kind != END or file.size - last.end != _FOOTER.size:
        return False
    begin, length, _, mark, _ = _FOOTER.unpack(file.read(last.end, file.size))
    return bool(mark == _FOOTER_MARK and begin == last.begin + _HEAD.size and begin + length == last.end)


def index_holds(file: File, last: Span) -> bool:
    """Return whether the index of a closed file is as it was written."""
    _, _, checksum, _, _ = _FOOTER.unpack(file.read(last.end, file.size))
    return xxh32(bytes(last.payload(file)), _CHECKSUM_SEED) == checksum


def announced(payload: memoryview) -> tuple[int, str] | None:
    """Return the kind and id of the store that a message announces; None when it is damaged."""
    try:
        info = dict(_fields(dict(_fields(payload))[2]))
        return _store(dict(_fields(info[2])))
    except (DamagedMessageError, ValueError, LookupError, TypeError):
        return None


def decode_rows(payload: memoryview) -> Rows:
    """Return the rows in the payload of a message.

    Raises:
        DamagedMessageError: the payload is damaged, or larger than is read.
    """
    try:
        return _decode(payload)
    except DamagedMessageError:
        raise
    # Whatever damaged bytes make of protobuf, LZ4 or Arrow.
    except (pa.ArrowException, ValueError, LookupError, TypeError, OSError, MemoryError, OverflowError) as error:
        raise DamagedMessageError(_reason(error)) from error
    except StopIteration as error:
        raise DamagedMessageError("it holds no rows") from error


def _reason(error: Exception) -> str:
    if isinstance(error, LookupError):
        return f"it has no field {error}"
    return str(error).splitlines()[0] if str(error) else type(error).__name__


def _decode(payload: memoryview) -> Rows:
    fields = dict(_fields(payload))
    store = dict(_fields(fields[1]))
    batch = pa.ipc.open_stream(_unpacked(fields)).read_next_batch()
    batch.validate(full=True)
    entity = (batch.schema.metadata or {})[b"rerun:entity_path"].decode()
    for field in batch.schema:
        _require_known(field)
    application = bytes(dict(_fields(store[3]))[1]).decode() if 3 in store else ""
    return Rows(_store(store), application, entity.strip("/"), batch)


def _require_known(field: pa.Field) -> None:
    """Raise unless a column is of a kind that rerun writes; names are decoded only now."""
    kind = (field.metadata or {}).get(b"rerun:kind")
    if kind not in _KINDS or not field.name:
        raise DamagedMessageError("it has a column of an unknown kind")
    if kind == b"index" and field.type not in _TIMES:
        raise DamagedMessageError("it has a timeline of an unknown type")


def _store(fields: dict[int, Any]) -> tuple[int, str]:
    return int(fields[1]), bytes(fields[2]).decode()


def _unpacked(fields: dict[int, int | memoryview]) -> pa.Buffer:
    packed, size = fields[5], fields.get(3, 0)
    if fields.get(2) != _LZ4:
        return pa.py_buffer(packed)
    if not isinstance(size, int) or size > min(ROWS_LIMIT, _LZ4_BEST_RATIO * len(packed) + 64):  # type: ignore[arg-type]
        raise DamagedMessageError("it would be larger than is possible when unpacked")
    return pa.Codec("lz4_raw").decompress(packed, decompressed_size=size)


def _fields(data: int | memoryview) -> Iterator[tuple[int, int | memoryview]]:
    """Yield number and value of the fields of a protobuf message; the later of two counts."""
    if isinstance(data, int):
        raise DamagedMessageError("a number stands where a message was expected")
    place = 0
    while place < len(data):
        key, place = _varint(data, place)
        kind = key & 7
        value: int | memoryview
        if kind == _VARINT:
            value, place = _varint(data, place)
        else:
            size, place = _varint(data, place) if kind == _BYTES else ({_FIXED64: 8, _FIXED32: 4}[kind], place)
            if place + size > len(data):
                raise DamagedMessageError("a field is longer than its message")
            value, place = data[place : place + size], place + size
        yield key >> 3, value


def _varint(data: memoryview, place: int) -> tuple[int, int]:
    value = 0
    for shift in range(0, 70, 7):
        byte = data[place]
        place += 1
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value, place
    raise DamagedMessageError("a number has too many bytes")
