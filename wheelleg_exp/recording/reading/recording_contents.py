"""Read the rows of each Rerun entity from a recording's file, and check how much of this file is readable."""

from __future__ import annotations

import stat
import tempfile
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from functools import cached_property
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pyarrow as pa

from wheelleg_exp.errors import RunDirectoryError
from wheelleg_exp.files import for_people
from wheelleg_exp.recording.reading.arrow_values import TIMELINES, is_component, is_index, known_columns, short_name
from wheelleg_exp.recording.rerun_program import run_rerun
from wheelleg_exp.recording.rrd_file import HEADER_SIZE, MAGIC, PROTOBUF, SERIALIZER_AT, RrdFile

if TYPE_CHECKING:
    from rerun.chunk import Chunk


@dataclass(frozen=True)
class Health:
    """The health of a recording's file: how much of the file is readable.

    ``readable`` counts the bytes up to the end of the last complete message. ``is_closed`` means that an index exists.
    ``damaged`` counts complete messages that cannot be decoded. ``writer`` is the version of Rerun.
    """

    size: int
    readable: int
    messages: int
    is_closed: bool
    damaged: int
    writer: str

    @property
    def is_whole(self) -> bool:
        """Whether a recording's file is closed and contains no damaged message."""
        return self.is_closed and not self.damaged

    def lines(self) -> list[str]:
        """Return lines for the user about the state of a recording's file; the first line is a summary."""
        found = ["whole" if self.is_whole else "not whole"]
        if self.readable < self.size and not self.is_closed:
            found.append(f"cut off at byte {self.readable} of {self.size}: no whole message follows")
        elif not self.is_closed:
            found.append("not closed: it is still being written, or its writer was killed")
        if self.damaged:
            found.append(f"{self.damaged} of {self.messages} messages are damaged, and are left out")
        return found

    def as_dict(self) -> dict[str, object]:
        return {"is_whole": self.is_whole, **asdict(self), "lost": self.size - self.readable}


@dataclass(frozen=True, slots=True)
class Piece:
    """The rows of one rrd message, which contains either static data or data over time."""

    batch: pa.RecordBatch
    is_static: bool

    @property
    def names(self) -> list[str]:
        """The names of an rrd message's columns with times (timelines) and with data (components)."""
        return [field.name for field in self.batch.schema if is_index(field) or is_component(field)]


class Contents:
    """The rows of a recording. ``pieces`` maps the path of each Rerun entity to its rows, one ``Piece`` per message.

    A missing or foreign file raises RunDirectoryError. ``recording_id`` must select one of several recordings. Rerun's
    program first copies a modified file (``is_changed``), because decoding it can crash this process.
    """

    def __init__(self, path: Path, recording_id: str | None = None, *, is_changed: bool = False) -> None:
        self._path = path
        file = _opened(path)
        messages = list(file.messages())
        last = messages[-1] if messages else None
        readable, is_closed = HEADER_SIZE if last is None else last.end, file.is_closed(last)
        stores, unreadable = (_stores(path) if is_closed and not is_changed else None if messages else {}), 0
        if stores is None:
            with closed_copy(path) as (closed, unreadable):
                stores = _stores(closed)
            if stores is None:
                raise _unreadable(path, "no message can be read")
        readable, damaged = file.size if is_closed else readable, unreadable + file.is_followed_by_damage(last)
        self.health = Health(file.size, readable, len(messages), is_closed, damaged, _writer(file.header))
        self.recording_id = self._chosen(stores, recording_id)
        self.pieces: Mapping[str, list[Piece]] = defaultdict(list)
        for chunk in stores["recording", self.recording_id]:
            self.pieces[chunk.entity_path.strip("/")].append(Piece(chunk.to_record_batch(), chunk.is_static))

    @cached_property
    def reach(self) -> dict[str, tuple[int, int]]:
        """Maps the name of each timeline, such as ``step``, to its first and last value; ``sim_time`` is in ns."""
        found: dict[str, tuple[int, int]] = {}
        for batch in (piece.batch for pieces in self.pieces.values() for piece in pieces if not piece.is_static):
            for name in TIMELINES:
                if name not in batch.schema.names:
                    continue
                times = np.asarray(batch.column(name).drop_null().view(pa.int64()))
                if len(times):
                    ends = [*found.get(name, ()), int(times.min()), int(times.max())]
                    found[name] = (min(ends), max(ends))
        return found

    def rows(self, entity: str, *, static: bool) -> Iterator[pa.RecordBatch]:
        """Yield the rows of one Rerun entity; ``known_columns`` converts each column to the expected Arrow type."""
        return map(known_columns, self.batches(entity, static=static))

    def batches(self, entity: str, *, static: bool) -> Iterator[pa.RecordBatch]:
        """Yield a Rerun entity's rows as they are stored: in file order, and with their original Arrow types."""
        return (piece.batch for piece in self.pieces.get(entity, ()) if piece.is_static == static)

    def _chosen(self, stores: Mapping[tuple[str, str], list[Chunk]], wanted: str | None) -> str:
        names = sorted(name for kind, name in stores if kind == "recording")
        if wanted in names or (wanted is None and len(names) == 1):
            return wanted or names[0]
        if not names:
            expected = "a recording that has started"
            raise RunDirectoryError(f"'{self._path}' contains no rows ({self.health.size} bytes)", expected=expected)
        if wanted is not None:
            message = f"'{self._path}' contains no recording '{wanted}'"
            raise RunDirectoryError(message, expected="one of " + ", ".join(names))
        expected = "one; choose it by its id (--id): " + ", ".join(names)
        raise RunDirectoryError(f"'{self._path}' contains {len(names)} recordings", expected=expected)


