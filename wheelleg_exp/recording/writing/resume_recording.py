"""Resume an earlier recording: what it keeps, and where it is moved when it cannot be resumed."""

from __future__ import annotations

import os
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from wheelleg_exp.errors import RunDirectoryError
from wheelleg_exp.files import for_people
from wheelleg_exp.recording import layout
from wheelleg_exp.recording.reading.arrow_values import python_values
from wheelleg_exp.recording.reading.messages import (
    BLUEPRINT_ACTIVATION,
    END,
    FOOTER_SIZE,
    HEADER_SIZE,
    MAGIC,
    RECORDING,
    ROWS,
    DamagedMessageError,
    File,
    Rows,
    decode_rows,
    spans,
)
from wheelleg_exp.recording.writing.recorded_events import Point
from wheelleg_exp.recording.writing.recorded_frames import Stamp

_PROPERTIES = f"{layout.PROPERTIES}/{layout.OWN}"
_SCALARS = "Scalars:scalars"


class NotResumable(RunDirectoryError):
    """A recording cannot be gone on with; ``reason`` says why."""

    def __init__(self, path: Path, reason: str, expected: str) -> None:
        super().__init__(f"cannot go on with the recording '{path}': {reason}", expected=expected)
        self.reason = reason


class EarlierRecording:
    """The rows of an earlier recording up to a control step, and what a recorder needs to go on after them.

    A last message that was cut off by a sudden end is left out; nothing of the file is changed.

    Args:
        path: the file.
        until: last control step whose rows are kept.

    Attributes:
        documents: names of the texts, filled by ``batches`` like all below.
        keys: keys of the training's scalars.
        started: when the recording began.
        last: the last value of each entity that numbers episodes and their steps, with its control step.
        steps: the control steps of the frames, by the same entities.
    """

    def __init__(self, path: Path, until: int) -> None:
        self._path, self._until = path, until
        self.documents: list[str] = []
        self.keys: list[str] = []
        self.started: str | None = None
        self.last: dict[str, tuple[int, float]] = {}
        self.steps: defaultdict[str, list[int]] = defaultdict(list)
        self._plotted: dict[str, int] = {}
        self._rows: list[tuple[Stamp, list[float]]] = []

    def batches(self) -> Iterator[pa.RecordBatch]:
        """Yield what is kept: rows up to the step, and texts.

        Raises:
            RunDirectoryError: the file is no recording of this layout, or is damaged.
        """
        problem = self._problem_of_head()
        if problem is None:
            for rows in self._messages():
                try:
                    yield from self._kept(rows)
                except (pa.ArrowException, ValueError, TypeError, LookupError, AttributeError) as error:
                    raise self._damaged(f"its '{rows.entity}' is not as this program writes it") from error
            problem = None if self.started is not None else "it is of another program or layout"
        if problem is not None:
            expected = "a recording of this program's present layout, or no file at this place"
            raise NotResumable(self._path, problem, expected)

    def journal_alone(self) -> dict[str, list[Point]]:
        """Return the training scalars that stand in the journal and not yet in the plots' entities."""
        found: dict[str, list[Point]] = defaultdict(list)
        for stamp, values in sorted(self._rows, key=lambda row: row[0].step):
            for key, value in zip(self.keys, values, strict=False):
                if not np.isnan(value) and stamp.step > self._plotted.get(key, -1):
                    found[key].append((stamp, value))
        return found

    def known_keys(self) -> list[str]:
        """Return the keys that the kept rows of the journal have."""
        return self.keys[: max((len(values) for _, values in self._rows), default=0)]

    def _problem_of_head(self) -> str | None:
        try:
            file = File(self._path)
        except OSError as error:
            return str(error)
        head = file.read(0, HEADER_SIZE)
        if not head:
            return "it is empty"
        return None if head.startswith(MAGIC) and len(head) == HEADER_SIZE else "it is no rerun recording"

    def _messages(self) -> Iterator[Rows]:
        file, last = File(self._path), None
        for span in spans(file):
            if last is not None and last.kind == END:
                raise self._damaged(f"it is damaged at byte {last.begin}: it goes on behind its end")
            last = span
            if span.kind != ROWS:
                continue
            try:
                rows = decode_rows(span.payload(file))
            except DamagedMessageError as error:
                raise self._damaged(f"it is damaged at byte {span.begin}: {error}") from error
            if rows.store[0] == RECORDING:
                yield rows
        if last is not None and last.kind == END and file.size - last.end <= FOOTER_SIZE:  # which may be cut off
            return
        end = HEADER_SIZE if last is None else last.end
        kind = int.from_bytes(file.read(end, end + 8), "little")
        if (kind > BLUEPRINT_ACTIVATION and file.size - end >= 8) or (last is not None and last.kind == END):
            raise self._damaged(f"it is damaged at byte {end}")

    def _damaged(self, reason: str) -> NotResumable:
        return NotResumable(self._path, reason, "a recording that was not changed")

    def _kept(self, rows: Rows) -> Iterator[pa.RecordBatch]:
        entity, batch = rows.entity.strip("/"), rows.batch
        if layout.STEP not in batch.schema.names:
            yield from self._kept_static(entity, batch)
            return
        steps = np.asarray(batch.column(layout.STEP))
        if len(steps) and steps.max() > self._until:
            batch = batch.filter(pc.less_equal(batch.column(layout.STEP), self._until))
        if len(batch):
            self._note(entity, batch)
            yield batch

    def _kept_static(self, entity: str, batch: pa.RecordBatch) -> Iterator[pa.RecordBatch]:
        name = layout.key_below(layout.DOCUMENTS, entity)
        if name is not None:
            if name not in self.documents:
                self.documents.append(name)
            yield batch
        elif entity == layout.JOURNAL and "keys" in batch.schema.names:
            self.keys = [str(key) for key in python_values(batch.column("keys"))[-1] or []]
        elif entity == _PROPERTIES and self._is_ours(batch):
            self.started = str((python_values(batch.column("started"))[-1] or [""])[0])

    def _is_ours(self, batch: pa.RecordBatch) -> bool:
        names = batch.schema.names
        if "format_version" not in names or "started" not in names:
            return False
        return bool(python_values(batch.column("format_version"))[-1] == [layout.FORMAT_VERSION])

    def _note(self, entity: str, batch: pa.RecordBatch) -> None:
        if _SCALARS not in batch.schema.names:
            return
        steps = np.asarray(batch.column(layout.STEP))
        step = int(steps.max())
        if entity == layout.JOURNAL:
            self._rows += zip(_stamps(batch), batch.column(_SCALARS).to_pylist(), strict=True)
        elif (key := layout.key_below(layout.TRAINING, entity)) is not None:
            self._plotted[key] = max(step, self._plotted.get(key, -1))
        elif entity.endswith(("episode/number", "episode/step")):
            self.steps[entity] += steps.tolist()
            if step > self.last.get(entity, (-1, 0.0))[0]:
                self.last[entity] = (step, float(batch.column(_SCALARS)[int(steps.argmax())].as_py()[0]))


