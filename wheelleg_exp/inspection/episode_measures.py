"""Recorded episodes, and measures of the robot: tracking, base motion, contact forces, efforts, rewards."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from wheelleg_exp.inspection.recorded_numbers import Frames, Moment, View, frames_for
from wheelleg_exp.recording.reading.arrow_values import as_number

FAILED, TIMED_OUT, UNFINISHED = "failed", "time out", "unfinished"
TOTAL = "total"
_AT_LIMIT = 1.0 - 1e-6  # Joint efforts are recorded as float32, so a comparison with an effort limit needs a tolerance.
_OWN = ("number", "episode.step", "terminated", "truncated")
_FAILED_LEVELS = ("WARN", "ERROR", "CRITICAL")


@dataclass(frozen=True)
class Episode:
    """One episode of one environment, as far as the episode was recorded.

    Steps and iterations are those of the first and last recorded frame; iterations are None without a training.
    ``duration_s`` is the time from the episode's start to its last frame. ``outcome`` is ``failed``, ``time out``, or
    ``unfinished`` if the end was not recorded. ``ended_by`` are the termination terms that ended the episode.
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
    """Return the episodes recorded from start to end; averages use only these, because cut episodes would bias them."""
    return [episode for episode in found if episode.is_from_start and episode.outcome != UNFINISHED]


def episodes(view: View) -> list[Episode]:
    """Return the recorded episodes of the selected environments, sorted by environment and time."""
    found = []
    for env_id in view.env_ids:
        ends = view.frames("terminations", env_id)
        if ends is not None and len(ends):
            marks = _Marks(view, env_id, ends)
            bounds = [0, *np.flatnonzero(marks.begins()).tolist(), len(ends)]
            found += [marks.episode(a, b - 1) for a, b in pairwise(bounds) if b > a]
    return found


class _Marks:
    """Finds where the recorded episodes of one environment start and end."""

    def __init__(self, view: View, env_id: int, ends: Frames) -> None:
        self._env_id, self._ends = env_id, ends
        self._fired = np.stack([ends.column(name) > 0 for name in ends.names], axis=1)
        self._steps = ends.steps
        self._step_dt = view.recording.step_dt or 0.0
        # Old and truncated recordings can lack the episode's number and the step number within the episode.
        own = view.frames("episode", env_id)
        if own is not None and (len(own) != len(ends) or not set(_OWN) <= set(own.names)):
            own = None
        self._own = own if own is not None and all(np.isfinite(own.column(name)).all() for name in _OWN) else None
        self._rewards = view.frames("rewards", env_id)
        events = view.recording.events("episodes", env_id)
        self._failed_steps = {event.step for event in events if event.level in _FAILED_LEVELS}

    def begins(self) -> NDArray[np.bool_]:
        if self._own is not None:
            numbers = self._own.column("number")
            return np.asarray(np.diff(numbers, prepend=numbers[:1]) != 0)
        begins = np.zeros(len(self._steps), dtype=bool)
        begins[1:] = (np.diff(self._steps) != 1) | self._fired[:-1].any(axis=1)
        return begins

    def episode(self, first: int, last: int) -> Episode:
        frames = last - first + 1
        # Old recordings (format 1) do not contain the number of control steps since an episode's start.
        age = frames if self._own is None else int(self._own.column("episode.step")[last])
        names = [name for name, fired in zip(self._ends.names, self._fired[last], strict=True) if fired]
        if self._own is not None:
            failed, over = (self._own.column(name)[last] > 0 for name in ("terminated", "truncated"))
        else:
            failed, over = int(self._steps[last]) in self._failed_steps, bool(names)
        first_step, last_step, reward = int(self._steps[first]), int(self._steps[last]), None
        if self._rewards is not None and TOTAL in self._rewards.names:
            steps = self._rewards.steps
            rows = (steps >= first_step) & (steps <= last_step)
            reward = float(np.nansum(self._rewards.column(TOTAL)[rows]) * self._step_dt)
        return Episode(
            env_id=self._env_id,
            iteration=self._ends.moment(first).iteration,
            last_iteration=self._ends.moment(last).iteration,
            first_step=first_step,
            last_step=last_step,
            frames=frames,
            duration_s=age * self._step_dt,
            is_from_start=age == frames,
            outcome=FAILED if failed else TIMED_OUT if over else UNFINISHED,
            ended_by=tuple(names),
            total_reward=reward,
        )


@dataclass(frozen=True)
class TrackingError:
    """Statistics of a velocity's tracking error, m/s or rad/s: the measured minus the commanded velocity."""

    command: str
    name: str
    rmse: float
    mean_absolute: float
    mean: float
    largest: float
    mean_command: float | None


