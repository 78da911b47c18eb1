"""Write a Rerun recording to a file that grows during the run."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

import rerun as rr
import rerun.blueprint as rrb
from rerun.chunk import Chunk

from wheelleg_exp.errors import RunDirectoryError, SimulationFailure
from wheelleg_exp.files import for_people, sync, temporary_name
from wheelleg_exp.recording.layout import PROPERTIES, join
from wheelleg_exp.recording.rerun_program import optimize_recording
from wheelleg_exp.recording.rrd_file import APPLICATION, chunk_file, temporary_file


class RecordingFile:
    """A growing recording. Added data stays in memory until ``flush`` writes it to the file ``path``.

    With ``aside``, the file has a temporary name until ``take_place``. ``unfinished`` is the reason if closing could
    not write an index. An existing file raises RunDirectoryError, and a failed write SimulationFailure.
    """

    def __init__(self, path: Path, *, recording_id: str, name: str, aside: bool = False) -> None:
        self.path = path
        self.is_open = False
        self.unfinished: str | None = None
        self._is_broken = False
        # The viewer merges recordings with equal ids, and two runs can write folders of one name within a second.
        self._recording_id = f"{recording_id}_{hashlib.sha256(os.fsencode(os.path.realpath(path))).hexdigest()[:8]}"
        self._chunks: list[Chunk] = []
        self._blueprint: rrb.Blueprint | None = None
        self._written = temporary_name(path) if aside else path
        # Raise an error for an existing file, so that two recorders never write to the same file.
        with for_people(self._written):
            self._written.parent.mkdir(parents=True, exist_ok=True)
            try:
                self._descriptor = os.open(self._written, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o666)
            except FileExistsError:
                message = f"the recording '{self._written}' exists and is not overwritten"
                raise RunDirectoryError(message, expected="a free path") from None
        self.is_open = True
        self._write(chunk_file([], "").header)
        self.static(PROPERTIES, rr.archetypes.RecordingInfo(name=name))
        self.flush()

    def static(self, entity: str, *archetypes: rr.AsComponents) -> None:
        """Add static data (Rerun archetypes) of a Rerun entity."""
        columns = {}
        for archetype in archetypes:
            for batch in archetype.as_component_batches():
                columns[batch.component_descriptor().component] = batch.partition([len(batch.as_arrow_array())])
        self._chunks.append(Chunk.from_columns(entity, [], columns.values()))

    def property(self, name: str, values: Mapping[str, object]) -> None:
        """Store the dictionary ``values`` in the recording as a property with the given name."""
        self.static(join(PROPERTIES, name), rr.AnyValues(True, **values))

    def columns(self, entity: str, times: Sequence[rr.TimeColumn], columns: rr.ComponentColumnList) -> None:
        """Add rows of a Rerun entity: columns of Rerun components with their timelines."""
        self._chunks.append(Chunk.from_columns(entity, times, columns))

    def chunks(self, chunks: Iterable[Chunk]) -> None:
        self._chunks += chunks

    def blueprint(self, blueprint: rrb.Blueprint) -> None:
        """Set the default layout of Rerun's viewer for a recording."""
        self._blueprint = blueprint

    def take_place(self) -> None:
        """Move the recording's file atomically to its final path and replace an existing file."""
        self.flush()
        if self._written != self.path:
            with for_people(self.path):
                os.fsync(self._descriptor)
                self._written.replace(self.path)
            sync(self.path.parent)
            self._written = self.path

    def abandon(self) -> None:
        """Close and remove the file."""
        with suppress(SimulationFailure):
            self._close()
        self._written.unlink(missing_ok=True)

    def flush(self) -> None:
        """Write all buffered data chunks and the viewer's layout to the recording's file."""
        chunks, self._chunks = self._chunks, []
        blueprint, self._blueprint = self._blueprint, None
        with self._guarded():
            if chunks:
                self._write(b"".join(chunk_file(chunks, self._recording_id).body()))
            if blueprint is not None:
                layout = blueprint.to_blueprint()
                self._write(b"".join(temporary_file(lambda path: layout.save(APPLICATION, path)).body()))

    def close(self) -> None:
        """Close the recording's file, merge its small chunks, and write an index. A second call does nothing."""
        if not self.is_open:
            return
        try:
            if not self._is_broken:
                self.flush()
        finally:
            self._close()
        if not self._is_broken:
            self.unfinished = optimize_recording(self.path)

    def _write(self, data: bytes) -> None:
        waiting = memoryview(data)
        with self._guarded():
            while waiting:
                waiting = waiting[os.write(self._descriptor, waiting) :]

    def _close(self) -> None:
        self.is_open = False
        with self._guarded():  # Some file systems report a full disk only when a file is closed.
            os.close(self._descriptor)

    @contextmanager
    def _guarded(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            self._is_broken = True
            reason = os.strerror(error.errno).lower() if error.errno else str(error)
            message = f"cannot write the recording '{self.path}': {reason}"
            raise SimulationFailure(message, expected="room on a working disk") from error
