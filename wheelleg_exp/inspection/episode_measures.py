"""Recorded episodes, and measures of the robot: tracking, base motion, contact forces, efforts, rewards."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from wheelleg_exp.inspection.recorded_numbers import Frames, Moment, Statistics, View, frames_for, statistics
from wheelleg_exp.recording.layout import STEP
from wheelleg_exp.recording.reading.arrow_values import as_number

FAILED, TIMED_OUT, UNFINISHED = "failed", "time out", "unfinished"
_TOTAL = "total"
_OWN = ("number", "episode.step", "terminated", "truncated")
_FAILED_LEVELS = ("WARN", "ERROR", "CRITICAL")


@dataclass(frozen=True)
class Episode:
    """The recorded part of one episode.

    Attributes:
        env_id: the environment.
        iteration, last_iteration: training iterations of its first and last recorded frame; None outside of training.
        first_step, last_step: its first and last recorded control step.
        frames: number of recorded frames.
        duration_s: its duration at the last recorded frame, s.
        is_from_start: whether its first frame was recorded.
        outcome: ``failed``, ``time out``, or ``unfinished`` if its end was not recorded.
        ended_by: the terminations that fired.
        total_reward: sum of the recorded rewards; None if they were not recorded.
    """

    env_id: int
    iteration: int | None
    last_iteration: int | None
    first_step: int
    last_step: int
    frames: int
    duration_s: float
    is_from_start: bool
    outcome: str
    ended_by: tuple[str, ...]
    total_reward: float | None


def whole(found: Sequence[Episode]) -> list[Episode]:
    """Return the episodes that were recorded from start to end.

    Only these count in averages. An episode that was running when recording started is probably long. An episode that
    was running when recording stopped has no end and no final sum of rewards.
    """
    return [episode for episode in found if episode.is_from_start and episode.outcome != UNFINISHED]


def survival(found: Sequence[Episode]) -> float | None:
    """Return the share of the complete episodes that reached the time-out; None without any."""
    kept = whole(found)
    return sum(episode.outcome == TIMED_OUT for episode in kept) / len(kept) if kept else None


def mean_duration(found: Sequence[Episode]) -> float | None:
    """Return the mean duration of the complete episodes, s; None without any."""
    kept = whole(found)
    return float(np.mean([episode.duration_s for episode in kept])) if kept else None


def mean_reward(found: Sequence[Episode]) -> float | None:
    """Return the mean sum of rewards of the complete episodes; None without any."""
    rewards = [episode.total_reward for episode in whole(found) if episode.total_reward is not None]
    return float(np.mean(rewards)) if rewards else None


def episodes(view: View) -> list[Episode]:
    """Return the episodes of the selected environments, by environment and time."""
    return [episode for env_id in view.env_ids for episode in _of_env(view, env_id)]


def _of_env(view: View, env_id: int) -> list[Episode]:
    ends = view.frames("terminations", env_id)
    if ends is None or not len(ends):
        return []
    fired = np.stack([ends.column(name) > 0 for name in ends.names], axis=1)
    marks = _Marks(view, env_id, ends, fired)
    bounds = [0, *(np.flatnonzero(marks.begins)).tolist(), len(ends)]
    rows = [slice(a, b) for a, b in pairwise(bounds) if b > a]
    return [marks.episode(part) for part in rows]


class _Marks:
    """The signals that separate the episodes of one environment."""

    def __init__(self, view: View, env_id: int, ends: Frames, fired: NDArray[np.bool_]) -> None:
        self._env_id, self._ends, self._fired = env_id, ends, fired
        self._steps: NDArray[np.int64] = ends.column(STEP)
        self._step_dt = view.recording.step_dt or 0.0
        self._own = _own_marks(view.frames("episode", env_id), len(ends))
        self._rewards = view.frames("rewards", env_id)
        events = view.recording.events("episodes", env_id)
        self._failed_steps = {event.step for event in events if event.level in _FAILED_LEVELS}

    @property
    def begins(self) -> NDArray[np.bool_]:
        """Whether an episode starts at a row, (n,); always false for the first row."""
        if self._own is not None:
            return np.diff(self._own.column("number"), prepend=self._own.column("number")[:1]) != 0
        begins = np.zeros(len(self._steps), dtype=bool)
        ended = np.asarray(self._fired.any(axis=1))
        begins[1:] = (np.diff(self._steps) != 1) | ended[:-1]
        return begins

    def episode(self, rows: slice) -> Episode:
        """Return the episode of some rows."""
        first, last = rows.start, rows.stop - 1
        outcome = self._outcome(last)
        age = self._age(rows)
        names = [name for name, fired in zip(self._ends.names, self._fired[last], strict=True) if fired]
        return Episode(
            env_id=self._env_id,
            iteration=self._ends.moment(first).iteration,
            last_iteration=self._ends.moment(last).iteration,
            first_step=int(self._steps[first]),
            last_step=int(self._steps[last]),
            frames=rows.stop - first,
            duration_s=age * self._step_dt,
            is_from_start=age == rows.stop - first,
            outcome=outcome,
            ended_by=tuple(names),
            total_reward=self._reward(int(self._steps[first]), int(self._steps[last])),
        )

    def _outcome(self, row: int) -> str:
        if self._own is not None:
            failed, over = (self._own.column(name)[row] > 0 for name in ("terminated", "truncated"))
        else:
            failed = int(self._steps[row]) in self._failed_steps
            over = bool(self._fired[row].any()) and not failed
        return FAILED if failed else TIMED_OUT if over else UNFINISHED

    def _reward(self, first: int, last: int) -> float | None:
        """Return the sum of the rewards between two steps."""
        if self._rewards is None or _TOTAL not in self._rewards.names:
            return None
        steps = self._rewards.column(STEP)
        rows = (steps >= first) & (steps <= last)
        return float(np.nansum(self._rewards.column(_TOTAL)[rows]) * self._step_dt)

    def _age(self, rows: slice) -> int:
        """Return the episode's number of control steps at its last recorded frame."""
        if self._own is not None:
            return int(self._own.column("episode.step")[rows.stop - 1])
        return int(rows.stop - rows.start)


