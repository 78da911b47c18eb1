"""The recorded frames of one environment: columns of numbers beside their moments."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from wheelleg_exp.inspection.statistics import Moment
from wheelleg_exp.recording.layout import ITERATION, SIM_TIME, STEP

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
