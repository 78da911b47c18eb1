"""Resume an earlier recording: what it keeps, and where it is moved when it cannot be resumed."""

from __future__ import annotations

import os
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from rerun.chunk import Chunk

from wheelleg_exp.errors import RunDirectoryError
from wheelleg_exp.files import for_people
from wheelleg_exp.recording import layout
from wheelleg_exp.recording.reading.arrow_values import python_values
from wheelleg_exp.recording.reading.recording_contents import Contents

_PROPERTIES = f"{layout.PROPERTIES}/{layout.OWN}"
_SCALARS = "Scalars:scalars"


class EarlierRecording:
    """The rows of an earlier recording up to a control step, and what a recorder needs to continue after them.

    A last message that is cut off is left out. The file does not change.

    Args:
        path: the file.
        until: last control step whose rows are kept.

    Attributes:
        chunks: the kept rows and texts.
        documents: names of the texts.
        keys: keys of the training's scalars.
        started: when the recording started.
        last: the control step and the last value of each entity that counts episodes or their steps.
        steps: the control steps of the frames, by the same entities.

    Raises:
        RunDirectoryError: the file is not a recording of the present layout, or is damaged.
    """

    def __init__(self, path: Path, until: int) -> None:
        self._path, self._until = path, until
        self.documents: list[str] = []
        self.keys: list[str] = []
        self.started: str | None = None
        self.last: dict[str, tuple[int, float]] = {}
        self.steps: defaultdict[str, list[int]] = defaultdict(list)
        contents = Contents(path)
        if contents.health.damaged:
            raise self._problem(f"{contents.health.damaged} of its messages are damaged", "an undamaged recording")
        try:
            self.chunks = [
                chunk
                for entity, pieces in contents.pieces.items()
                for piece in pieces
                for chunk in (self._static(entity, piece.batch) if piece.is_static else self._rows(entity, piece.batch))
            ]
        except (pa.ArrowException, ValueError, TypeError, LookupError, AttributeError) as error:
            raise self._problem("its rows are not those of this program", "an undamaged recording") from error
        if self.started is None:
            expected = "a recording in the present layout of this program, or no file at this path"
            raise self._problem("another program or layout wrote it", expected)

    def _problem(self, reason: str, expected: str) -> RunDirectoryError:
        return RunDirectoryError(f"cannot resume the recording '{self._path}': {reason}", expected=expected)

    def _rows(self, entity: str, batch: pa.RecordBatch) -> Iterator[Chunk]:
        if entity.startswith(layout.HIDDEN) or layout.STEP not in batch.schema.names:
            return
        steps = np.asarray(batch.column(layout.STEP))
        if len(steps) and steps.max() > self._until:
            batch = batch.filter(pc.less_equal(batch.column(layout.STEP), self._until))
        if len(batch):
            self._note(entity, batch)
            yield from Chunk.from_record_batch(batch)

    def _static(self, entity: str, batch: pa.RecordBatch) -> Iterator[Chunk]:
        name = layout.key_below(layout.DOCUMENTS, entity)
        if name is not None:
            if name not in self.documents:
                self.documents.append(name)
            yield from Chunk.from_record_batch(batch)
        elif entity == _PROPERTIES and "started" in batch.schema.names and _is_present_format(batch):
            self.started = str((python_values(batch.column("started"))[-1] or [""])[0])

    def _note(self, entity: str, batch: pa.RecordBatch) -> None:
        if _SCALARS not in batch.schema.names:
            return
        steps = np.asarray(batch.column(layout.STEP))
        step = int(steps.max())
        if (key := layout.key_below(layout.TRAINING, entity)) is not None:
            if key not in self.keys:
                self.keys.append(key)
        elif entity.endswith(("episode/number", "episode/step")):
            self.steps[entity] += steps.tolist()
            if step > self.last.get(entity, (-1, 0.0))[0]:
                self.last[entity] = (step, float(batch.column(_SCALARS)[int(steps.argmax())].as_py()[0]))


def _is_present_format(batch: pa.RecordBatch) -> bool:
    if "format_version" not in batch.schema.names:
        return False
    return bool(python_values(batch.column("format_version"))[-1] == [layout.FORMAT_VERSION])


def move_aside(path: Path, *, go_on: bool) -> str | None:
    """Move an earlier recording aside unless it can be resumed, and remove the files of an interrupted resume.

    Args:
        path: the recording.
        go_on: whether the recording is to be resumed; otherwise no file exists yet.

    Returns:
        What became of the earlier recording; None when there is nothing to report.
    """
    if not go_on:
        return None
    for left in path.parent.glob(f".{path.name}.*.tmp"):
        left.unlink(missing_ok=True)
    if not path.exists():
        return "the earlier part of this recording is missing"
    try:
        EarlierRecording(path, until=-1)
    except RunDirectoryError as error:
        return f"the earlier part of this recording is now {_renamed(path).name}: {error.message}"
    return None


def _renamed(path: Path) -> Path:
    """Rename a file to the first free name of ``<name>.damaged``, ``<name>.damaged-2``, and so on."""
    number = 1
    while True:
        target = path.with_name(f"{path.name}.damaged" + (f"-{number}" if number > 1 else ""))
        with for_people(target):
            try:
                os.link(path, target)
            except FileExistsError:
                number += 1
                continue
            path.unlink()
            return target
