"""Records chosen environments into one rerun file, without touching them."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
import rerun as rr

from wheelleg_exp.env import ManagerBasedRLEnv
from wheelleg_exp.errors import ConfigError
from wheelleg_exp.recording import layout, log
from wheelleg_exp.recording.blueprint import EnvLayout, Purpose, blueprint
from wheelleg_exp.recording.earlier import kept_chunks
from wheelleg_exp.recording.frames import Stamp
from wheelleg_exp.recording.layout import EnvPaths
from wheelleg_exp.recording.sink import Sink
from wheelleg_exp.recording.track import Track

_US = 1e6


class Recorder:
    """Writes the motion, numbers and words of some environments to a rerun file.

    Nothing is drawn and no state is changed: a rollout is the same to the bit with and without a recorder. Frames
    are kept in memory until ``flush``. Append ``capture`` to ``env.observers``.

    Timelines: ``step`` (the environment's control steps), ``sim_time`` (step times step duration) and, where an
    iteration was given, ``iteration``.

    Args:
        path: the file.
        env: the environment, built and playing.
        recording_id: identity of the recording, such as the run's id.
        name: what the viewer shows.
        env_ids: environments that are recorded.
        purpose: ``training`` has training curves in its layout.
        keep_until: go on with an existing file: keep its rows up to and including this control step, and
            drop the rest. None refuses an existing file.

    Raises:
        RunDirectoryError: the file exists and is not to be gone on with, or cannot be read or written.
        ConfigError: an environment does not exist, or two things would stand in one place.
    """

    def __init__(
        self,
        path: Path,
        env: ManagerBasedRLEnv,
        *,
        recording_id: str,
        name: str,
        env_ids: Sequence[int],
        purpose: Purpose,
        keep_until: int | None = None,
    ) -> None:
        self.path = Path(path)
        self.iteration: int | None = None
        self.captured = 0
        self._env = env
        self._purpose: Purpose = purpose
        require_env_ids(env_ids, env.num_envs)
        several = len(env_ids) > 1
        self._tracks = [
            Track(env, i, EnvPaths(f"env_{i}" if several else ""), place) for place, i in enumerate(env_ids)
        ]
        self._active, self._limit = False, 0
        self._stamps: list[Stamp] = []
        self._entries: list[tuple[Track, log.Entry]] = []
        self._training: dict[str, list[tuple[Stamp, float]]] = defaultdict(list)
        self._documents: list[str] = []
        self._keys: list[str] = []
        self._stale_layout = False
        go_on = keep_until is not None and self.path.exists()
        self._sink = Sink(self.path, recording_id=recording_id, name=name, aside=go_on)
        try:
            self._open(keep_until if go_on else None)
        except BaseException:
            self._sink.abandon()
            raise

    def start(self, iteration: int | None = None, steps: int | None = None) -> None:
        """Begin a segment: from now on ``capture`` captures.

        Args:
            iteration: the training iteration that frames carry; set ``iteration`` to change it on the way.
            steps: frames after which the segment ends by itself; None is no end.
        """
        self.iteration = iteration
        self.captured = 0
        self._active, self._limit = True, -1 if steps is None else steps

    def stop(self) -> None:
        """End the segment and send it."""
        self._active = False
        self.flush()

    def capture(self) -> None:
        """Take up the state after a control step; outside a segment, do nothing."""
        if not self._active:
            return
        stamp = self._stamp(self._env.common_step_counter)
        self._stamps.append(stamp)
        for track in self._tracks:
            track.frames.append()
            self._say(track, stamp)
        self.captured += 1
        if self.captured == self._limit:
            self.stop()

    def scalars(self, values: Mapping[str, float], iteration: int) -> None:
        """Take up the scalars of a training iteration; ``a/b`` stands at ``training/a/b``."""
        stamp = self._stamp(self._env.common_step_counter, iteration)
        for key, value in values.items():
            self._training[key].append((stamp, float(value)))
            if key not in self._keys:
                self._keys.append(key)
                self._stale_layout = True

    def document(self, name: str, text: str) -> None:
        """Put a markdown text at ``documents/<name>``; a later text of the same name replaces it."""
        archetype = rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN)
        self._sink.static(layout.join(layout.DOCUMENTS, name), archetype)
        if name not in self._documents:
            self._documents.append(name)
            self._stale_layout = True

    def flush(self) -> None:
        """Send what is buffered and wait until it is in the file.

        Raises:
            SimulationFailure: the disk is full or broken.
        """
        self._send_frames()
        self._send_words()
        self._send_training()
        if self._stale_layout:
            self._sink.blueprint(self._blueprint())
            self._stale_layout = False
        self._sink.flush()

    def close(self) -> None:
        """Send what is buffered and finish the file; a second call does nothing.

        Raises:
            SimulationFailure: the disk is full or broken.
        """
        self._active = False
        if self._sink.is_open:
            try:
                self.flush()
            finally:
                self._sink.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _open(self, keep_until: int | None) -> None:
        """Write what an earlier file keeps, and what never changes: shapes, names of numbers, the layout."""
        if keep_until is not None:
            self._sink.chunks(self._noted(chunk) for chunk in kept_chunks(self.path, keep_until))
        self._sink.static("/", rr.ViewCoordinates.RIGHT_HAND_Z_UP)
        seen: set[str] = set()
        for track in self._tracks:
            for entity, archetypes in track.statics():
                self._sink.static(entity, *archetypes)
            _require_unique([e for channel in track.frames.channels for e in channel.entities], seen)
        for entity, archetypes in self._tracks[0].surroundings():
            self._sink.static(entity, *archetypes)
        self._sink.blueprint(self._blueprint())
        self._stale_layout = False
        self._sink.take_place()

    def _noted(self, chunk: Any) -> Any:
        """Return a kept chunk, after noting the text or training scalar that it holds for the layout."""
        entity = chunk.entity_path.strip("/")
        for root, known in ((layout.DOCUMENTS, self._documents), (layout.TRAINING, self._keys)):
            key = layout.key_below(root, entity)
            if key is not None and key not in known:
                known.append(key)
        return chunk

    def _blueprint(self) -> Any:
        envs: list[EnvLayout] = [track.layout for track in self._tracks]
        return blueprint(envs, self._purpose, documents=self._documents, training=self._keys)

    def _stamp(self, step: int, iteration: int | None = None) -> Stamp:
        iteration = self.iteration if iteration is None else iteration
        return Stamp(step, 1000 * round(step * self._env.step_dt * _US), -1 if iteration is None else iteration)

    def _say(self, track: Track, stamp: Stamp) -> None:
        # Interval events come after a step's capture, so that they are seen here one step later.
        before = self._stamp(stamp.step - 1)
        self._entries += [(track, e) for e in log.interval_events(self._env, track.env_id, before)]
        end = log.episode_end(self._env, track.env_id, stamp)
        if end is not None:
            self._entries.append((track, end))

    def _send_frames(self) -> None:
        if not self._stamps:
            return
        for track in self._tracks:
            for entity, rows, columns in track.columns():
                stamps = self._stamps if rows is None else [self._stamps[i] for i in rows]
                self._sink.columns(entity, times(stamps), columns)
            track.frames.clear()
        self._stamps.clear()

    def _send_words(self) -> None:
        for entity, entries in _by_entity(self._entries):
            texts, levels = [e.text for e in entries], [e.level for e in entries]
            self._sink.columns(entity, times([e.stamp for e in entries]), rr.TextLog.columns(text=texts, level=levels))
        self._entries.clear()

    def _send_training(self) -> None:
        for key, points in self._training.items():
            values = np.array([value for _, value in points])
            self._sink.columns(
                layout.join_key(layout.TRAINING, key),
                times([stamp for stamp, _ in points]),
                rr.Scalars.columns(scalars=values),
            )
        self._training.clear()


def times(stamps: Sequence[Stamp]) -> list[Any]:
    """Return the time columns of frames; the iteration stands there when every frame has one."""
    columns = [
        rr.TimeColumn(layout.STEP, sequence=np.array([s.step for s in stamps])),
        rr.TimeColumn(layout.SIM_TIME, duration=np.array([s.time_ns for s in stamps], dtype="timedelta64[ns]")),
    ]
    if all(s.iteration >= 0 for s in stamps):
        columns.append(rr.TimeColumn(layout.ITERATION, sequence=np.array([s.iteration for s in stamps])))
    return columns


def _by_entity(entries: Sequence[tuple[Track, log.Entry]]) -> Iterator[tuple[str, list[log.Entry]]]:
    found: dict[str, list[log.Entry]] = defaultdict(list)
    for track, entry in entries:
        found[track.paths.data("log", entry.kind)].append(entry)
    yield from found.items()


def require_env_ids(env_ids: Sequence[int], num_envs: int) -> None:
    """Raise ConfigError unless ``env_ids`` names environments, each once."""
    wrong = [i for i in env_ids if not 0 <= i < num_envs]
    if wrong or not env_ids or len(set(env_ids)) != len(env_ids):
        raise ConfigError(
            f"is {list(env_ids)}",
            key="recording.env_ids",
            expected=f"at least one environment, each once, from 0 to {num_envs - 1}",
        )


def _require_unique(entities: Sequence[str], seen: set[str]) -> None:
    for entity in entities:
        if entity in seen:
            raise ConfigError(
                f"two things would be recorded at '{entity}'",
                key=f"env.{entity.replace('/', '.')}",
                expected="a term of another name",
            )
        seen.add(entity)
