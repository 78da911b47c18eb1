"""The messages of a recording's file by entity, and how much of the file can be read."""

from __future__ import annotations

import stat
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass
from functools import cached_property
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from wheelleg_exp.errors import RunDirectoryError
from wheelleg_exp.files import for_people
from wheelleg_exp.recording.reading import messages
from wheelleg_exp.recording.reading.arrow_values import TIMELINES, is_component, is_index, known_columns, short_name
from wheelleg_exp.recording.reading.messages import DamagedMessageError, File, Rows, Span


@dataclass(frozen=True)
class Damage:
    """A message that cannot be read.

    Attributes:
        begin, end: where it stands in the file, bytes.
        reason: what is wrong with it.
    """

    begin: int
    end: int
    reason: str


@dataclass(frozen=True)
class Health:
    """How whole a recording's file is.

    Attributes:
        size: bytes of the file.
        readable: bytes from its beginning to the end of the last whole message.
        messages: how many whole messages there are.
        is_closed: whether its writer closed it, which leaves an index at its end.
        damaged: messages that are left out because they cannot be read.
        writer: version of rerun that wrote it.
    """

    size: int
    readable: int
    messages: int
    is_closed: bool
    damaged: tuple[Damage, ...]
    writer: str

    @property
    def is_whole(self) -> bool:
        """Whether nothing is missing and nothing damaged."""
        return self.is_closed and not self.damaged

    @property
    def lost(self) -> int:
        """Bytes of the file that hold nothing that can be read."""
        return self.size - self.readable + sum(damage.end - damage.begin for damage in self.damaged)

    def lines(self) -> list[str]:
        """Return sentences for people, the verdict first."""
        return ["whole" if self.is_whole else "not whole", *self._troubles()]

    def as_dict(self) -> dict[str, Any]:
        """Return all of it as a plain mapping."""
        return {"is_whole": self.is_whole, **asdict(self), "lost": self.lost}

    def _troubles(self) -> Iterator[str]:
        if self.readable < self.size:
            yield f"cut off at byte {self.readable} of {self.size}: what follows is no whole message"
        elif not self.is_closed:
            yield "not closed: it is still being written, or its writer was killed"
        for damage in self.damaged[:3]:
            yield f"damaged from byte {damage.begin} to {damage.end}: {damage.reason}"
        if len(self.damaged) > 3:
            yield f"{len(self.damaged) - 3} more damaged messages"


@dataclass(frozen=True, slots=True)
class Piece:
    """One message's rows.

    Attributes:
        span: where they stand.
        count: how many there are.
        is_static: whether they hold at all times.
        columns: names of their timelines and components.
    """

    span: Span
    count: int
    is_static: bool
    columns: tuple[str, ...]


class Contents:
    """The messages of a file, indexed by entity; rows are decoded again whenever they are asked for.

    A file that is still being written is read as far as it was whole when it was opened.

    Args:
        path: the file.
        recording_id: which recording of a file that holds several.

    Attributes:
        recording_id: the recording's id.
        application: the application that it says it is of.
        reach: the first and last value of each timeline; of ``sim_time`` in ns.
        pieces: the messages with rows by entity.

    Raises:
        RunDirectoryError: the file is missing, no recording, or holds none or several.
    """

    def __init__(self, path: Path, recording_id: str | None = None) -> None:
        self._path = path
        self._file = _opened(path)
        self._columns: dict[tuple[str, ...], tuple[str, ...]] = {}
        self.application = ""
        self._announced: set[tuple[int, str] | None] = set()
        self._reach: dict[str, dict[str, tuple[int, int]]] = {}
        self._stores: dict[str, dict[str, list[Piece]]] = {}
        self._damaged: list[Damage] = []
        self._last: Span | None = None
        self._count = 0
        self._index()
        self.recording_id = self._chosen(recording_id)
        self.reach: Mapping[str, tuple[int, int]] = self._reach.get(self.recording_id, {})
        self.pieces: Mapping[str, list[Piece]] = self._stores[self.recording_id]

    @cached_property
    def health(self) -> Health:
        """How whole the file is."""
        last = self._last
        closed = last is not None and messages.is_closed(self._file, last)
        damaged = list(self._damaged)
        if closed and last is not None and not messages.index_holds(self._file, last):
            damaged.append(Damage(last.begin, last.end, "the index at the end was changed"))
        readable = messages.HEADER_SIZE if last is None else last.end
        return Health(
            size=self._file.size,
            readable=self._file.size if closed else readable,
            messages=self._count,
            is_closed=closed,
            damaged=tuple(damaged),
            writer=".".join(map(str, messages.writer_version(self._file.read(0, messages.HEADER_SIZE)))),
        )

    def rows(self, entity: str, *, static: bool) -> Iterator[pa.RecordBatch]:
        """Yield the timelines and components of an entity, of the kinds that their names mean, in the file's order."""
        return map(known_columns, self.batches(entity, static=static))

    def batches(self, entity: str, *, static: bool) -> Iterator[pa.RecordBatch]:
        """Yield the batches of an entity as they are written, in the order of the file."""
        for piece in self.pieces.get(entity, ()):
            if piece.is_static == static:
                try:
                    yield messages.decode_rows(piece.span.payload(self._file)).batch
                except DamagedMessageError as error:
                    raise RunDirectoryError(
                        f"'{self._path}' was changed while it was read: {error}", expected="a recording that stays"
                    ) from error

    def kept(self) -> Iterator[bytes]:
        """Yield the file's bytes without what is cut off or damaged and without the index, piece by piece."""
        left_out = {damage.begin for damage in self._damaged}
        yield self._file.read(0, messages.HEADER_SIZE)
        for span in messages.spans(self._file):
            if span.begin not in left_out and span.kind != messages.END:
                yield self._file.read(span.begin, span.end)

    def _index(self) -> None:
        for span in messages.spans(self._file):
            self._last, self._count = span, self._count + 1
            if span.kind == messages.STORE_INFO:
                self._announced.add(messages.announced(self._file, span))
            if span.kind != messages.ROWS:
                continue
            try:
                self._note(span, messages.decode_rows(span.payload(self._file)))
            except DamagedMessageError as error:
                self._damaged.append(Damage(span.begin, span.end, str(error)))

    def _note(self, span: Span, rows: Rows) -> None:
        kind, store = rows.store
        if kind == messages.RECORDING:
            static = not any(map(is_index, rows.batch.schema))
            batch = known_columns(rows.batch)
            names = tuple(batch.schema.names)
            columns = self._columns.setdefault(names, names)
            self.application = rows.application
            entities = self._stores.setdefault(store, defaultdict(list))
            self._note_reach(store, batch)
            entities[rows.entity].append(Piece(span, rows.batch.num_rows, static, columns))

    def _note_reach(self, store: str, batch: pa.RecordBatch) -> None:
        """Widen the reach of the timelines by a batch's."""
        reach = self._reach.setdefault(store, {})
        for name in TIMELINES:
            if name not in batch.schema.names:
                continue
            times = np.asarray(batch.column(name).drop_null().cast(pa.int64()))
            if len(times):
                ends = [*reach.get(name, ()), int(times.min()), int(times.max())]
                reach[name] = (min(ends), max(ends))

    def _named(self) -> list[str]:
        """Return the recordings that the file announces; rows of others are damaged, unless it announces none."""
        known = [name for name in self._stores if (messages.RECORDING, name) in self._announced]
        for name in [name for name in self._stores if known and name not in known]:
            pieces = [piece for found in self._stores.pop(name).values() for piece in found]
            reason = "it is of a recording that the file does not announce"
            self._damaged += [Damage(piece.span.begin, piece.span.end, reason) for piece in pieces]
        return sorted(self._stores)

    def _chosen(self, wanted: str | None) -> str:
        names = self._named()
        if wanted in self._stores or (wanted is None and len(names) == 1):
            return wanted or names[0]
        if not names:
            raise _nothing_in(self._path, self._file, self._damaged)
        if wanted is None:
            what, which = f"holds {len(names)} recordings", "one; choose it by its id (--id): "
        else:
            what, which = f"holds no recording '{wanted}'", "one of "
        raise RunDirectoryError(f"'{self._path}' {what}", expected=which + ", ".join(names))


