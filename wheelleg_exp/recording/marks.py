"""Marked moments: ends of episodes, interval events, and what happened to the recording itself."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
import rerun as rr

from wheelleg_exp.env import ManagerBasedRLEnv
from wheelleg_exp.recording import layout, log
from wheelleg_exp.recording.frames import Stamp
from wheelleg_exp.recording.layout import EnvPaths

RECORDING = "recording"
Piece = tuple[str, list[Stamp], Any]


class Marks:
    """The marked moments that are not in the file yet.

    Interval events come after a step's capture, so that they are seen one step later, or between two steps.

    Args:
        env: the environment.
        envs: the recorded environments and their paths.
        stamp: returns the stamp of a control step.
    """

    def __init__(
        self, env: ManagerBasedRLEnv, envs: Sequence[tuple[int, EnvPaths]], stamp: Callable[[int], Stamp]
    ) -> None:
        self._env, self._envs, self._stamp = env, list(envs), stamp
        self._lines: dict[str, list[log.Entry]] = defaultdict(list)
        self._fired: dict[str, list[Stamp]] = defaultdict(list)
        self._awaiting: Stamp | None = None

    def captured(self, stamp: Stamp) -> None:
        """Take up the ends of episodes in a captured step; its events are still to come."""
        for env_id, paths in self._envs:
            end = log.episode_end(self._env, env_id, stamp)
            if end is not None:
                self._lines[paths.data("log", end.kind)].append(end)
        self._awaiting = stamp

    def look_back(self, step: int) -> None:
        """Take up the interval events that followed the last captured step, if that was ``step``."""
        stamp, self._awaiting = self._awaiting, None
        if stamp is None or stamp.step != step:
            return
        for env_id, paths in self._envs:
            for name in log.fired(self._env, env_id):
                self._fired[paths.data("events", name)].append(stamp)
                entry = log.Entry(stamp, log.EVENTS, f"env {env_id}: {name}", "INFO")
                self._lines[paths.data("log", log.EVENTS)].append(entry)

    def say(self, text: str, level: str, stamp: Stamp) -> None:
        """Take up what happened to the recording itself."""
        self._lines[layout.join("log", RECORDING)].append(log.Entry(stamp, RECORDING, text, level))

    def pieces(self) -> Iterator[Piece]:
        """Yield everything as columns, once."""
        for entity, entries in self._lines.items():
            texts, levels = [e.text for e in entries], [e.level for e in entries]
            yield entity, [e.stamp for e in entries], rr.TextLog.columns(text=texts, level=levels)
        for entity, stamps in self._fired.items():
            yield entity, stamps, rr.Scalars.columns(scalars=np.ones(len(stamps)))
        self._lines.clear()
        self._fired.clear()
