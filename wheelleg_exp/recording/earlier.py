"""What an earlier recording keeps when a run goes on from a checkpoint."""

from __future__ import annotations

import struct
import tempfile
import warnings
from collections.abc import Iterator
from pathlib import Path

import pyarrow.compute as pc
from rerun.chunk import Chunk, RrdReader

from wheelleg_exp.errors import RunDirectoryError
from wheelleg_exp.recording.layout import DOCUMENTS, STEP

_FILE_HEADER, _MESSAGE_HEADER = 12, struct.Struct("<QQ")


def open_reader(path: Path) -> RrdReader:
    """Return a reader; a file whose writer was killed has no footer, which is no reason to warn."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return RrdReader(path)


def kept_chunks(path: Path, until_step: int) -> Iterator[Chunk]:
    """Yield the rows up to and including ``until_step``, and the texts.

    A last message that was cut off by a crash is left out.

    Raises:
        RunDirectoryError: the file is no recording.
    """
    try:
        with tempfile.TemporaryDirectory() as folder:
            whole = Path(folder) / "whole.rrd"
            whole.write_bytes(whole_messages(path.read_bytes()))
            for chunk in open_reader(whole).stream():
                yield from _kept(chunk, until_step)
    except (RuntimeError, ValueError, OSError) as error:
        raise RunDirectoryError(
            f"cannot go on with the recording '{path}': {str(error).splitlines()[0]}",
            expected="a recording, or no file at this place",
        ) from error


def whole_messages(data: bytes) -> bytes:
    """Return the head of an rrd file that ends with its last whole message.

    The file is a header of 12 bytes and messages of a kind (u64), a length (u64) and that many bytes.
    """
    end = _FILE_HEADER
    while end + _MESSAGE_HEADER.size <= len(data):
        _, length = _MESSAGE_HEADER.unpack_from(data, end)
        if end + _MESSAGE_HEADER.size + length > len(data):
            break
        end += _MESSAGE_HEADER.size + length
    return data[:end]


def _kept(chunk: Chunk, until_step: int) -> Iterator[Chunk]:
    entity = chunk.entity_path.strip("/")
    if chunk.is_static:
        if entity.startswith(f"{DOCUMENTS}/"):
            yield chunk
        return
    batch = chunk.to_record_batch()
    rows = batch.filter(pc.less_equal(batch.column(STEP), until_step))
    if len(rows):
        yield from Chunk.from_record_batch(rows)
