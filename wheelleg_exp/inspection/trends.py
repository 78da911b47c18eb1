"""How a training went: its scalars by iteration, and its sample episodes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pyarrow as pa

from wheelleg_exp.inspection.episodes import UNFINISHED, Episode, mean_duration, mean_reward, survival
from wheelleg_exp.inspection.selection import Selection
from wheelleg_exp.recording.groups import parts_of, plain
from wheelleg_exp.recording.layout import ITERATION, TRAINING
from wheelleg_exp.recording.reader import Recording


@dataclass(frozen=True)
class Trend:
    """How one scalar of the training went.

    Attributes:
        name: its name, such as ``Train/mean_reward``.
        count: how many iterations have it.
        first, last: its value in the first and the last iteration that have it.
        lowest, highest: its extremes.
        lowest_at, highest_at: the iterations of these.
    """

    name: str
    count: int
    first: float
    last: float
    lowest: float
    highest: float
    lowest_at: int
    highest_at: int


@dataclass(frozen=True)
class Sample:
    """The episodes of one stretch of frames without a gap.

    Attributes:
        iteration: the training iteration that it began in.
        last_iteration: the one that it ended in.
        episodes: how many there were.
        ended: how many of them ended while they were recorded.
        survival: share of the ended ones that reached the time-out; None when none ended.
        mean_duration_s: how long the ended ones lasted; None when none ended.
        mean_reward: mean sum of rewards of the ended ones that were recorded from their beginning; None without.
    """

    iteration: int
    last_iteration: int
    episodes: int
    ended: int
    survival: float | None
    mean_duration_s: float | None
    mean_reward: float | None


def trends(recording: Recording, selection: Selection) -> list[Trend]:
    """Return the trend of every training scalar over the chosen rows, by name."""
    found = []
    for entity in recording.entities():
        parts = [plain(part) for part in parts_of(entity)]
        if parts[0] == TRAINING and {"scalars", ITERATION} <= recording.columns(entity):
            trend = _trend("/".join(parts[1:]), selection.apply(recording.numbers(entity)))
            if trend is not None:
                found.append(trend)
    return found


def samples(found: list[Episode]) -> list[Sample]:
    """Return the sample episodes by the stretch of frames that they stand in, over all environments."""
    stretches: dict[int, list[Episode]] = {}
    begin, before = 0, None
    for episode in sorted(found, key=lambda e: (e.env_id, e.first_step)):
        if before is None or before.env_id != episode.env_id or before.last_step + 1 != episode.first_step:
            begin = episode.first_step
        stretches.setdefault(begin, []).append(episode)
        before = episode
    return [_sample(part) for _, part in sorted(stretches.items()) if part[0].iteration is not None]


def _trend(name: str, table: pa.Table) -> Trend | None:
    values, iterations = np.asarray(table.columns[-1]), np.asarray(table.column(ITERATION))
    known = np.isfinite(values)
    values, iterations = values[known], iterations[known]
    if not len(values):
        return None
    low, high = int(np.argmin(values)), int(np.argmax(values))
    return Trend(
        name=name,
        count=len(values),
        first=float(values[0]),
        last=float(values[-1]),
        lowest=float(values[low]),
        highest=float(values[high]),
        lowest_at=int(iterations[low]),
        highest_at=int(iterations[high]),
    )


def _sample(found: list[Episode]) -> Sample:
    iterations = [i for e in found for i in (e.iteration, e.last_iteration) if i is not None]
    return Sample(
        iteration=min(iterations),
        last_iteration=max(iterations),
        episodes=len(found),
        ended=sum(episode.outcome != UNFINISHED for episode in found),
        survival=survival(found),
        mean_duration_s=mean_duration(found),
        mean_reward=mean_reward(found),
    )
