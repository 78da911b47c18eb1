"""Summarize a recording: its entities, its episodes, statistics of the robot's motion, and training scalars."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial

import numpy as np

from wheelleg_exp.definitions import ending
from wheelleg_exp.inspection import episode_measures as measures
from wheelleg_exp.inspection.episode_measures import Episode, episodes, whole
from wheelleg_exp.inspection.recorded_numbers import Statistics, View, statistics
from wheelleg_exp.inspection.row_selection import Length, Selection
from wheelleg_exp.recording.layout import BRANCH, ITERATION, TRAINING, key_below, unescaped
from wheelleg_exp.recording.reading.recording_contents import Health
from wheelleg_exp.recording.reading.recording_reader import Event, Recording


@dataclass(frozen=True)
class Trend:
    """The course of a training scalar over ``count`` iterations: first and last value, and extremes."""

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
    """Statistics of the episodes that were recorded in one interval (sample) of a training, over all environments.

    ``iteration`` and ``last_iteration`` are those at ``first_step`` and ``last_step``. ``episodes`` counts complete,
    and ``cut`` incomplete episodes. ``survival`` is the share of complete episodes that reached the time-out. The means
    are over complete episodes; None without one.
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
    """Return the trend of every training scalar over the selected iterations, sorted by the scalar's name."""
    found = []
    for entity in recording.entities():
        name = key_below(TRAINING, entity)
        if name is None or not {"scalars", ITERATION} <= recording.columns(entity):
            continue
        table = selection.apply(recording.numbers(entity))
        values, iterations = np.asarray(table.columns[-1]), np.asarray(table.column(ITERATION))
        values, iterations = values[np.isfinite(values)], iterations[np.isfinite(values)]
        if len(values):
            low, high = int(np.argmin(values)), int(np.argmax(values))
            first, last, lowest, highest = (float(values[row]) for row in (0, -1, low, high))
            last_at, lowest_at, highest_at = (int(iterations[row]) for row in (-1, low, high))
            found.append(Trend(name, len(values), first, last, last_at, lowest, highest, lowest_at, highest_at))
    return found


def sample_episodes(found: Sequence[Episode], longest: int) -> list[Sample]:
    """Group the recorded episodes of a training by recorded interval (sample), and return statistics of each interval.

    ``longest`` is the largest episode length in control steps, within which the recording of each environment starts.
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


def _sample(found: list[Episode]) -> Sample:
    iterations = [i for e in found for i in (e.iteration, e.last_iteration) if i is not None]
    first_step, last_step = min(e.first_step for e in found), max(e.last_step for e in found)
    figures = episode_figures(found)
    means = (figures.survival, figures.mean_duration_s, figures.mean_reward)
    counts = (figures.whole, figures.count - figures.whole)
    return Sample(min(iterations), max(iterations), first_step, last_step, *counts, *means)


@dataclass(frozen=True)
class Span:
    """The first and the last recorded value of one timeline; the values of the timeline ``sim_time`` are in s."""

    first: float
    last: float


@dataclass(frozen=True)
class Part:
    """A part of a recording, such as ``joints``: how many Rerun entities and rows it has in all environments."""

    name: str
    entities: int
    rows: int


@dataclass(frozen=True)
class EpisodeFigures:
    """Statistics of recorded episodes; ``failed`` and the later attributes cover only complete episodes.

    ``begun_before`` counts episodes that were running when recording started, and ``unfinished`` those that were
    running when it paused or stopped. ``ended_by`` counts by term; two terms form a key with both names.
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
    """The content of a recording.

    ``purpose`` is None for a recording of another program. For a training, motion statistics cover only ``sample``, the
    last recorded interval with a complete episode; it is None if the user selected rows, which the statistics then
    cover. ``frames`` counts the covered and all recorded frames. ``notes`` are messages about the recording itself,
    such as a reached size limit. ``base`` has statistics of height (m), roll, and pitch (rad).
    """

    path: str
    recording_id: str
    purpose: str | None
    properties: dict[str, dict[str, object]]
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
    tracking: list[measures.TrackingError]
    base: dict[str, Statistics]
    forces: list[measures.ForceExtreme]
    efforts: list[measures.EffortUse]
    rewards: list[measures.RewardShare]
    events: dict[str, int]
    training: list[Trend]
    samples: list[Sample]

    def as_dict(self) -> dict[str, object]:
        return {**asdict(self), "health": self.health.as_dict()}


