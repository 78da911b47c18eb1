"""Read and write the messages of an rrd file, the format of Rerun recordings.

An rrd file consists of a header of 12 bytes and messages: kind (u64), length of the content in bytes (u64), and
content, which Rerun's SDK encodes and decodes. A closed file ends with an index message, and 32 bytes with its
position. New messages go to a temporary file and are then appended, without their index. Measured with Rerun 0.41:

- The file stream of Rerun's SDK leaves two threads and about 1 MB in the process for ever, and does not return if the
  disk is full. ``write_rrd`` leaves no threads, raises an error if the disk is full, and writes 16 rows of 60 entities
  in 9 ms.
- The reader of Rerun's SDK raises an error for a truncated file. It terminated the process for 4 of 300 damaged files
  without an index, and for none of 400 with one. So Rerun's own program first rewrites recordings without an index.
"""

from __future__ import annotations

import os
import struct
import tempfile
import weakref
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from rerun.chunk import Chunk

MAGIC = b"RRF2"
HEADER_SIZE = 12
SERIALIZER_AT, PROTOBUF = 9, 2  # Byte 9 of an rrd file states the message encoding; the value 2 means protobuf.
INDEX, STORE_INFO, ROWS, BLUEPRINT_ACTIVATION = range(4)
APPLICATION = "wheelleg"

_HEAD = struct.Struct("<QQ")
_FOOTER_SIZE, _FOOTER_MARK = 32, b"RRF2FOOT"


class Message(NamedTuple):
    """A whole message of an rrd file: its kind, and its first byte and end byte in the file."""

    kind: int
    begin: int
    end: int


class RrdFile:
    """Reads an rrd file that can grow; bytes that are added after opening are ignored until ``refresh`` is called."""

    def __init__(self, path: Path) -> None:
        self._descriptor = os.open(path, os.O_RDONLY)
        weakref.finalize(self, os.close, self._descriptor)
        self.size = os.fstat(self._descriptor).st_size

    def refresh(self) -> None:
        """Read the current size of the rrd file, because another process can append to this file."""
        self.size = os.fstat(self._descriptor).st_size

    def read(self, begin: int, end: int) -> bytes:
        """Return the file's bytes from ``begin`` to ``end``; return fewer bytes if the file is shorter."""
        return os.pread(self._descriptor, end - begin, begin)

    @property
    def header(self) -> bytes:
        return self.read(0, HEADER_SIZE)

    def messages(self, begin: int = HEADER_SIZE) -> Iterator[Message]:
        """Yield complete messages from the offset ``begin`` on, up to the index or up to an incomplete message."""
        while begin + _HEAD.size <= self.size:
            head = self.read(begin, begin + _HEAD.size)
            if len(head) < _HEAD.size:
                return
            kind, length = _HEAD.unpack(head)
            end = begin + _HEAD.size + length
            if kind > BLUEPRINT_ACTIVATION or end > self.size:
                return
            yield Message(kind, begin, end)
            if kind == INDEX:
                return
            begin = end

    def is_closed(self, last: Message | None) -> bool:
        """Return whether the rrd file ends with an index. ``last`` is the last complete message of the rrd file."""
        if last is None or last.kind != INDEX or self.size - last.end != _FOOTER_SIZE:
            return False
        return _FOOTER_MARK in self.read(last.end, self.size)

    def is_followed_by_damage(self, last: Message | None) -> bool:
        """Return whether damaged bytes, which cannot start a message, follow the last complete message."""
        begin = HEADER_SIZE if last is None else last.end
        rest = self.read(begin, begin + _FOOTER_SIZE + 1)
        if last is not None and last.kind == INDEX:
            return len(rest) > _FOOTER_SIZE
        return len(rest) >= 8 and int.from_bytes(rest[:8], "little") > BLUEPRINT_ACTIVATION

    def body(self, begin: int = HEADER_SIZE) -> Iterator[bytes]:
        """Yield the bytes of each complete message from the file offset ``begin`` on, except the index."""
        for message in self.messages(begin):
            if message.kind != INDEX:
                yield self.read(message.begin, message.end)


def chunk_file(chunks: Iterable[Chunk], recording_id: str) -> RrdFile:
    """Return a temporary rrd file with data chunks of one recording. Raise OSError if it cannot be written."""
    from rerun.chunk import LazyChunkStream

    stream = LazyChunkStream.from_iter(chunks)
    try:
        return temporary_file(
            lambda path: stream.write_rrd(path, application_id=APPLICATION, recording_id=recording_id)
        )
    except RuntimeError as error:
        raise OSError(str(error)) from error


def temporary_file(write: Callable[[str], None]) -> RrdFile:
    """Return a temporary rrd file that the function ``write`` writes."""
    with tempfile.TemporaryFile() as file:
        path = f"/dev/fd/{file.fileno()}"
        write(path)
        return RrdFile(Path(path))