def columns(batch: pa.RecordBatch) -> pa.Table:
    """Return a record batch's timelines and components as a table with short column names such as ``scalars``."""
    chosen = [i for i, field in enumerate(batch.schema) if field.name in TIMELINES or is_component(field)]
    names = [short_name(batch.schema.field(i).name) for i in chosen]
    return pa.table([batch.column(i) for i in chosen], names=names)


def latest(batches: Iterable[pa.RecordBatch]) -> dict[str, pa.Array]:
    """Return the last recorded value of each Rerun component, by its short name such as ``translation``."""
    found: dict[str, pa.Array] = {}
    for batch in batches:
        for field, array in zip(batch.schema, batch.columns, strict=True):
            if is_component(field) and len(batch):
                found[short_name(field.name)] = array[-1:]
    return found


@contextmanager
def closed_copy(path: Path) -> Iterator[tuple[Path, int]]:
    """Yield a temporary readable copy of a truncated or damaged recording, and the number of unreadable messages.

    Rerun's own program writes the copy, because a damaged message can terminate the process that decodes it. If it
    cannot write the copy, ``closed_copy`` raises RunDirectoryError.
    """
    with tempfile.TemporaryDirectory(prefix="wheelleg-recording-") as folder:
        trimmed, closed = Path(folder) / "trimmed.rrd", Path(folder) / "closed.rrd"
        file = _opened(path)
        with for_people(trimmed), trimmed.open("wb") as target:
            target.write(file.header)
            target.writelines(file.body())
        problem, log = run_rerun("merge", "--continue-on-error", str(trimmed), "-o", str(closed))
        if problem is not None or not closed.exists():
            raise _unreadable(path, problem or "rerun wrote nothing")
        # Count damaged messages in Rerun's log, because the copy can also lack messages that are not damaged.
        yield closed, sum("couldn't decode message" in line for line in log)


def _stores(path: Path) -> dict[tuple[str, str], list[Chunk]] | None:
    """Return the data chunks of each Rerun store in a closed rrd file, by kind and id; None for a damaged file."""
    from rerun.chunk import RrdReader  # Import Rerun only here, because the import takes 0.25 s.

    try:
        reader = RrdReader(path)
        entries = [*reader.recordings(), *reader.blueprints()]
        return {(entry.kind, entry.recording_id): reader.stream(store=entry).to_chunks() for entry in entries}
    except ValueError:  # Rerun raises ValueError for a file that contains neither a recording nor a blueprint.
        return {}
    except RuntimeError:
        return None


def _opened(path: Path) -> RrdFile:
    if path.is_dir():
        raise RunDirectoryError(f"'{path}' is a folder", expected="a recording, a file that ends with .rrd")
    with for_people(path, "read"):
        if not stat.S_ISREG(path.stat().st_mode):
            raise RunDirectoryError(f"'{path}' is not a regular file", expected="a recording, a file named *.rrd")
        file = RrdFile(path)
    head = file.header
    if not head:
        raise RunDirectoryError(f"the recording '{path}' is empty", expected="a Rerun recording")
    if head[:3] != MAGIC[:3]:
        raise RunDirectoryError(f"'{path}' is not a Rerun recording", expected="a file that starts with 'RRF2'")
    if head[:4] != MAGIC:
        message = f"the recording '{path}' has another format ({head[:4].decode('latin-1')!r})"
        raise RunDirectoryError(message, expected="'RRF2', which Rerun writes since 0.23")
    if len(head) < HEADER_SIZE:
        raise RunDirectoryError(f"the recording '{path}' has an incomplete header", expected="a whole recording")
    if head[SERIALIZER_AT] != PROTOBUF:
        old = f"the recording '{path}' was written by Rerun {_writer(head)}, in a format that is no longer supported"
        raise RunDirectoryError(old, expected="a recording of Rerun 0.23 or later")
    return file


def _writer(head: bytes) -> str:
    return ".".join(map(str, head[4:7]))


def _unreadable(path: Path, reason: str) -> RunDirectoryError:
    writer, known = _writer(_opened(path).header), version("rerun-sdk")
    message = f"the recording '{path}' cannot be read: {reason}"
    if known.split(".")[:2] == writer.split(".")[:2]:
        return RunDirectoryError(message, expected="a recording that is not damaged")
    expected = f"a recording of Rerun {known}, to which 'rerun rrd migrate' may convert it"
    return RunDirectoryError(f"{message}; it was written by Rerun {writer}", expected=expected)
