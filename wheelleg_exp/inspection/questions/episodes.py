"""The recorded episodes, and how each ended."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from wheelleg_exp.inspection.questions.view import Frames, View
from wheelleg_exp.recording.layout import STEP

FAILED, TIMED_OUT, UNFINISHED = "failed", "time out", "unfinished"
_TOTAL = "total"
_OWN = ("number", "episode.step", "terminated", "truncated")
_FAILED_LEVELS = ("WARN", "ERROR", "CRITICAL")


@dataclass(frozen=True)
class Episode:
    """One episode as far as it was recorded.

    Attributes:
        env_id: the environment.
        iteration, last_iteration: the training iterations of its first and last recorded frame; None outside of
            training.
        first_step, last_step: the first and last recorded control step.
        frames: how many frames were recorded.
        duration_s: how long it had lasted at the last recorded frame, s.
        is_from_start: whether it was recorded from its beginning.
        outcome: ``failed``, ``time out``, or ``unfinished`` when the recording ends or pauses before it.
        ended_by: the terminations that fired.
        total_reward: sum of the recorded rewards; None when they were not recorded.
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
    """Return the episodes that were recorded from beginning to end.

    The others are in no figure: one that was under way when recording began is likely a long one, one that was when it
    stopped has no end yet, and neither has its sum of rewards.
    """
    return [episode for episode in found if episode.is_from_start and episode.outcome != UNFINISHED]


def survival(found: Sequence[Episode]) -> float | None:
    """Return the share of the whole episodes that reached the time-out; None when there are none."""
    kept = whole(found)
    return sum(episode.outcome == TIMED_OUT for episode in kept) / len(kept) if kept else None


def mean_duration(found: Sequence[Episode]) -> float | None:
    """Return how long the whole episodes lasted, s; None when there are none."""
    kept = whole(found)
    return float(np.mean([episode.duration_s for episode in kept])) if kept else None


def mean_reward(found: Sequence[Episode]) -> float | None:
    """Return the mean sum of rewards of the whole episodes; None when there are none, or none with rewards."""
    rewards = [episode.total_reward for episode in whole(found) if episode.total_reward is not None]
    return float(np.mean(rewards)) if rewards else None


def episodes(view: View) -> list[Episode]:
    """Return the episodes of the chosen environments, by environment and time."""
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
    """What tells episodes apart in the frames of one environment."""

    def __init__(self, view: View, env_id: int, ends: Frames, fired: NDArray[np.bool_]) -> None:
        self._env_id, self._ends, self._fired = env_id, ends, fired
        self._steps: NDArray[np.int64] = ends.column(STEP)
        self._step_dt = view.recording.step_dt or 0.0
        self._own = _own_marks(view.frames("episode", env_id), len(ends))
        self._rewards = view.frames("rewards", env_id)
        told = view.recording.events("episodes", env_id)
        self._failed_steps = {event.step for event in told if event.level in _FAILED_LEVELS}

    @property
    def begins(self) -> NDArray[np.bool_]:
        """Whether a new episode begins with a row, (n,); the first row's is left out."""
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
        """Return the sum of the rewards from one step to another."""
        if self._rewards is None or _TOTAL not in self._rewards.names:
            return None
        steps = self._rewards.column(STEP)
        rows = (steps >= first) & (steps <= last)
        return float(np.nansum(self._rewards.column(_TOTAL)[rows]) * self._step_dt)

    def _age(self, rows: slice) -> int:
        """Return how many control steps the episode had lasted at its last recorded frame."""
        if self._own is not None:
            return int(self._own.column("episode.step")[rows.stop - 1])
        return int(rows.stop - rows.start)


def _own_marks(frames: Frames | None, rows: int) -> Frames | None:
    """Return what was recorded of the episodes themselves; None when it is not there for every frame."""
    if frames is None or len(frames) != rows or not set(_OWN) <= set(frames.names):
        return None
    return frames if all(np.isfinite(frames.column(name)).all() for name in _OWN) else None
