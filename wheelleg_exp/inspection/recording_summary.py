"""Summary of a recording: its parts, episodes, measures, and the trends of its training."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
import pyarrow as pa

from wheelleg_exp.definitions import ending
from wheelleg_exp.inspection.episode_measures import (
    FAILED,
    TIMED_OUT,
    UNFINISHED,
    EffortUse,
    Episode,
    ForceExtreme,
    RewardShare,
    TrackingError,
    base_motion,
    effort_use,
    episodes,
    force_extremes,
    mean_duration,
    mean_reward,
    reward_shares,
    survival,
    tracking_errors,
    whole,
)
from wheelleg_exp.inspection.recorded_numbers import Statistics, View
from wheelleg_exp.inspection.row_selection import Length, Selection
from wheelleg_exp.recording.layout import BRANCH, ITERATION, TRAINING
from wheelleg_exp.recording.reading.number_groups import parts_of, unescaped
from wheelleg_exp.recording.reading.recording_contents import Health
from wheelleg_exp.recording.reading.recording_reader import Event, Recording


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


def training_trends(recording: Recording, selection: Selection) -> list[Trend]:
    """Return the trend of every training scalar over the chosen rows, by name."""
    found = []
    for entity in recording.entities():
        parts = [unescaped(part) for part in parts_of(entity)]
        if parts[0] == TRAINING and {"scalars", ITERATION} <= recording.columns(entity):
            trend = _trend("/".join(parts[1:]), selection.apply(recording.numbers(entity)))
            if trend is not None:
                found.append(trend)
    return found


def sample_episodes(found: Sequence[Episode], longest: int) -> list[Sample]:
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


@dataclass(frozen=True)
class Span:
    """From where to where the recording reaches on one timeline; ``sim_time`` in s."""

    first: float
    last: float


@dataclass(frozen=True)
class Part:
    """What stands below one path, of all environments: how many entities, and how many rows they have together."""

    name: str
    entities: int
    rows: int


@dataclass(frozen=True)
class EpisodeFigures:
    """Episodes together; but for the counts, of those that were recorded from beginning to end.

    Attributes:
        count: how many were recorded, at least in part.
        whole: how many of them from beginning to end.
        begun_before: how many were under way when recording began.
        unfinished: how many had not ended when it paused or stopped.
        failed, timed_out: how the whole ones ended.
        survival: share of them that reached the time-out; None when there are none.
        ended_by: how many each termination ended; one that two ended counts once, under both names.
        mean_duration_s, longest_s: how long they lasted; None when there are none.
        mean_reward: mean sum of rewards; None when there are none.
    """

    count: int
    whole: int
    begun_before: int
    unfinished: int
    failed: int
    timed_out: int
    survival: float | None
    ended_by: dict[str, int]
    mean_duration_s: float | None
    longest_s: float | None
    mean_reward: float | None


@dataclass(frozen=True)
class Summary:
    """What a recording holds and tells.

    Attributes:
        path, recording_id, purpose: which recording; the purpose is None for another tool's.
        properties: what it says of itself.
        health: how whole the file is, and its size.
        env_ids: the environments that the figures are of.
        sample: which sample of a training the figures are of, the last with a whole episode; None where rows were
            chosen, and outside of training: they are of all that was chosen.
        step_dt: simulated time of a control step, s.
        timelines: from where to where it reaches.
        parts: what stands below each first part of the entity paths.
        notes: what happened to the recording itself, such as a bound on its size that was reached.
        frames: how many frames of motion the figures are of, and of how many; None where no motion was recorded.
        figures: the episodes together.
        episodes: each that was chosen, of all samples.
        tracking: errors of velocities against commands.
        base: statistics of height (m), roll and pitch (rad).
        forces: the largest contact force of each sensor and body.
        efforts: how much of its effort each joint used.
        rewards: the share of each term.
        events: how often each event happened.
        training: how each scalar of the training went.
        samples: what the episodes of each sample were like; empty outside of training.
    """

    path: str
    recording_id: str
    purpose: str | None
    properties: dict[str, dict[str, Any]]
    health: Health
    env_ids: list[int]
    sample: Sample | None
    step_dt: float | None
    timelines: dict[str, Span]
    parts: list[Part]
    notes: list[Event]
    frames: tuple[int, int] | None
    figures: EpisodeFigures
    episodes: list[Episode]
    tracking: list[TrackingError]
    base: dict[str, Statistics]
    forces: list[ForceExtreme]
    efforts: list[EffortUse]
    rewards: list[RewardShare]
    events: dict[str, int]
    training: list[Trend]
    samples: list[Sample]

    def as_dict(self) -> dict[str, Any]:
        """Return all of it as a plain mapping."""
        return {**asdict(self), "health": self.health.as_dict()}


def summarize(recording: Recording, selection: Selection | None = None) -> Summary:
    """Return the summary of a recording; what it does not hold is empty or None.

    Args:
        recording: the recording.
        selection: which rows the figures are of; by default all, of a training those of the last sample. What the
            recording holds, its samples and scalars are told of all of it.

    Raises:
        RunDirectoryError: rows are damaged or larger than is read, or the chosen environment was not recorded.
    """
    with np.errstate(all="ignore"):  # a recording may hold any numbers
        return _summary(View(recording, selection or Selection()))


def _summary(chosen: View) -> Summary:
    recording, found = chosen.recording, episodes(chosen)
    longest = recording.properties.get("wheelleg", {}).get("max_episode_length")
    samples = sample_episodes(found, longest if isinstance(longest, int) else 1)
    sample = _told(samples) if chosen.selection == Selection(env_id=chosen.selection.env_id) else None
    view, shown = (chosen, found) if sample is None else _of_sample(chosen, found, sample)
    return Summary(
        path=str(recording.path),
        recording_id=recording.recording_id,
        purpose=recording.purpose,
        properties={name: dict(values) for name, values in recording.properties.items()},
        health=recording.health,
        env_ids=view.env_ids,
        sample=sample,
        step_dt=recording.step_dt,
        timelines=_timelines(recording),
        parts=_parts(recording),
        notes=recording.events("recording"),
        frames=_frames(view),
        figures=episode_figures(shown),
        episodes=found,
        tracking=tracking_errors(view),
        base=base_motion(view),
        forces=force_extremes(view),
        efforts=effort_use(view),
        rewards=reward_shares(view),
        events=dict(Counter(event.text for event in view.events("events"))),
        training=training_trends(recording, chosen.selection),
        samples=samples,
    )


def _told(samples: list[Sample]) -> Sample | None:
    """Return the sample that says what a training ended as: the last with a whole episode, else the last."""
    return next((sample for sample in reversed(samples) if sample.episodes), samples[-1] if samples else None)


def _of_sample(view: View, found: list[Episode], sample: Sample) -> tuple[View, list[Episode]]:
    begin, end = (Length(float(step), True) for step in (sample.first_step, sample.last_step))
    shown = [e for e in found if sample.first_step <= e.first_step and e.last_step <= sample.last_step]
    return View(view.recording, replace(view.selection, begin=begin, end=end)), shown


def episode_figures(found: list[Episode]) -> EpisodeFigures:
    """Return the figures of episodes together."""
    kept = whole(found)
    outcomes = Counter(episode.outcome for episode in kept)
    return EpisodeFigures(
        count=len(found),
        whole=len(kept),
        begun_before=sum(not episode.is_from_start for episode in found),
        unfinished=sum(episode.outcome == UNFINISHED for episode in found),
        failed=outcomes[FAILED],
        timed_out=outcomes[TIMED_OUT],
        survival=survival(found),
        ended_by=dict(Counter(ending(episode.ended_by) for episode in kept)),
        mean_duration_s=mean_duration(found),
        longest_s=max((episode.duration_s for episode in kept), default=None),
        mean_reward=mean_reward(found),
    )


def _timelines(recording: Recording) -> dict[str, Span]:
    found = {name: recording.reach(name) for name in recording.timelines()}
    return {name: Span(*reach) for name, reach in found.items() if reach is not None}


def _frames(view: View) -> tuple[int, int] | None:
    """Return how many frames are chosen, and of how many of the chosen environments."""
    for group in ("episode", "base", "terminations", "rewards"):
        found = [frames for env_id in view.env_ids if (frames := view.frames(group, env_id)) is not None]
        if found:
            every = View(view.recording)
            return sum(map(len, found)), sum(len(every.frames(group, frames.env_id or 0) or ()) for frames in found)
    return None


def _parts(recording: Recording) -> list[Part]:
    entities: Counter[str] = Counter()
    rows: Counter[str] = Counter()
    for entity in recording.entities():
        name = unescaped(BRANCH.sub("", entity).split("/")[0])
        entities[name] += 1
        rows[name] += recording.count(entity)
    return [Part(name, count, rows[name]) for name, count in entities.items()]