@np.errstate(all="ignore")  # Suppress numpy's warnings about NaN and inf in a recording.
def summarize(recording: Recording, selection: Selection | None = None) -> Summary:
    """Return the summary of a recording; data that was not recorded is None or an empty list.

    By default, scalars cover the whole training, and motion statistics its last recorded interval (``Summary.sample``).
    """
    chosen = View(recording, selection or Selection())
    found = episodes(chosen)
    longest = recording.properties.get("wheelleg", {}).get("max_episode_length")
    samples = sample_episodes(found, longest if isinstance(longest, int) else 1)
    sample, view, shown = None, chosen, found
    if samples and chosen.selection == Selection(env_id=chosen.selection.env_id):
        sample = next((sample for sample in reversed(samples) if sample.episodes), samples[-1])
        first, last = sample.first_step, sample.last_step
        begin, end = Length(float(first), True), Length(float(last), True)
        view = View(recording, replace(chosen.selection, begin=begin, end=end))
        shown = [episode for episode in found if first <= episode.first_step and episode.last_step <= last]
    base = [name for name in ("height", "roll", "pitch") if name in view.names("base")]
    parts: dict[str, list[int]] = {}
    for entity in recording.entities():
        parts.setdefault(unescaped(BRANCH.sub("", entity).split("/")[0]), []).append(recording.count(entity))
    return Summary(
        path=str(recording.path),
        recording_id=recording.recording_id,
        purpose=recording.purpose,
        properties={name: dict(values) for name, values in recording.properties.items()},
        health=recording.health,
        env_ids=view.env_ids,
        sample=sample,
        step_dt=recording.step_dt,
        timelines={name: Span(*r) for name in recording.timelines() if (r := recording.reach(name)) is not None},
        parts=[Part(name, len(counts), sum(counts)) for name, counts in parts.items()],
        notes=recording.events("recording"),
        frames=_frames(view),
        figures=episode_figures(shown),
        episodes=found,
        tracking=measures.tracking_errors(view),
        base={n: statistics(view.column("base", n), partial(view.moment, "base")) for n in base},
        forces=measures.force_extremes(view),
        efforts=measures.effort_use(view),
        rewards=measures.reward_shares(view),
        events=dict(Counter(event.text for event in view.events("events"))),
        training=training_trends(recording, chosen.selection),
        samples=samples,
    )


def episode_figures(found: list[Episode]) -> EpisodeFigures:
    """Return statistics of recorded episodes, such as the share of episodes that reached the time-out."""
    kept = whole(found)
    outcomes = Counter(episode.outcome for episode in kept)
    rewards = [episode.total_reward for episode in kept if episode.total_reward is not None]
    return EpisodeFigures(
        count=len(found),
        whole=len(kept),
        begun_before=sum(not episode.is_from_start for episode in found),
        unfinished=sum(episode.outcome == measures.UNFINISHED for episode in found),
        failed=outcomes[measures.FAILED],
        timed_out=outcomes[measures.TIMED_OUT],
        survival=outcomes[measures.TIMED_OUT] / len(kept) if kept else None,
        ended_by=dict(Counter(ending(episode.ended_by) for episode in kept)),
        mean_duration_s=float(np.mean([episode.duration_s for episode in kept])) if kept else None,
        longest_s=max((episode.duration_s for episode in kept), default=None),
        mean_reward=float(np.mean(rewards)) if rewards else None,
    )


def _frames(view: View) -> tuple[int, int] | None:
    for group in ("episode", "base", "terminations", "rewards"):
        found = [frames for env_id in view.env_ids if (frames := view.frames(group, env_id)) is not None]
        if found:
            every = View(view.recording)
            return sum(map(len, found)), sum(len(every.frames(group, frames.env_id or 0) or ()) for frames in found)
    return None
