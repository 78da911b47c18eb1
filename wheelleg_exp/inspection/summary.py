"""What one wants to know first of a recording."""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from wheelleg_exp.inspection import trends
from wheelleg_exp.inspection.episodes import (
    FAILED,
    TIMED_OUT,
    UNFINISHED,
    Episode,
    episodes,
    mean_duration,
    mean_reward,
    survival,
)
from wheelleg_exp.inspection.measures import (
    EffortUse,
    ForceExtreme,
    RewardShare,
    TrackingError,
    base_motion,
    effort_use,
    force_extremes,
    reward_shares,
    tracking_errors,
)
from wheelleg_exp.inspection.selection import Selection
from wheelleg_exp.inspection.statistics import Statistics
from wheelleg_exp.inspection.trends import Sample, Trend
from wheelleg_exp.inspection.view import View
from wheelleg_exp.recording.events import Event
from wheelleg_exp.recording.groups import plain
from wheelleg_exp.recording.health import Health
from wheelleg_exp.recording.reader import Recording

_BRANCH = re.compile(r"^env_\d+/")


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
    """The episodes together.

    Attributes:
        count: how many were recorded at least in part.
        failed, timed_out, unfinished: how each ended.
        survival: share of the ended ones that reached the time-out; None when none ended.
        ended_by: how many each termination ended.
        mean_duration_s, longest_s: how long the ended ones lasted; None when none ended.
        mean_reward: mean sum of rewards of those recorded from beginning to end; None when there are none.
    """

    count: int
    failed: int
    timed_out: int
    unfinished: int
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
        step_dt: simulated time of a control step, s.
        timelines: from where to where it reaches.
        parts: what stands below each first part of the entity paths.
        notes: what happened to the recording itself, such as a bound on its size that was reached.
        frames: how many frames of motion the figures are of, and of how many; None where no motion was recorded.
        figures: the episodes together.
        episodes: each of them.
        tracking: errors of velocities against commands.
        base: statistics of height (m), roll and pitch (rad).
        forces: the largest contact force of each sensor and body.
        efforts: how much of its effort each joint used.
        rewards: the share of each term.
        events: how often each event happened.
        training: how each scalar of the training went.
        samples: what the episodes of each recorded iteration were like; empty outside of training.
    """

    path: str
    recording_id: str
    purpose: str | None
    properties: dict[str, dict[str, Any]]
    health: Health
    env_ids: list[int]
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
        selection: which rows the figures are of; by default all. What the recording holds is told of all of it.

    Raises:
        RunDirectoryError: rows are damaged or larger than is read, or the chosen environment was not recorded.
    """
    with np.errstate(all="ignore"):  # a recording may hold any numbers
        return _summary(View(recording, selection or Selection()))


def _summary(view: View) -> Summary:
    recording, found = view.recording, episodes(view)
    return Summary(
        path=str(recording.path),
        recording_id=recording.recording_id,
        purpose=recording.purpose,
        properties={name: dict(values) for name, values in recording.properties.items()},
        health=recording.health,
        env_ids=view.env_ids,
        step_dt=recording.step_dt,
        timelines=_timelines(recording),
        parts=_parts(recording),
        notes=recording.events("recording"),
        frames=_frames(view),
        figures=episode_figures(found),
        episodes=found,
        tracking=tracking_errors(view),
        base=base_motion(view),
        forces=force_extremes(view),
        efforts=effort_use(view),
        rewards=reward_shares(view),
        events=dict(Counter(event.text for event in view.events("events"))),
        training=trends.trends(recording, view.selection),
        samples=trends.samples(found),
    )


def episode_figures(found: list[Episode]) -> EpisodeFigures:
    """Return the figures of episodes together."""
    outcomes = Counter(episode.outcome for episode in found)
    ended = [episode for episode in found if episode.outcome != UNFINISHED]
    return EpisodeFigures(
        count=len(found),
        failed=outcomes[FAILED],
        timed_out=outcomes[TIMED_OUT],
        unfinished=outcomes[UNFINISHED],
        survival=survival(found),
        ended_by=dict(Counter(name for episode in ended for name in episode.ended_by)),
        mean_duration_s=mean_duration(found),
        longest_s=max((episode.duration_s for episode in ended), default=None),
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
        name = plain(_BRANCH.sub("", entity).split("/")[0])
        entities[name] += 1
        rows[name] += recording.count(entity)
    return [Part(name, count, rows[name]) for name, count in entities.items()]