@dataclass(frozen=True)
class ForceExtreme:
    """Statistics of the contact force on one body, measured by one contact sensor.

    ``largest_n`` is the largest norm, N: over all physics steps if the recording contains peaks, or else at the ends of
    control steps, like ``mean_n``. ``contact_share`` is the share of the recorded frames with a nonzero force.
    """

    sensor: str
    body: str
    largest_n: float
    at: Moment | None
    mean_n: float
    contact_share: float


@dataclass(frozen=True)
class EffortUse:
    """The effort of a joint, N·m or N; ``limit`` and ``saturated_share`` are None without a finite effort limit."""

    joint: str
    limit: float | None
    rms: float
    largest: float
    saturated_share: float | None


@dataclass(frozen=True)
class RewardShare:
    """The contribution of one reward term: its mean (1/s), and its sum over the recorded time.

    ``share`` is the term's sum of absolute rewards over the same sum of all terms; None if all are 0.
    """

    term: str
    weight: float | None
    mean: float | None
    total: float
    share: float | None


def tracking_errors(view: View) -> list[TrackingError]:
    """Return the tracking error of each velocity command component whose measured value was recorded."""
    found = []
    for name in view.names("commands"):
        command, _, part = name.rpartition(".")
        if command and part in view.names("base"):
            words = (f"commands.{name}", f"base.{part}")
            having = [i for i in view.env_ids if set(words) <= view.recording.all_numbers(i).keys()]
            by_env = [frames_for(view.recording, words, replace(view.selection, env_id=i)) for i in having]
            both = [frames for found_frames in by_env for frames in found_frames]
            asked, actual = (np.concatenate([frames.column(word) for frames in both]) for word in words)
            error = actual - asked
            known = error[np.isfinite(error)]
            if len(known):
                size, rmse = np.abs(known), float(np.sqrt(np.mean(known**2)))
                mean, largest = float(known.mean()), float(size.max())
                found.append(TrackingError(command, part, rmse, float(size.mean()), mean, largest, _mean(asked)))
    return found


def force_extremes(view: View) -> list[ForceExtreme]:
    """Return statistics of the contact force on each body, for each contact sensor."""
    names, recording = view.names("contacts"), view.recording
    branch = recording.branch(view.env_ids[0])
    root = f"{branch}/contacts" if branch else "contacts"
    entities = [e for e in recording.entities() if e.rpartition("/")[0] == root and "scalars" in recording.columns(e)]
    found = []
    for sensor, body in ((e.rpartition("/")[2], body) for e in entities for body in recording.names(e)):
        norms = view.column("contacts", f"{sensor}.{body}")
        peaks = view.column("contacts", f"{sensor}.peak.{body}") if f"{sensor}.peak.{body}" in names else norms
        if len(norms):
            row, known = int(np.nanargmax(np.nan_to_num(peaks, nan=-1.0))), norms[np.isfinite(norms)]
            mean, share = (float(known.mean()), float(np.mean(known > 0.0))) if len(known) else (0.0, 0.0)
            at = view.moment("contacts", row)
            found.append(ForceExtreme(sensor, body, float(peaks[row]), at, mean, share))
    return found


def effort_use(view: View) -> list[EffortUse]:
    """Return the effort of each joint relative to the joint's effort limit."""
    found = []
    for name in (name for name in view.names("joints") if name.endswith(".effort")):
        size = np.abs(view.column("joints", name))
        size = size[np.isfinite(size)]
        if len(size):
            entity = view.recording.all_numbers(view.env_ids[0])[f"joints.{name}"].entity
            recorded = view.recording.static(entity.rpartition("/")[0]).get("effort_limit")
            limit = as_number(recorded[0]) if recorded else None
            limit = limit if limit is not None and np.isfinite(limit) else None
            share = None if limit is None else float(np.mean(size >= limit * _AT_LIMIT))
            rms, joint = float(np.sqrt(np.mean(size**2))), name.removesuffix(".effort")
            found.append(EffortUse(joint, limit, rms, float(size.max()), share))
    return found


def reward_shares(view: View) -> list[RewardShare]:
    """Return the contribution of each reward term to the total reward."""
    static = view.static("rewards")
    weights = dict(zip(static.get("terms", []), static.get("weights", []), strict=False))
    rows = {name: view.column("rewards", name) for name in view.names("rewards") if name != TOTAL}
    sizes = {name: float(np.nansum(np.abs(values))) for name, values in rows.items()}
    everything = sum(sizes.values())
    step_dt = view.recording.step_dt or 0.0
    shares = {name: size / everything if everything else None for name, size in sizes.items()}
    return [
        RewardShare(name, as_number(weights.get(name)), _mean(v), float(np.nansum(v)) * step_dt, shares[name])
        for name, v in rows.items()
    ]


def _mean(values: NDArray[np.float64]) -> float | None:
    known = values[~np.isnan(values)]
    return float(known.mean()) if len(known) else None
