"""Continue an earlier recording of a run, or rename an earlier recording that cannot be continued."""

from __future__ import annotations

import itertools
import os
from collections import defaultdict
from collections.abc import Iterator
from contextlib import suppress
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
    """Reads an interrupted run's recording up to the control step from which a new process resumes the run.

    It only reads files, and omits an incomplete last message. For each entity ``episode/number`` and ``episode/step``,
    ``last`` contains the last row (control step and value), and ``steps`` all recorded control steps. A recording that
    is damaged or from another program raises RunDirectoryError.
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
            reason = f"{contents.health.damaged} messages of the file are damaged"
            raise self._problem(reason, "an undamaged recording")
        self.chunks: list[Chunk] = []
        try:
            for entity, piece in ((entity, piece) for entity, pieces in contents.pieces.items() for piece in pieces):
                self.chunks += (self._static if piece.is_static else self._rows)(entity, piece.batch)
        except (pa.ArrowException, ValueError, TypeError, LookupError, AttributeError) as error:
            raise self._problem("another program wrote the recording's rows", "an undamaged recording") from error
        if self.started is None:
            expected = "a recording in the current layout of this program, or no file at this path"
            raise self._problem("another program or program version wrote the file", expected)

    def _problem(self, reason: str, expected: str) -> RunDirectoryError:
        return RunDirectoryError(f"cannot resume the recording '{self._path}': {reason}", expected=expected)

    def _rows(self, entity: str, batch: pa.RecordBatch) -> Iterator[Chunk]:
        if entity.startswith(layout.HIDDEN) or layout.STEP not in batch.schema.names:
            return
        steps = np.asarray(batch.column(layout.STEP))
        if len(steps) and steps.max() > self._until:
            batch = batch.filter(pc.less_equal(batch.column(layout.STEP), self._until))
        if not len(batch):
            return
        if _SCALARS in batch.schema.names:
            steps = np.asarray(batch.column(layout.STEP))
            step = int(steps.max())
            if (key := layout.key_below(layout.TRAINING, entity)) is not None:
                self.keys += [] if key in self.keys else [key]
            elif entity.endswith(("episode/number", "episode/step")):
                self.steps[entity] += steps.tolist()
                if step > self.last.get(entity, (-1, 0.0))[0]:
                    self.last[entity] = (step, float(batch.column(_SCALARS)[int(steps.argmax())].as_py()[0]))
        yield from Chunk.from_record_batch(batch)

    def _static(self, entity: str, batch: pa.RecordBatch) -> Iterator[Chunk]:
        name = layout.key_below(layout.DOCUMENTS, entity)
        if name is not None:
            self.documents += [] if name in self.documents else [name]
            yield from Chunk.from_record_batch(batch)
        elif entity == _PROPERTIES and {"started", "format_version"} <= {*batch.schema.names}:
            started, version = (python_values(batch.column(name))[-1] for name in ("started", "format_version"))
            if version == [layout.FORMAT_VERSION]:
                self.started = str(started[0]) if isinstance(started, list) and started else ""


def move_aside(path: Path, *, go_on: bool) -> str | None:
    """Rename an earlier recording that cannot be continued; return a message if it is missing or was renamed."""
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
    for number in itertools.count(1):
        target = path.with_name(f"{path.name}.damaged" + (f"-{number}" if number > 1 else ""))
        with for_people(target), suppress(FileExistsError):
            os.link(path, target)
            path.unlink()
            return target
    raise AssertionError
