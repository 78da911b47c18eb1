"""A rerun stream into one file, whose failures are errors for people."""

from __future__ import annotations

import ctypes
import os
import secrets
import shutil
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import rerun as rr

from wheelleg_exp.errors import RunDirectoryError, SimulationFailure
from wheelleg_exp.recording.finishing import finish
from wheelleg_exp.run.files import for_people

APPLICATION = "wheelleg"
_FLUSH_TIMEOUT_S = 20.0  # rerun's writer may die on a full disk without telling who waits for it
_SCARCE = 1_000_000  # bytes left on a disk that is called full


class Sink:
    """An explicit recording stream that writes to ``path``.

    Args:
        path: the file; its folder is made when missing.
        recording_id: the recording's identity.
        name: the name that the viewer shows.
        aside: whether to write beside an existing file until ``take_place``.

    Attributes:
        unfinished: why the closed file was not put together and has no index; None when it was, or is open.

    Raises:
        RunDirectoryError: the file exists, or cannot be written.
    """

    def __init__(self, path: Path, *, recording_id: str, name: str, aside: bool = False) -> None:
        self.path = path
        self.is_open = False
        self.unfinished: str | None = None
        self._is_broken = False
        self._written = path.with_name(f".{path.name}.{secrets.token_hex(6)}.tmp") if aside else path
        _claim(self._written)
        # Without rerun's own start time: only a property, which no digest looks at, depends on the wall clock.
        self.stream = rr.RecordingStream(APPLICATION, recording_id=recording_id, send_properties=False)
        with self._guarded():
            # An index of every chunk, kept until the end, would take more memory than it is worth: 4 kB a chunk.
            self.stream.save(self._written, write_footer=False)
        self.is_open = True
        self.stream.send_recording_name(name)

    def static(self, entity: str, *archetypes: Any) -> None:
        """Log what holds at all times."""
        with self._guarded():
            self.stream.log(entity, *archetypes, static=True)

    def property(self, name: str, values: dict[str, Any]) -> None:
        """Set a property of the recording."""
        with self._guarded():
            self.stream.send_property(name, rr.AnyValues(**values))

    def columns(self, entity: str, times: Iterable[Any], columns: Iterable[Any]) -> None:
        """Send whole columns."""
        with self._guarded():
            self.stream.send_columns(entity, times, columns)

    def chunks(self, chunks: Iterable[Any]) -> None:
        """Send chunks of another recording."""
        with self._guarded():
            self.stream.send_chunks(chunks)

    def take_place(self) -> None:
        """Move the file to its path, over what stood there; after a loss of power it is the old file or the new."""
        self.flush()
        if self._written != self.path:
            with for_people(self.path):
                _sync(self._written)
                self._written.replace(self.path)
                _sync(self.path.parent)
            self._written = self.path

    def abandon(self) -> None:
        """Close the stream and remove the file."""
        self.is_open = False
        self._disconnect()
        self._written.unlink(missing_ok=True)

    def blueprint(self, blueprint: Any) -> None:
        """Make ``blueprint`` the layout that the recording opens with."""
        with self._guarded():
            self.stream.send_blueprint(blueprint)

    def flush(self) -> None:
        """Wait until everything sent so far is in the file.

        Raises:
            SimulationFailure: the disk is full or broken, or the file is gone.
        """
        with self._guarded():
            self.stream.flush(timeout_sec=_FLUSH_TIMEOUT_S)

    def close(self) -> None:
        """Finish the file: put its pieces together and write an index; further calls do nothing."""
        if not self.is_open:
            return
        self.is_open = False
        try:
            if not self._is_broken:
                self.flush()
        finally:
            self._disconnect()
        if not self._is_broken:
            self.unfinished = finish(self.path)

    def _disconnect(self) -> None:
        if not self._is_broken:
            self.stream.disconnect()
            return
        # The writer is dead, and rerun may wait for it for ever: now, when the stream is collected, and at the
        # program's end. So the stream is never collected, and rerun's own end is left out.
        ctypes.pythonapi.Py_IncRef(ctypes.py_object(self.stream))
        rr.unregister_shutdown()

    @contextmanager
    def _guarded(self) -> Iterator[None]:
        """Turn rerun's errors into one that says what became of the file."""
        try:
            yield
        except RuntimeError as error:
            self._is_broken = True
            raise _failure(self.path, error) from error


def _sync(path: Path) -> None:
    """Wait until a file, or the names in a folder, are on the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _claim(path: Path) -> None:
    """Create the file exclusively, so that no two recorders ever share one."""
    with for_people(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            path.touch(exist_ok=False)
        except FileExistsError:
            raise RunDirectoryError(
                f"the recording '{path}' exists and is not overwritten", expected="a path that is not taken"
            ) from None


def _failure(path: Path, error: RuntimeError) -> SimulationFailure:
    try:
        is_full = shutil.disk_usage(path.parent).free < _SCARCE
    except OSError:
        is_full = False
    reason = "the disk is full" if is_full else str(error).splitlines()[0]
    return SimulationFailure(f"cannot write the recording '{path}': {reason}", expected="room on a working disk")