def columns(batch: pa.RecordBatch) -> pa.Table:
    """Return the timelines and components of rows as a table, by short names."""
    kept = [i for i, field in enumerate(batch.schema) if field.name in TIMELINES or is_component(field)]
    names = [short_name(batch.schema.field(i).name) for i in kept]
    return pa.table([batch.column(i) for i in kept], names=names)


def latest(batches: Iterable[pa.RecordBatch]) -> dict[str, pa.Array]:
    """Return the last row of each component, by its short name."""
    found: dict[str, pa.Array] = {}
    for batch in batches:
        for field, array in zip(batch.schema, batch.columns, strict=True):
            if is_component(field) and len(batch):
                found[short_name(field.name)] = array[-1:]
    return found


def _opened(path: Path) -> File:
    if path.is_dir():
        raise RunDirectoryError(f"'{path}' is a folder", expected="a recording, a file that ends with .rrd")
    with for_people(path, "read"):
        if not stat.S_ISREG(path.stat().st_mode):
            raise RunDirectoryError(f"'{path}' is no ordinary file", expected="a recording, a file that ends with .rrd")
        file = File(path)
    _require_readable(path, file.read(0, messages.HEADER_SIZE))
    return file


def _require_readable(path: Path, head: bytes) -> None:
    if not head:
        raise RunDirectoryError(f"the recording '{path}' is empty", expected="a rerun recording")
    if head[:3] != messages.MAGIC[:3]:
        raise RunDirectoryError(f"'{path}' is no rerun recording", expected="a file that begins with 'RRF2'")
    if head[:4] != messages.MAGIC:
        form = head[:4].decode("latin-1")
        raise RunDirectoryError(
            f"the recording '{path}' has another format ({form!r})", expected="'RRF2', which rerun writes since 0.23"
        )
    if len(head) == messages.HEADER_SIZE and head[messages.SERIALIZER_AT] != messages.PROTOBUF:
        writer = ".".join(map(str, messages.writer_version(head)))
        raise RunDirectoryError(
            f"the recording '{path}' was written by rerun {writer}, in a format that is not read any more",
            expected="a recording of rerun 0.23 or later",
        )
    if len(head) < messages.HEADER_SIZE:
        raise RunDirectoryError(f"the recording '{path}' is cut off within its header", expected="a whole recording")


def _nothing_in(path: Path, file: File, damaged: list[Damage]) -> RunDirectoryError:
    if not damaged:
        return RunDirectoryError(
            f"'{path}' holds no recording: {file.size} bytes without a row", expected="a recording that has begun"
        )
    writer, known = messages.writer_version(file.read(0, messages.HEADER_SIZE)), version("rerun-sdk")
    message = f"nothing of the recording '{path}' can be read: {damaged[0].reason}"
    if known.split(".")[:2] == [str(part) for part in writer[:2]]:
        return RunDirectoryError(message, expected="a recording that was not changed")
    return RunDirectoryError(
        f"{message}; it was written by rerun {'.'.join(map(str, writer))}",
        expected=f"a recording of rerun {known}, to which 'rerun rrd migrate' may convert it",
    )
