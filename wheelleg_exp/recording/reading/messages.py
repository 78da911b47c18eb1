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
from xxhash import xxh32_intdigest

from wheelleg_exp.recording.reading.arrow_values import nested_types, values_in

MAGIC = b"RRF2"
HEADER_SIZE = 12
SERIALIZER_AT, PROTOBUF = 9, 2  # the header's byte that says how messages are written, and how they are today
# Bytes of one message, packed or not; what is larger, or much larger unpacked than packed, is damaged or hostile.
MESSAGE_LIMIT, _SMALL, _USUAL_RATIO = 1 << 29, 1 << 26, 8
PATH_LIMIT = 4096  # letters of an entity's path

END, STORE_INFO, ROWS, BLUEPRINT_ACTIVATION = range(4)
RECORDING, BLUEPRINT = 1, 2  # kinds of stores
LZ4 = 2  # how rows are packed

HEAD = struct.Struct("<QQ")  # kind and length of a message
_FOOTER = struct.Struct("<QQI8sI")  # offset, length and checksum of the index, a mark, how many there are
_FOOTER_MARK = b"RRF2FOOT"
FOOTER_SIZE = _FOOTER.size
_CHECKSUM_SEED = 7850921
_KINDS = (b"control", b"index", b"data")
_TIMES = (pa.int64(), pa.duration("ns"), pa.timestamp("ns"))
# Types whose values share bytes, so that few of these are a flood of those.
_ALIASES = (
    pa.types.is_dictionary,
    pa.types.is_run_end_encoded,
    pa.types.is_list_view,
    pa.types.is_large_list_view,
    pa.types.is_string_view,
    pa.types.is_binary_view,
)
_VALUES_IN_A_BYTE = 8
_HEADER, _COMPRESSION = 2, 3  # fields of Arrow's Message and RecordBatch
_VARINT, _FIXED64, _BYTES, _FIXED32 = 0, 1, 2, 5
# Whatever damaged bytes make of protobuf, LZ4 or Arrow.
_BROKEN = (
    pa.ArrowException,
    ValueError,
    LookupError,
    TypeError,
    OSError,
    MemoryError,
    OverflowError,
    RecursionError,
    struct.error,
)


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
        """Return the bytes behind the head.

        Raises:
            DamagedMessageError: it is larger than is read: a file may have holes that take no room.
        """
        if self.end - self.begin > MESSAGE_LIMIT:
            raise DamagedMessageError(f"it has more than {MESSAGE_LIMIT >> 20} MiB")
        return memoryview(file.read(self.begin + HEAD.size, self.end))


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
    while begin + HEAD.size <= file.size:
        head = file.read(begin, begin + HEAD.size)
        if len(head) < HEAD.size:
            return
        kind, length = HEAD.unpack(head)
        end = begin + HEAD.size + length
        if kind > BLUEPRINT_ACTIVATION or end > file.size:
            return
        yield Span(kind, begin, end)
        begin = end


def is_closed(file: File, last: Span) -> bool:
    """Return whether the file ends as a closed one does: with an index, and where that stands."""
    if last.kind != END or file.size - last.end != _FOOTER.size:
        return False
    begin, length, _, mark, _ = _FOOTER.unpack(file.read(last.end, file.size))
    return bool(mark == _FOOTER_MARK and begin == last.begin + HEAD.size and begin + length == last.end)


def index_holds(file: File, last: Span) -> bool:
    """Return whether the index of a closed file is as it was written."""
    _, _, checksum, _, _ = _FOOTER.unpack(file.read(last.end, file.size))
    return last.end - last.begin < MESSAGE_LIMIT and xxh32_intdigest(last.payload(file), _CHECKSUM_SEED) == checksum


def announced(file: File, span: Span) -> tuple[int, str] | None:
    """Return the kind and id of the store that a message announces; None when it is damaged."""
    try:
        info = dict(_fields(dict(_fields(span.payload(file)))[2]))
        return _store(dict(_fields(info[2])))
    except _BROKEN:
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
    except _BROKEN as error:
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
    content = _unpacked(fields)
    _require_unpacked(content)
    stream = pa.ipc.open_stream(content)
    for field in stream.schema:
        _require_known(field)
    batch = stream.read_next_batch()
    batch.validate(full=True)
    entity = (batch.schema.metadata or {})[b"rerun:entity_path"].decode()
    if len(entity) > PATH_LIMIT:
        raise DamagedMessageError(f"its path has more than {PATH_LIMIT} letters")
    if sum(map(values_in, batch.columns)) > _VALUES_IN_A_BYTE * content.size:
        raise DamagedMessageError("it claims more values than its bytes can hold")
    application = bytes(dict(_fields(store[3]))[1]).decode() if 3 in store else ""
    return Rows(_store(store), application, entity.strip("/"), batch)


def _require_known(field: pa.Field) -> None:
    """Raise unless a column is of a kind that rerun writes; names are decoded only now."""
    kind = (field.metadata or {}).get(b"rerun:kind")
    if kind not in _KINDS or not field.name:
        raise DamagedMessageError("it has a column of an unknown kind")
    if kind == b"index" and field.type not in _TIMES:
        raise DamagedMessageError("it has a timeline of an unknown type")
    if any(is_alias(found) for found in nested_types(field.type) for is_alias in _ALIASES):
        raise DamagedMessageError(f"it has a column of {field.type}, which rerun never writes")


def _store(fields: dict[int, Any]) -> tuple[int, str]:
    return int(fields[1]), bytes(fields[2]).decode()


def _unpacked(fields: dict[int, int | memoryview]) -> pa.Buffer:
    packed, size = fields[5], fields.get(3, 0)
    if fields.get(2) != LZ4:
        return pa.py_buffer(packed)
    limit = min(MESSAGE_LIMIT, max(_SMALL, _USUAL_RATIO * len(packed)))  # type: ignore[arg-type]
    if not isinstance(size, int) or size > limit:
        raise DamagedMessageError("it would be larger when unpacked than rows ever are")
    return pa.Codec("lz4_raw").decompress(packed, decompressed_size=size)


def _require_unpacked(content: pa.Buffer) -> None:
    """Raise unless Arrow takes the buffers as they are; rerun's never are packed, and a few bytes may be a flood."""
    for message in pa.ipc.MessageReader.open_stream(content):
        if message.type == "record batch" and _has_compression(memoryview(message.metadata)):
            raise DamagedMessageError("its buffers are packed, which rerun's never are")


def _has_compression(message: memoryview) -> bool:
    """Return whether the header of an Arrow message, a flatbuffer, says that its buffers are compressed."""
    root = struct.unpack_from("<I", message)[0]
    place = _slot(message, root, _HEADER)
    batch = place + struct.unpack_from("<I", message, place)[0]
    return _slot(message, batch, _COMPRESSION) != batch


def _slot(buffer: memoryview, table: int, field: int) -> int:
    """Return where a field of a flatbuffer's table stands; the table's own place when it has no such field."""
    offsets = table - struct.unpack_from("<i", buffer, table)[0]
    size = struct.unpack_from("<H", buffer, offsets)[0]
    return table + (struct.unpack_from("<H", buffer, offsets + 4 + 2 * field)[0] if 4 + 2 * field < size else 0)


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
