"""The rows of a recording's file by entity, and how much of the file can be read."""

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
from typing import TYPE_CHECKING, Any

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
    """How much of a recording's file can be read.

    Attributes:
        size: bytes of the file.
        readable: bytes from the start of the file to the end of the last whole message.
        messages: number of whole messages.
        is_closed: whether the writer closed the file, which leaves an index at its end.
        damaged: number of whole messages that cannot be read.
        writer: version of rerun that wrote the file.
    """

    size: int
    readable: int
    messages: int
    is_closed: bool
    damaged: int
    writer: str

    @property
    def is_whole(self) -> bool:
        """Whether nothing is missing and nothing is damaged."""
        return self.is_closed and not self.damaged

    def lines(self) -> list[str]:
        """Return sentences for people; the first one is the verdict."""
        return ["whole" if self.is_whole else "not whole", *self._problems()]

    def as_dict(self) -> dict[str, Any]:
        """Return all values as a plain mapping."""
        return {"is_whole": self.is_whole, **asdict(self), "lost": self.size - self.readable}

    def _problems(self) -> Iterator[str]:
        if self.readable < self.size and not self.is_closed:
            yield f"cut off at byte {self.readable} of {self.size}: no whole message follows"
        elif not self.is_closed:
            yield "not closed: it is still being written, or its writer was killed"
        if self.damaged:
            yield f"{self.damaged} of {self.messages} messages are damaged, and are left out"


@dataclass(frozen=True, slots=True)
class Piece:
    """The rows of one message.

    Attributes:
        batch: one column for each timeline and component; the metadata of a column's field says which of both it is.
        is_static: whether the rows hold at all times.
    """

    batch: pa.RecordBatch
    is_static: bool

    @property
    def names(self) -> list[str]:
        """The names of the timelines and components."""
        return [field.name for field in self.batch.schema if is_index(field) or is_component(field)]


class Contents:
    """The rows of a recording by entity.

    The file is read once, as far as it was whole when it was opened.

    Args:
        path: the file.
        recording_id: the recording, if the file contains several.

    Attributes:
        recording_id: the recording's id.
        health: how much of the file can be read.
        pieces: the rows of each message, by entity.

    Raises:
        RunDirectoryError: the file is missing, is not a recording, or contains none or several.
    """

    def __init__(self, path: Path, recording_id: str | None = None) -> None:
        self._path = path
        file = _opened(path)
        messages = list(file.messages())
        last = messages[-1] if messages else None
        readable, is_closed = HEADER_SIZE if last is None else last.end, file.is_closed(last)
        stores, unreadable = (_stores(path) if is_closed else None), 0
        if stores is None:
            stores, unreadable = _salvaged(file, path)
        self.health = Health(
            size=file.size,
            readable=file.size if is_closed else readable,
            messages=len(messages),
            is_closed=is_closed,
            damaged=unreadable + file.is_followed_by_damage(last),
            writer=_writer(file.header),
        )
        self.recording_id = self._chosen(stores, recording_id)
        self.pieces: Mapping[str, list[Piece]] = defaultdict(list)
        for chunk in stores["recording", self.recording_id]:
            self.pieces[chunk.entity_path.strip("/")].append(Piece(chunk.to_record_batch(), chunk.is_static))

    @cached_property
    def reach(self) -> dict[str, tuple[int, int]]:
        """The first and last value of each timeline; those of ``sim_time`` in ns."""
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
        """Yield the timelines and components of an entity, each of the type that its name implies."""
        return map(known_columns, self.batches(entity, static=static))

    def batches(self, entity: str, *, static: bool) -> Iterator[pa.RecordBatch]:
        """Yield the rows of an entity as they were written, in the order of the file."""
        return (piece.batch for piece in self.pieces.get(entity, ()) if piece.is_static == static)

    def _chosen(self, stores: Mapping[tuple[str, str], list[Chunk]], wanted: str | None) -> str:
        names = sorted(name for kind, name in stores if kind == "recording")
        if wanted in names or (wanted is None and len(names) == 1):
            return wanted or names[0]
        if not names:
            expected = "a recording that has started"
            raise RunDirectoryError(f"'{self._path}' contains no rows ({self.health.size} bytes)", expected=expected)
        if wanted is None:
            what, which = f"contains {len(names)} recordings", "one; choose it by its id (--id): "
        else:
            what, which = f"contains no recording '{wanted}'", "one of "
        raise RunDirectoryError(f"'{self._path}' {what}", expected=which + ", ".join(names))