def resume_problem(path: Path) -> str | None:
    """Return why a file cannot be gone on with, None when it can."""
    try:
        for _ in EarlierRecording(path, until=-1).batches():
            pass
    except NotResumable as error:
        return error.reason
    return None


def _stamps(batch: pa.RecordBatch) -> list[Stamp]:
    columns = (batch.column(n).cast(pa.int64()).to_pylist() for n in (layout.STEP, layout.SIM_TIME, layout.ITERATION))
    return [Stamp(*values) for values in zip(*columns, strict=True)]


def move_aside(path: Path, *, go_on: bool) -> str | None:
    """Move an earlier recording aside unless it can be gone on with, and remove what an interrupted resume left.

    Args:
        path: the recording.
        go_on: whether the recording is to be gone on with; otherwise nothing stands there yet.

    Returns:
        What became of it, in words, None when there is nothing to tell.
    """
    if not go_on:
        return None
    for left in path.parent.glob(f".{path.name}.*.tmp"):
        left.unlink(missing_ok=True)
    if not path.exists():
        return "the earlier part of this recording is missing"
    problem = resume_problem(path)
    if problem is None:
        return None
    return f"the earlier part of this recording stands in {_renamed(path).name}: {problem}"


def _renamed(path: Path) -> Path:
    """Give a file a name that nothing else has."""
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
