"""A recording as far as it is looked at."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from wheelleg_exp.inspection.questions.selection import Selection
from wheelleg_exp.inspection.questions.statistics import Moment
from wheelleg_exp.recording.layout import ITERATION, SIM_TIME, STEP
from wheelleg_exp.recording.reading.events import Event
from wheelleg_exp.recording.reading.reader import Recording

TIMES = (STEP, SIM_TIME, ITERATION)


@dataclass(frozen=True)
class Frames:
    """Rows of one environment.

    Attributes:
        table: the timelines and one float64 column a number.
        env_id: the environment.
    """

    table: pa.Table
    env_id: int | None

    def __len__(self) -> int:
        return self.table.num_rows

    @property
    def names(self) -> list[str]:
        """The names of the numbers."""
        return [name for name in self.table.column_names if name not in TIMES]

    def column(self, name: str) -> NDArray:
        """Return a number or a timeline, (n,)."""
        return np.asarray(self.table.column(name))

    def moment(self, row: int) -> Moment:
        """Return when a row was."""
        step, time_s, iteration = (
            self.table.column(name)[row].as_py() if name in self.table.column_names else None for name in TIMES
        )
        return Moment(step, time_s, iteration, self.env_id)

    def filter(self, mask: NDArray[np.bool_]) -> Frames:
        """Return the rows where ``mask`` holds."""
        return Frames(self.table.filter(pa.array(mask)), self.env_id)


@dataclass(frozen=True)
class View:
    """The chosen rows of a recording.

    Attributes:
        recording: the recording.
        selection: which rows.
    """

    recording: Recording
    selection: Selection = field(default_factory=Selection)

    @property
    def env_ids(self) -> list[int]:
        """The chosen environments."""
        return self.selection.env_ids(self.recording)

    def has(self, group: str, env_id: int) -> bool:
        """Return whether an environment has numbers at a group or entity."""
        branch = self.recording.branch(env_id)
        path = f"{branch}/{group}" if branch else group
        return path in self.recording.groups() or "scalars" in self.recording.columns(path)

    def frames(self, group: str, env_id: int) -> Frames | None:
        """Return the rows of a group of one environment; None when it has no numbers there."""
        if not self.has(group, env_id):
            return None
        return Frames(self.selection.apply(self.recording.numbers(group, env_id)), env_id)

    def names(self, group: str) -> list[str]:
        """Return the names of a group's numbers."""
        frames = self.frames(group, self.env_ids[0])
        return [] if frames is None else frames.names

    def column(self, group: str, name: str) -> NDArray[np.float64]:
        """Return a number over the rows of all chosen environments, one after the other."""
        parts = [frames.column(name) for frames in self._all(group) if name in frames.names]
        return np.concatenate(parts) if parts else np.empty(0)

    def moment(self, group: str, row: int) -> Moment:
        """Return when a row of ``column`` was."""
        for frames in self._all(group):
            if row < len(frames):
                return frames.moment(row)
            row -= len(frames)
        raise IndexError(row)

    def static(self, path: str) -> dict[str, list]:
        """Return what holds at all times at a path of the first chosen environment."""
        branch = self.recording.branch(self.env_ids[0])
        return self.recording.static(f"{branch}/{path}" if branch else path)

    def events(self, kind: str) -> list[Event]:
        """Return what was told in words of the chosen rows."""
        found = [event for env_id in self.env_ids for event in self.recording.events(kind, env_id)]
        return [
            event for event in dict.fromkeys(found) if self.selection.has(event.step, event.time_s, event.iteration)
        ]

    def _all(self, group: str) -> Iterator[Frames]:
        for env_id in self.env_ids:
            frames = self.frames(group, env_id)
            if frames is not None:
                yield frames
