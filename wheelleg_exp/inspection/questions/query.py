"""When a condition holds in a recording, and what the numbers were around it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from wheelleg_exp.inspection.questions.columns import frames_for
from wheelleg_exp.inspection.questions.conditions import Condition
from wheelleg_exp.inspection.questions.selection import Selection, nothing_chosen
from wheelleg_exp.inspection.questions.spans import Length
from wheelleg_exp.inspection.questions.statistics import Moment
from wheelleg_exp.inspection.questions.view import Frames
from wheelleg_exp.recording.layout import STEP
from wheelleg_exp.recording.reading.reader import Recording


@dataclass(frozen=True)
class Hit:
    """A stretch of frames in which a condition holds without a break.

    Attributes:
        first, last: its first and last frame.
        frames: how many it has.
        around: the rows from some time before to some time after it; None unless asked for.
    """

    first: Moment
    last: Moment
    frames: int
    around: Frames | None


def find_hits(
    recording: Recording,
    condition: Condition,
    *,
    columns: Sequence[str] = (),
    around: Length | None = None,
    selection: Selection | None = None,
) -> list[Hit]:
    """Return the stretches in which a condition holds, by environment and time.

    Args:
        recording: the recording.
        condition: the condition.
        columns: the numbers of the rows around; by default those of the condition.
        around: how long before and after.
        selection: where to look; the rows around may lie outside of it.

    Raises:
        WheellegError: a name is wrong, or no row is chosen.
    """
    chosen = selection or Selection()
    wanted = list(dict.fromkeys([*condition.names, *columns]))
    everything = frames_for(recording, wanted, Selection(env_id=chosen.env_id), key="--where")
    if not chosen.is_all and not any(len(chosen.apply(frames.table)) for frames in everything):
        raise nothing_chosen(recording)
    reach = None if around is None else around.steps(recording.step_dt)
    return [hit for frames in everything for hit in _hits(frames, condition, chosen, reach, columns)]


def _hits(
    frames: Frames, condition: Condition, selection: Selection, reach: int | None, columns: Sequence[str]
) -> list[Hit]:
    holds = condition.holds({name: frames.column(name) for name in condition.names})
    steps = frames.column(STEP)
    holds &= np.isin(steps, np.asarray(selection.apply(frames.table).column(STEP)))
    shown = _only(frames, list(columns) or condition.names)
    return [
        Hit(
            first=frames.moment(a),
            last=frames.moment(b),
            frames=b - a + 1,
            around=None if reach is None else shown.filter((steps >= steps[a] - reach) & (steps <= steps[b] + reach)),
        )
        for a, b in _stretches(holds, steps)
    ]


def _stretches(holds: NDArray[np.bool_], steps: NDArray[np.int64]) -> list[tuple[int, int]]:
    """Return the first and last row of each stretch of consecutive frames."""
    rows = np.flatnonzero(holds)
    if not len(rows):
        return []
    breaks = np.flatnonzero((np.diff(rows) != 1) | (np.diff(steps[rows]) > 1)) + 1
    return [(int(part[0]), int(part[-1])) for part in np.split(rows, breaks)]


def _only(frames: Frames, names: Sequence[str]) -> Frames:
    times = [name for name in frames.table.column_names if name not in frames.names]
    return Frames(frames.table.select([*times, *dict.fromkeys(names)]), frames.env_id)