def columns(batch: pa.RecordBatch) -> pa.Table:
    """Return the timelines and components of rows as a table, by short names."""
    chosen = [i for i, field in enumerate(batch.schema) if field.name in TIMELINES or is_component(field)]
    names = [short_name(batch.schema.field(i).name) for i in chosen]
    return pa.table([batch.column(i) for i in chosen], names=names)


def latest(batches: Iterable[pa.RecordBatch]) -> dict[str, pa.Array]:
    """Return the last row of each component by its short name."""
    found: dict[str, pa.Array] = {}
    for batch in batches:
        for field, array in zip(batch.schema, batch.columns, strict=True):
            if is_component(field) and len(batch):
                found[short_name(field.name)] = array[-1:]
    return found


@contextmanager
def closed_copy(path: Path) -> Iterator[tuple[Path, int]]:
    """Yield a temporary, closed copy of a cut off or damaged file, and the number of unreadable messages.

    rerun's own program writes the copy, because a damaged message can terminate the process that decodes it.

    Raises:
        RunDirectoryError: no message can be read.
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
        # The copy also lacks static rows that later rows replace, so the rows themselves cannot be counted.
        yield closed, sum("couldn't decode message" in line for line in log)


def _salvaged(file: RrdFile, path: Path) -> tuple[dict[tuple[str, str], list[Chunk]], int]:
    if next(file.messages(), None) is None:
        return {}, 0
    with closed_copy(path) as (closed, unreadable):
        stores = _stores(closed)
    if stores is None:
        raise _unreadable(path, "no message can be read")
    return stores, unreadable


def _stores(path: Path) -> dict[tuple[str, str], list[Chunk]] | None:
    """Return the chunks of a closed file by the kind and the id of their store; None when the file is damaged."""
    from rerun.chunk import RrdReader  # importing rerun takes 0.25 s

    try:
        reader = RrdReader(path)
        entries = [*reader.recordings(), *reader.blueprints()]
        return {(entry.kind, entry.recording_id): reader.stream(store=entry).to_chunks() for entry in entries}
    except ValueError:  # the file contains no store
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
    _require_readable(path, file.header)
    return file


def _require_readable(path: Path, head: bytes) -> None:
    if not head:
        raise RunDirectoryError(f"the recording '{path}' is empty", expected="a rerun recording")
    if head[:3] != MAGIC[:3]:
        raise RunDirectoryError(f"'{path}' is not a rerun recording", expected="a file that starts with 'RRF2'")
    if head[:4] != MAGIC:
        form = head[:4].decode("latin-1")
        raise RunDirectoryError(
            f"the recording '{path}' has another format ({form!r})", expected="'RRF2', which rerun writes since 0.23"
        )
    if len(head) < HEADER_SIZE:
        raise RunDirectoryError(f"the recording '{path}' is cut off in its header", expected="a whole recording")
    if head[SERIALIZER_AT] != PROTOBUF:
        raise RunDirectoryError(
            f"the recording '{path}' was written by rerun {_writer(head)}, in a format that is no longer supported",
            expected="a recording of rerun 0.23 or later",
        )


def _writer(head: bytes) -> str:
    """Return the version of rerun that wrote a file with this header."""
    return ".".join(map(str, head[4:7]))


def _unreadable(path: Path, reason: str) -> RunDirectoryError:
    writer, known = _writer(_opened(path).header), version("rerun-sdk")
    message = f"the recording '{path}' cannot be read: {reason}"
    if known.split(".")[:2] == writer.split(".")[:2]:
        return RunDirectoryError(message, expected="a recording that is not damaged")
    return RunDirectoryError(
        f"{message}; it was written by rerun {writer}",
        expected=f"a recording of rerun {known}, to which 'rerun rrd migrate' may convert it",
    )
