"""Data that is recorded between frames: ends of episodes, interval events, messages, and training scalars.

A chunk has about 1.5 kB of metadata, so it contains ten iterations of a scalar; a killed run lacks the last ones.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence

import numpy as np
import rerun as rr

from wheelleg_exp.definitions import ending
from wheelleg_exp.env import ManagerBasedRLEnv
from wheelleg_exp.recording import layout
from wheelleg_exp.recording.layout import EnvPaths
from wheelleg_exp.recording.writing.recorded_frames import Stamp
from wheelleg_exp.state import host_copy

EPISODES, EVENTS, RECORDING = "episodes", "events", "recording"
_ITERATIONS_PER_CHUNK = 10
Columns = tuple[str, list[Stamp], rr.ComponentColumnList]


class EventLog:
    """Log entries that are not in the file yet. Pushes follow ``capture``, so the next ``capture`` logs them."""

    def __init__(self, env: ManagerBasedRLEnv) -> None:
        self._env = env
        self._lines: dict[str, list[tuple[Stamp, str, str]]] = defaultdict(list)
        self._fired: dict[str, list[Stamp]] = defaultdict(list)
        self._awaiting: tuple[Stamp, Sequence[tuple[int, EnvPaths]]] | None = None

    def captured(self, stamp: Stamp, envs: Sequence[tuple[int, EnvPaths]]) -> None:
        """Log which episodes ended at a control step, and why."""
        manager = self._env.termination_manager
        for env_id, paths in envs:
            failed = bool(host_copy(manager.terminated[env_id]))
            if failed or host_copy(manager.time_outs[env_id]):
                reasons = [name for name in manager.active_terms if manager.get_term(name)[env_id]]
                seconds = int(self._env.episode_length_buf[env_id]) * self._env.step_dt
                text = f"env {env_id}: ended by {ending(reasons)} after {seconds:.2f} s"
                self._lines[paths.data(layout.LOG, EPISODES)].append((stamp, text, "WARN" if failed else "INFO"))
        self._awaiting = (stamp, envs)

    def look_back(self, step: int) -> None:
        """Log the interval events, such as pushes, of the last recorded control step, if its number is ``step``."""
        awaiting, self._awaiting = self._awaiting, None
        if awaiting is None or awaiting[0].step != step:
            return
        stamp, envs = awaiting
        for env_id, paths in envs:
            for name, due in self._env.event_manager.fired.items():
                # ``due`` is true where the event fired; it has only one element if all environments share a timer.
                if host_copy(due[env_id if len(due) > 1 else 0]):
                    self._fired[paths.data("events", name)].append(stamp)
                    self._lines[paths.data(layout.LOG, EVENTS)].append((stamp, f"env {env_id}: {name}", "INFO"))

    def say(self, text: str, level: str, stamp: Stamp) -> None:
        self._lines[layout.join(layout.LOG, RECORDING)].append((stamp, text, level))

    def pieces(self) -> Iterator[Columns]:
        """Yield the buffered log messages as columns of Rerun entities, and clear the buffer."""
        for entity, entries in self._lines.items():
            stamps, texts, levels = map(list, zip(*entries, strict=True))
            yield entity, stamps, rr.TextLog.columns(text=texts, level=levels)
        for entity, stamps in self._fired.items():
            yield entity, stamps, rr.Scalars.columns(scalars=np.ones(len(stamps)))
        self._lines.clear()
        self._fired.clear()


class TrainingScalars:
    """Buffers the scalars of a few training iterations; ``keys`` are in the order of their first occurrence."""

    def __init__(self, keys: Sequence[str] = ()) -> None:
        self.keys = list(keys)
        self._points: dict[str, list[tuple[Stamp, float]]] = defaultdict(list)
        self._iterations = 0

    def add(self, stamp: Stamp, values: Mapping[str, float]) -> bool:
        """Buffer the scalars of a training iteration; return True if a scalar is logged for the first time."""
        new = [key for key in values if key not in self.keys]
        self.keys += new
        for key, value in values.items():
            self._points[key].append((stamp, float(value)))
        self._iterations += 1
        return bool(new)

    def pieces(self, *, everything: bool) -> Iterator[Columns]:
        """Yield the columns of each key once: when a chunk has enough iterations, or with ``everything``."""
        if self._iterations < _ITERATIONS_PER_CHUNK and not everything:
            return
        for key, points in self._points.items():
            values = np.array([value for _, value in points])
            entity = layout.join_key(layout.TRAINING, key)
            yield entity, [stamp for stamp, _ in points], rr.Scalars.columns(scalars=values)
        self._points.clear()
        self._iterations = 0
