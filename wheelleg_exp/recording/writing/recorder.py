"""Records chosen environments into one rerun file, without touching them."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Mapping, Sequence
from dataclasses import astuple
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
import rerun as rr

from wheelleg_exp.config.checking.check_terms import recorded_errors
from wheelleg_exp.env import ManagerBasedRLEnv
from wheelleg_exp.errors import ConfigError
from wheelleg_exp.recording import layout
from wheelleg_exp.recording.blueprint import EnvLayout, Purpose, blueprint
from wheelleg_exp.recording.layout import EnvPaths
from wheelleg_exp.recording.writing import recorded_environment
from wheelleg_exp.recording.writing.recorded_environment import RecordedEnvironment
from wheelleg_exp.recording.writing.recorded_events import EventLog, TrainingScalars
from wheelleg_exp.recording.writing.recorded_frames import Stamp
from wheelleg_exp.recording.writing.recording_file import RecordingFile
from wheelleg_exp.recording.writing.resume_recording import EarlierRecording
from wheelleg_exp.state.tensor_trees import host_copy

ROWS_TOGETHER = 16  # fewer frames may wait for more: small chunks are mostly description
_US = 1e6


class Recorder:
    """Writes the motion, numbers and words of some environments to a rerun file.

    Nothing is drawn and no state is changed: a rollout is the same to the bit with and without a recorder. Append
    ``capture`` to ``env.observers``; frames are kept in memory until they are flushed.

    Timelines: ``step`` (the environment's control steps), ``sim_time`` (step times step duration) and, where an
    iteration was given, ``iteration``.

    Args:
        path: the file.
        env: the environment, built and playing.
        recording_id: identity of the recording, such as the run's id.
        name: what the viewer shows.
        env_ids: environments that are recorded.
        purpose: decides what the layout shows.
        about: what the property ``wheelleg`` says besides what the environment tells: run id, task, checkpoint.
        keep_until: go on with an existing file: keep its rows up to and including this control step, and
            drop the rest. None refuses an existing file.
        flush_every: frames after which everything is brought into the file; None leaves that to ``flush``.

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
        about: Mapping[str, Any] | None = None,
        keep_until: int | None = None,
        flush_every: int | None = None,
    ) -> None:
        self.path = Path(path)
        self.iteration: int | None = None
        self.captured = 0
        self._env, self._purpose, self._flush_every = env, purpose, flush_every
        for error in recorded_errors(list(env_ids), env.num_envs):
            raise error
        several = len(env_ids) > 1
        self._tracks = [
            RecordedEnvironment(env, i, EnvPaths(f"env_{i}" if several else ""), place)
            for place, i in enumerate(env_ids)
        ]
        self._marks = EventLog(env)
        self._scalars = TrainingScalars()
        self._documents: list[str] = []
        self._active, self._capturing, self._stale = False, False, False
        self._limit, self._last_words = -1, ""
        self._about = recorded_environment.own_facts(
            env, list(env_ids), purpose, {"run_id": recording_id, **(about or {})}
        )
        go_on = keep_until is not None and self.path.exists()
        self._sink = RecordingFile(self.path, recording_id=recording_id, name=name, aside=go_on)
        try:
            self._open(EarlierRecording(self.path, int(keep_until or 0)) if go_on else None)
        except BaseException:
            self._sink.abandon()
            raise

    def frames_within(self, megabytes: float) -> int:
        """Return how many frames surely fit into a file of that size."""
        room = megabytes * recorded_environment.MEGABYTE - recorded_environment.static_bytes(
            self._env.scene.model, len(self._tracks)
        )
        frame = recorded_environment.total_cost(track.cost for track in self._tracks).frame(ROWS_TOGETHER)
        return max(int(room / frame), 0)

    def megabytes(self, frames: int) -> float:
        """Return a size into which so many frames surely fit, MB, rounded up to a tenth."""
        frame = recorded_environment.total_cost(track.cost for track in self._tracks).frame(ROWS_TOGETHER)
        room = frames * frame + recorded_environment.static_bytes(self._env.scene.model, len(self._tracks))
        return float(np.ceil(10.0 * room / recorded_environment.MEGABYTE) / 10.0)

    def start(self, iteration: int | None = None, steps: int | None = None, *, last_words: str = "") -> None:
        """Begin a segment: from now on ``capture`` captures every environment.

        Args:
            iteration: the training iteration that frames carry; set ``iteration`` to change it on the way.
            steps: frames after which the segment ends by itself; None is no end.
            last_words: what is said in the recording when it ends by itself.
        """
        self.iteration, self.captured = iteration, 0
        self._limit, self._last_words = -1 if steps is None else steps, last_words
        self._active = steps is None or steps > 0

    def sample(self, due: int, enough: int, most: int) -> None:
        """Begin a sample of each environment, or go on with it: from now on ``capture`` captures whole episodes.

        Args:
            due: the control step after which an episode may begin.
            enough: frames of an environment with which no further episode is begun; 0 is no sample.
            most: frames at which even an episode that goes on is cut off.
        """
        now = self._env.common_step_counter
        for track in self._tracks:
            last = track.sample.steps[-1] if track.sample.steps else -1
            goes_on = last == now and int(self._env.episode_length_buf[track.env_id]) > 0
            taken = len(track.sample.steps) - bisect_right(track.sample.steps, due)
            track.sample.begin(enough, most, taken=taken, is_in_episode=goes_on)

    def frames_until(self, step: int) -> int:
        """Return how many frames of an environment are recorded up to a control step; of several the most."""
        return max(bisect_right(track.sample.steps, step) for track in self._tracks)

    def stop(self) -> None:
        """End the segment and bring it into the file."""
        self._active = False
        self.flush()

    def capture(self) -> None:
        """Take up the state after a control step; outside a segment and of a sample's episodes, do nothing."""
        step = self._env.common_step_counter
        self._marks.look_back(step - 1)
        lengths = host_copy(self._env.episode_length_buf)
        taken = [t for t in self._tracks if self._active or t.sample.takes(int(lengths[t.env_id]))]
        if not taken:
            return
        self._capturing = True
        try:
            self._take(taken, self._stamp(step))
        finally:
            self._capturing = False

    def scalars(self, values: Mapping[str, float], iteration: int) -> None:
        """Take up the scalars of a training iteration; ``a/b`` stands at ``training/a/b``."""
        if self._scalars.add(self._stamp(self._env.common_step_counter, iteration), values):
            self._stale = True

    def say(self, text: str, level: str = "WARN") -> None:
        """Note what happened to the recording itself."""
        self._marks.say(text, level, self._stamp(self._env.common_step_counter))

    def document(self, name: str, text: str) -> None:
        """Put a markdown text at ``documents/<name>``; a later text of the same name replaces it."""
        archetype = rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN)
        self._sink.static(layout.join(layout.DOCUMENTS, name), archetype)
        if name not in self._documents:
            self._documents.append(name)
            self._stale = True

    def has_document(self, name: str) -> bool:
        """Return whether there is a text of that name, an earlier recording's included."""
        return name in self._documents

    def flush(self, *, everything: bool = True) -> None:
        """Send what is buffered and wait until it is in the file.

        Args:
            everything: the plots of training scalars as well, which are otherwise written some iterations at a time
                while the journal has every one, and the last few frames, which otherwise wait for more.

        Raises:
            SimulationFailure: the disk is full or broken.
        """
        if not self._capturing:
            self._marks.look_back(self._env.common_step_counter)
        for track in self._tracks:
            if everything or len(track.stamps) >= ROWS_TOGETHER:
                self._send_frames(track)
        for piece in (*self._marks.pieces(), *self._scalars.pieces(everything=everything)):
            entity, stamps, columns = piece
            self._sink.columns(entity, times(stamps), columns)
        if self._stale:
            self._sink.blueprint(self.blueprint())
            self._stale = False
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

    @property
    def unfinished(self) -> str | None:
        """Why the closed file was not put together and has no index; None when it was, or is open."""
        return self._sink.unfinished

    def blueprint(self) -> Any:
        """Return the layout of what is recorded so far."""
        layouts, purpose, documents, training = self.layout_state()
        return blueprint(layouts, purpose, documents=documents, training=training)

    def layout_state(self) -> tuple[list[EnvLayout], Purpose, list[str], list[str]]:
        """Return what the layout is made from: environments, purpose, names of texts, keys of training scalars."""
        layouts = [track.layout for track in self._tracks]
        return layouts, self._purpose, list(self._documents), list(self._scalars.keys)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _open(self, earlier: EarlierRecording | None) -> None:
        """Write what an earlier file keeps, and what never changes: properties, shapes, names, the layout."""
        if earlier is not None:
            self._sink.chunks(earlier.chunks)
            self._restore(earlier)
        self._sink.property(layout.OWN, self._about)
        self._sink.property(
            recorded_environment.ROBOT, recorded_environment.robot_facts(self._env, self._tracks[0].layout)
        )
        self._sink.static("/", rr.ViewCoordinates.RIGHT_HAND_Z_UP)
        seen: set[str] = set()
        for track in self._tracks:
            for entity, archetypes in track.statics():
                self._sink.static(entity, *archetypes)
            _require_unique([e for channel in track.frames.channels for e in channel.entities], seen)
        for entity, archetypes in self._tracks[0].surroundings():
            self._sink.static(entity, *archetypes)
        self._stale = True
        self._sink.take_place()

    def _restore(self, earlier: EarlierRecording) -> None:
        self._about["started"] = earlier.started
        self._documents = list(earlier.documents)
        self._scalars = TrainingScalars(earlier.keys)
        for track in self._tracks:
            number, step = (earlier.last.get(track.paths.data("episode", name)) for name in ("number", "step"))
            if number is not None and step is not None:
                track.episodes.restore(int(number[1]), step[0], int(step[1]))
            track.sample.steps = sorted(earlier.steps[track.paths.data("episode", "step")])

    def _take(self, tracks: Sequence[RecordedEnvironment], stamp: Stamp) -> None:
        lengths, dones = host_copy(self._env.episode_length_buf), host_copy(self._env.termination_manager.dones)
        for track in tracks:
            track.capture(stamp, int(lengths[track.env_id]), ends=bool(dones[track.env_id]))
        self._marks.captured(stamp, [(track.env_id, track.paths) for track in tracks])
        self.captured += 1
        if self.captured == self._limit:
            if self._last_words:
                self.say(self._last_words)
            self.stop()
        elif self._flush_every is not None and len(tracks[0].stamps) >= self._flush_every:
            self.flush()

    def _stamp(self, step: int, iteration: int | None = None) -> Stamp:
        iteration = self.iteration if iteration is None else iteration
        return Stamp(step, 1000 * round(step * self._env.step_dt * _US), -1 if iteration is None else iteration)

    def _send_frames(self, track: RecordedEnvironment) -> None:
        if not track.stamps:
            return
        moments = times(track.stamps)
        for entity, columns in track.columns():
            self._sink.columns(entity, moments, columns)
        track.clear()


def times(stamps: Sequence[Stamp]) -> list[rr.TimeColumn]:
    """Return the timelines of frames; the iteration is among them when every frame has one."""
    steps, moments, iterations = (np.array(values, np.int64) for values in zip(*map(astuple, stamps), strict=True))
    columns = [
        rr.TimeColumn(layout.STEP, sequence=steps),
        rr.TimeColumn(layout.SIM_TIME, duration=moments.astype("timedelta64[ns]")),
    ]
    with_iteration = all(stamp.iteration >= 0 for stamp in stamps)
    return [*columns, rr.TimeColumn(layout.ITERATION, sequence=iterations)] if with_iteration else columns


def _require_unique(entities: Sequence[str], seen: set[str]) -> None:
    for entity in entities:
        if entity in seen:
            raise ConfigError(
                f"two things would be recorded at '{entity}'",
                key=f"env.{entity.replace('/', '.')}",
                expected="a term of another name",
            )
        seen.add(entity)