def _own_marks(frames: Frames | None, rows: int) -> Frames | None:
    """Return the recorded episode counters; None unless every frame has them."""
    if frames is None or len(frames) != rows or not set(_OWN) <= set(frames.names):
        return None
    return frames if all(np.isfinite(frames.column(name)).all() for name in _OWN) else None


TOTAL = "total"
_AT_LIMIT = 1.0 - 1e-6  # efforts are float32, limits are float64


@dataclass(frozen=True)
class TrackingError:
    """The error of a velocity, actual minus commanded, over all frames.

    Attributes:
        command: the command.
        name: the velocity: ``v_x``, ``v_y`` (m/s), ``w_z`` (rad/s).
        rmse, mean_absolute, mean, largest: root mean square, mean absolute, mean, and largest absolute error.
        mean_command: the mean command.
    """

    command: str
    name: str
    rmse: float
    mean_absolute: float
    mean: float
    largest: float
    mean_command: float | None


@dataclass(frozen=True)
class ForceExtreme:
    """The contact force of one body.

    Attributes:
        sensor, body: the sensor and the body.
        largest_n: the largest norm within a step, N; if that was not recorded, the largest at the end of a step.
        at: the moment of the largest norm.
        mean_n: the mean norm at the end of a step, N.
        contact_share: share of the frames with a force at their end.
    """

    sensor: str
    body: str
    largest_n: float
    at: Moment | None
    mean_n: float
    contact_share: float


@dataclass(frozen=True)
class EffortUse:
    """The use of a joint's effort limit.

    Attributes:
        joint: the joint.
        limit: its effort limit, N·m (N); None if it is unknown or unlimited.
        rms, largest: root mean square and largest absolute applied effort.
        saturated_share: share of the frames at the limit; None without a limit.
    """

    joint: str
    limit: float | None
    rms: float
    largest: float
    saturated_share: float | None


@dataclass(frozen=True)
class RewardShare:
    """The contribution of one reward term.

    Attributes:
        term: the term.
        weight: its configured weight; None if it was not recorded.
        mean: its mean, 1/s; None without values.
        total: its sum over the recorded time.
        share: its share of the sum of the terms' absolute values, 0 to 1; None if that sum is 0.
    """

    term: str
    weight: float | None
    mean: float | None
    total: float
    share: float | None


def tracking_errors(view: View) -> list[TrackingError]:
    """Return the errors of every commanded number that the base has under the same name."""
    found = []
    for name in view.names("commands"):
        command, _, part = name.rpartition(".")
        if command and part in view.names("base"):
            words = (f"commands.{name}", f"base.{part}")
            both = [frames for env_id in view.env_ids for frames in _together(view, words, env_id)]
            asked, actual = (np.concatenate([frames.column(word) for frames in both]) for word in words)
            error = actual - asked
            found.append(_tracking_error(command, part, error, asked))
    return [error for error in found if error is not None]


