"""How a training went: its scalars by iteration, and its sample episodes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import pyarrow as pa

from wheelleg_exp.inspection.questions.episodes import Episode, mean_duration, mean_reward, survival, whole
from wheelleg_exp.inspection.questions.selection import Selection
from wheelleg_exp.recording.layout import ITERATION, TRAINING
from wheelleg_exp.recording.reading.groups import parts_of, plain
from wheelleg_exp.recording.reading.reader import Recording


@dataclass(frozen=True)
class Trend:
    """How one scalar of the training went.

    Attributes:
        name: its name, such as ``Train/mean_reward``.
        count: how many iterations have it.
        first, last: its value in the first and the last iteration that have it.
        last_at: that last iteration.
        lowest, highest: its extremes.
        lowest_at, highest_at: the iterations of these.
    """

    name: str
    count: int
    first: float
    last: float
    last_at: int
    lowest: float
    highest: float
    lowest_at: int
    highest_at: int


@dataclass(frozen=True)
class Sample:
    """The episodes that were recorded of a training at one time, of all environments.

    Attributes:
        iteration, last_iteration: the training iterations of its first and last frame.
        first_step, last_step: the control steps of these.
        episodes: how many were recorded from beginning to end, which the figures are of.
        cut: how many were recorded in part.
        survival: share of the whole ones that reached the time-out; None when there are none.
        mean_duration_s: how long the whole ones lasted; None when there are none.
        mean_reward: their mean sum of rewards; None when there are none.
    """

    iteration: int
    last_iteration: int
    first_step: int
    last_step: int
    episodes: int
    cut: int
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


def samples(found: Sequence[Episode], longest: int) -> list[Sample]:
    """Return the samples by time.

    Each environment's begins with its next episode, so that those of one sample begin less than a longest episode
    apart.

    Args:
        found: the episodes.
        longest: control steps of the longest episode.
    """
    groups: list[list[list[Episode]]] = []
    for stretch in sorted(_stretches(found), key=lambda stretch: stretch[0].first_step):
        begun = groups[-1][0][0].first_step if groups else 0
        is_known = not groups or any(stretch[0].env_id == other[0].env_id for other in groups[-1])
        if is_known or stretch[0].first_step - begun >= longest:
            groups.append([])
        groups[-1].append(stretch)
    return [_sample([episode for stretch in group for episode in stretch]) for group in groups]


def _stretches(found: Sequence[Episode]) -> Iterator[list[Episode]]:
    """Yield the episodes of a training that an environment lived through without a gap between them."""
    stretch: list[Episode] = []
    for episode in sorted(found, key=lambda e: (e.env_id, e.first_step)):
        before = stretch[-1] if stretch else None
        if before and (before.env_id != episode.env_id or before.last_step + 1 != episode.first_step):
            yield stretch
            stretch = []
        if episode.iteration is not None:
            stretch.append(episode)
    if stretch:
        yield stretch


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
        last_at=int(iterations[-1]),
        lowest=float(values[low]),
        highest=float(values[high]),
        lowest_at=int(iterations[low]),
        highest_at=int(iterations[high]),
    )


def _sample(found: list[Episode]) -> Sample:
    iterations = [i for e in found for i in (e.iteration, e.last_iteration) if i is not None]
    count = len(whole(found))
    return Sample(
        iteration=min(iterations),
        last_iteration=max(iterations),
        first_step=min(episode.first_step for episode in found),
        last_step=max(episode.last_step for episode in found),
        episodes=count,
        cut=len(found) - count,
        survival=survival(found),
        mean_duration_s=mean_duration(found),
        mean_reward=mean_reward(found),
    )
