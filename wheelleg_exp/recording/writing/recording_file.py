"""The file of a recording while it grows."""

from __future__ import annotations

import os
import uuid
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import pyarrow as pa
import rerun as rr

from wheelleg_exp.errors import RunDirectoryError, SimulationFailure
from wheelleg_exp.files import for_people, temporary_name
from wheelleg_exp.recording.layout import PROPERTIES, join
from wheelleg_exp.recording.reading.messages import BLUEPRINT, RECORDING
from wheelleg_exp.recording.rerun_program import optimize_recording
from wheelleg_exp.recording.writing import encoding
from wheelleg_exp.recording.writing.encoding import Column, Ids, Store

APPLICATION = "wheelleg"
_TOGETHER = 1 << 20  # bytes that wait in memory at most


class RecordingFile:
    """Writes messages to ``path``; they wait in memory until ``flush``, or until there are many.

    Args:
        path: the file; its folder is made when missing.
        recording_id: the recording's identity.
        name: the name that the viewer shows.
        aside: whether to write beside an existing file until ``take_place``.

    Attributes:
        unfinished: why the closed file was not put together and has no index; None when it was, or is open.

    Raises:
        RunDirectoryError: the file exists, or cannot be made.
        SimulationFailure: the disk is full or broken.
    """

    def __init__(self, path: Path, *, recording_id: str, name: str, aside: bool = False) -> None:
        self.path = path
        self.is_open = False
        self.unfinished: str | None = None
        self._is_broken = False
        self._store = Store(RECORDING, recording_id, APPLICATION)
        self._ids = Ids()
        self._waiting = bytearray(encoding.header() + encoding.store_info(self._store, self._ids))
        self._written = temporary_name(path) if aside else path
        self._descriptor = _created(self._written)
        self.is_open = True
        self.static(PROPERTIES, rr.archetypes.RecordingInfo(name=name))
        self.flush()

    def static(self, entity: str, *archetypes: Any) -> None:
        """Log what holds at all times."""
        self._send(encoding.new_rows(self._store, entity, encoding.one_row(archetypes), self._ids))

    def property(self, name: str, values: dict[str, Any]) -> None:
        """Set a property of the recording."""
        self.static(join(PROPERTIES, name), rr.AnyValues(**values))

    def columns(self, entity: str, times: Sequence[Column], columns: Iterable[Any]) -> None:
        """Send rerun's columns of components with their timelines."""
        found = [encoding.component(column.component_descriptor(), column.as_arrow_array()) for column in columns]
        self._send(encoding.new_rows(self._store, entity, [*times, *found], self._ids))

    def rows(self, batches: Iterable[pa.RecordBatch]) -> None:
        """Send rows of another recording, as they are."""
        for batch in batches:
            self._send(encoding.rows_message(self._store, batch))

    def take_place(self) -> None:
        """Move the file to its path, over what stood there; after a loss of power it is the old file or the new."""
        self.flush()
        if self._written != self.path:
            with for_people(self.path):
                os.fsync(self._descriptor)
                self._written.replace(self.path)
                _sync(self.path.parent)
            self._written = self.path

    def abandon(self) -> None:
        """Close and remove the file."""
        with suppress(SimulationFailure):
            self._close()
        self._written.unlink(missing_ok=True)

    def blueprint(self, blueprint: Any) -> None:
        """Make ``blueprint`` the layout that the recording opens with."""
        layout = _Layout(Store(BLUEPRINT, f"rec_{uuid.uuid4().hex}", APPLICATION), self._ids)
        blueprint.to_blueprint()._log_to_stream(layout)
        self._send(bytes(layout.data) + encoding.activation(layout.store))

    def flush(self) -> None:
        """Bring everything sent so far into the file.

        Raises:
            SimulationFailure: the disk is full or broken.
        """
        waiting, self._waiting = memoryview(self._waiting), bytearray()
        with self._guarded():
            while waiting:
                waiting = waiting[os.write(self._descriptor, waiting) :]

    def close(self) -> None:
        """Finish the file: put its pieces together and write an index; further calls do nothing.

        Raises:
            SimulationFailure: the disk is full or broken.
        """
        if not self.is_open:
            return
        try:
            if not self._is_broken:
                self.flush()
        finally:
            self._close()
        if not self._is_broken:
            self.unfinished = optimize_recording(self.path)

    def _send(self, data: bytes) -> None:
        self._waiting += data
        if len(self._waiting) > _TOGETHER:
            self.flush()

    def _close(self) -> None:
        self.is_open = False
        with self._guarded():  # some file systems tell only now that there was no room
            os.close(self._descriptor)

    @contextmanager
    def _guarded(self) -> Iterator[None]:
        """Turn an OSError into an error that says what became of the file."""
        try:
            yield
        except OSError as error:
            self._is_broken = True
            reason = os.strerror(error.errno).lower() if error.errno else str(error)
            message = f"cannot write the recording '{self.path}': {reason}"
            raise SimulationFailure(message, expected="room on a working disk") from error


class _Layout:
    """Takes a blueprint of rerun's up as the messages of a store.

    Attributes:
        store: the store.
        data: its messages.
    """

    def __init__(self, store: Store, ids: Ids) -> None:
        self.store, self._ids = store, ids
        self.data = bytearray(encoding.store_info(store, ids))

    def log(self, entity: str, *archetypes: Any, **_: Any) -> None:
        """Take one row up."""
        time = encoding.timeline("blueprint", pa.array([0], pa.int64()))
        self.data += encoding.new_rows(self.store, entity, [time, *encoding.one_row(archetypes)], self._ids)


def _sync(folder: Path) -> None:
    """Wait until the names in a folder are on the disk."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _created(path: Path) -> int:
    """Create the file exclusively, so that no two recorders ever share one, and return its descriptor."""
    with for_people(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            return os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o666)
        except FileExistsError:
            raise RunDirectoryError(
                f"the recording '{path}' exists and is not overwritten", expected="a path that is not taken"
            ) from None