def base_motion(view: View) -> dict[str, Statistics]:
    """Return the statistics of the base's recorded height and angles."""
    present = [name for name in ("height", "roll", "pitch") if name in view.names("base")]
    return {name: statistics(view.column("base", name), lambda row: view.moment("base", row)) for name in present}


def force_extremes(view: View) -> list[ForceExtreme]:
    """Return the contact forces of every sensor and body, with peaks within a step if recorded."""
    names = view.names("contacts")
    found = []
    for sensor, body in _bodies(view):
        name = f"{sensor}.{body}"
        norms = view.column("contacts", name)
        peaks = view.column("contacts", f"{sensor}.peak.{body}") if f"{sensor}.peak.{body}" in names else norms
        if len(norms):
            row = int(np.nanargmax(np.nan_to_num(peaks, nan=-1.0)))
            at = view.moment("contacts", row)
            known = norms[np.isfinite(norms)]
            mean, share = (float(known.mean()), float(np.mean(known > 0.0))) if len(known) else (0.0, 0.0)
            found.append(ForceExtreme(sensor, body, float(peaks[row]), at, mean, share))
    return found


def effort_use(view: View) -> list[EffortUse]:
    """Return the use of each joint's effort limit."""
    joints = [name.removesuffix(".effort") for name in view.names("joints") if name.endswith(".effort")]
    found = []
    for joint in joints:
        size = np.abs(view.column("joints", f"{joint}.effort"))
        size = size[np.isfinite(size)]
        if len(size):
            limit = _limit(view, joint)
            share = None if limit is None else float(np.mean(size >= limit * _AT_LIMIT))
            found.append(EffortUse(joint, limit, float(np.sqrt(np.mean(size**2))), float(size.max()), share))
    return found


def reward_shares(view: View) -> list[RewardShare]:
    """Return the contribution of each reward term."""
    static = view.static("rewards")
    weights = dict(zip(static.get("terms", []), static.get("weights", []), strict=False))
    rows = {name: view.column("rewards", name) for name in view.names("rewards") if name != TOTAL}
    sizes = {name: float(np.nansum(np.abs(values))) for name, values in rows.items()}
    everything = sum(sizes.values())
    step_dt = view.recording.step_dt or 0.0
    return [
        RewardShare(
            term=name,
            weight=as_number(weights.get(name)),
            mean=_mean(values),
            total=float(np.nansum(values)) * step_dt,
            share=sizes[name] / everything if everything else None,
        )
        for name, values in rows.items()
    ]


def _together(view: View, names: tuple[str, ...], env_id: int) -> list[Frames]:
    """Return the rows of several numbers; empty if the environment lacks one of them."""
    known = view.recording.all_numbers(env_id)
    if not all(name in known for name in names):
        return []
    return frames_for(view.recording, names, replace(view.selection, env_id=env_id))


def _tracking_error(
    command: str, name: str, error: NDArray[np.float64], asked: NDArray[np.float64]
) -> TrackingError | None:
    known = error[np.isfinite(error)]
    if not len(known):
        return None
    return TrackingError(
        command=command,
        name=name,
        rmse=float(np.sqrt(np.mean(known**2))),
        mean_absolute=float(np.abs(known).mean()),
        mean=float(known.mean()),
        largest=float(np.abs(known).max()),
        mean_command=_mean(asked),
    )


def _bodies(view: View) -> Iterator[tuple[str, str]]:
    """Yield every sensor with each of its bodies."""
    recording = view.recording
    branch = recording.branch(view.env_ids[0])
    root = f"{branch}/contacts" if branch else "contacts"
    for entity in recording.entities():
        above, _, sensor = entity.rpartition("/")
        if above == root and "scalars" in recording.columns(entity):
            yield from ((sensor, body) for body in recording.names(entity))


def _limit(view: View, joint: str) -> float | None:
    entity = view.recording.all_numbers(view.env_ids[0])[f"joints.{joint}.effort"].entity
    recorded = view.recording.static(entity.rpartition("/")[0]).get("effort_limit")
    limit = as_number(recorded[0]) if recorded else None
    return limit if limit is not None and np.isfinite(limit) else None


def _mean(values: NDArray[np.float64]) -> float | None:
    """Return the mean of the values without NaN; None without any."""
    known = values[~np.isnan(values)]
    return float(known.mean()) if len(known) else None
