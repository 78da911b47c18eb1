"""What is recorded between frames: ends of episodes, interval events, messages, and the scalars of a training.

A chunk of one row takes about 1.5 kB, whatever it contains, so the scalars of several iterations are written at a time.
A killed training loses the last of them here. ``iterations.jsonl`` contains the scalars of every iteration.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import rerun as rr

from wheelleg_exp.definitions import ending
from wheelleg_exp.env import ManagerBasedRLEnv
from wheelleg_exp.recording import layout
from wheelleg_exp.recording.layout import EnvPaths
from wheelleg_exp.recording.writing.recorded_frames import Stamp
from wheelleg_exp.state.tensor_trees import host_copy

EPISODES, EVENTS = "episodes", "events"


@dataclass(frozen=True)
class LogEntry:
    """One line of the log.

    Attributes:
        stamp: the time.
        kind: ``EPISODES``, ``EVENTS`` or ``RECORDING``.
        text: the text.
        level: the severity by rerun's names.
    """

    stamp: Stamp
    kind: str
    text: str
    level: str


def episode_end(env: ManagerBasedRLEnv, env_id: int, stamp: Stamp) -> LogEntry | None:
    """Return the log entry of an episode that ended in this step; None when no episode ended."""
    manager = env.termination_manager
    failed = bool(host_copy(manager.terminated[env_id]))
    if not failed and not host_copy(manager.time_outs[env_id]):
        return None
    reasons = [name for name in manager.active_terms if manager.get_term(name)[env_id]]
    seconds = int(env.episode_length_buf[env_id]) * env.step_dt
    text = f"env {env_id}: ended by {ending(reasons)} after {seconds:.2f} s"
    return LogEntry(stamp, EPISODES, text, "WARN" if failed else "INFO")


def fired_events(env: ManagerBasedRLEnv, env_id: int) -> list[str]:
    """Return the interval events that fired for the environment at the last step."""
    # A timer shared by all environments has one flag.
    return [name for name, due in env.event_manager.fired.items() if host_copy(due[env_id if len(due) > 1 else 0])]


RECORDING = "recording"
Columns = tuple[str, list[Stamp], Any]


class EventLog:
    """The log entries that are not in the file yet.

    Interval events fire after a step is recorded, so they are read one step later, or between two steps.

    Args:
        env: the environment.
    """

    def __init__(self, env: ManagerBasedRLEnv) -> None:
        self._env = env
        self._lines: dict[str, list[LogEntry]] = defaultdict(list)
        self._fired: dict[str, list[Stamp]] = defaultdict(list)
        self._awaiting: tuple[Stamp, Sequence[tuple[int, EnvPaths]]] | None = None

    def captured(self, stamp: Stamp, envs: Sequence[tuple[int, EnvPaths]]) -> None:
        """Log the ends of episodes in a recorded step; the interval events of the step follow later."""
        for env_id, paths in envs:
            end = episode_end(self._env, env_id, stamp)
            if end is not None:
                self._lines[paths.data(layout.LOG, end.kind)].append(end)
        self._awaiting = (stamp, envs)

    def look_back(self, step: int) -> None:
        """Log the interval events that followed the last recorded step, if that was ``step``."""
        awaiting, self._awaiting = self._awaiting, None
        if awaiting is None or awaiting[0].step != step:
            return
        stamp, envs = awaiting
        for env_id, paths in envs:
            for name in fired_events(self._env, env_id):
                self._fired[paths.data("events", name)].append(stamp)
                entry = LogEntry(stamp, EVENTS, f"env {env_id}: {name}", "INFO")
                self._lines[paths.data(layout.LOG, EVENTS)].append(entry)

    def say(self, text: str, level: str, stamp: Stamp) -> None:
        """Log a message about the recording itself."""
        self._lines[layout.join(layout.LOG, RECORDING)].append(LogEntry(stamp, RECORDING, text, level))

    def pieces(self) -> Iterator[Columns]:
        """Yield each entry once, as columns."""
        for entity, entries in self._lines.items():
            texts, levels = [e.text for e in entries], [e.level for e in entries]
            yield entity, [e.stamp for e in entries], rr.TextLog.columns(text=texts, level=levels)
        for entity, stamps in self._fired.items():
            yield entity, stamps, rr.Scalars.columns(scalars=np.ones(len(stamps)))
        self._lines.clear()
        self._fired.clear()


_ITERATIONS_PER_CHUNK = 10

Point = tuple[Stamp, float]


class TrainingScalars:
    """The scalars that are not in the file yet.

    Attributes:
        keys: every key so far, in the order of appearance.
    """

    def __init__(self, keys: Sequence[str] = ()) -> None:
        self.keys = list(keys)
        self._points: dict[str, list[Point]] = defaultdict(list)
        self._iterations = 0

    def add(self, stamp: Stamp, values: Mapping[str, float]) -> bool:
        """Add the scalars of an iteration and return whether one of the keys is new."""
        new = [key for key in values if key not in self.keys]
        self.keys += new
        for key, value in values.items():
            self._points[key].append((stamp, float(value)))
        self._iterations += 1
        return bool(new)

    def pieces(self, *, everything: bool) -> Iterator[Columns]:
        """Yield the columns of each key once: when there are enough iterations for a chunk, or ``everything``."""
        if self._iterations < _ITERATIONS_PER_CHUNK and not everything:
            return
        for key, points in self._points.items():
            values = np.array([value for _, value in points])
            entity = layout.join_key(layout.TRAINING, key)
            yield entity, [stamp for stamp, _ in points], rr.Scalars.columns(scalars=values)
        self._points.clear()
        self._iterations = 0
