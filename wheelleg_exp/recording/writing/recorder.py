"""Record selected environments to one Rerun file, without an effect on the simulation."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Mapping, Sequence
from dataclasses import astuple
from pathlib import Path
from typing import Self

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
from wheelleg_exp.state import host_copy

# Write at least 16 frames together, because each data chunk of a recording has about 1.5 kB of metadata.
ROWS_TOGETHER = 16
_US = 1e6
_FACE, _CELL, _TEXTS = 150, 40, 2 * recorded_environment.MEGABYTE


class Recorder:
    """Writes the motion, numbers, and messages of selected environments to a Rerun file.

    A recorder draws no random numbers and changes no state, so rollouts are bitwise equal with and without it. Append
    ``capture`` to ``env.observers``. Frames stay in memory until ``flush`` writes them to the file, which has the
    timelines ``step`` (control steps), ``sim_time`` (``step`` times the step duration), and, for a training,
    ``iteration``.

    Args:
        recording_id: start of the recording's id, such as the run's id; the id ends with a hash of ``path``.
        about: additional values of the property ``wheelleg``: run id, task, checkpoint.
        keep_until: the last control step of an existing file that is kept; None refuses an existing file.
        flush_every: frames after which all data is written to the file; None writes only at ``flush``.
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
        about: Mapping[str, object] | None = None,
        keep_until: int | None = None,
        flush_every: int | None = None,
    ) -> None:
        self.path = Path(path)
        self.iteration: int | None = None
        self.captured = 0
        self._env, self._purpose, self._flush_every = env, purpose, flush_every
        for error in recorded_errors(list(env_ids), env.num_envs):
            raise error
        paths = [EnvPaths(f"env_{i}" if len(env_ids) > 1 else "") for i in env_ids]
        self._environments = [RecordedEnvironment(env, i, paths[n], n) for n, i in enumerate(env_ids)]
        self._events = EventLog(env)
        self._scalars = TrainingScalars()
        self._documents: list[str] = []
        self._active, self._capturing, self._stale = False, False, False
        self._limit, self._last_words = -1, ""
        given = {"run_id": recording_id, **(about or {})}
        self._about = recorded_environment.own_facts(env, list(env_ids), purpose, given)
        go_on = keep_until is not None and self.path.exists()
        self._file = RecordingFile(self.path, recording_id=recording_id, name=name, aside=go_on)
        try:
            self._open(EarlierRecording(self.path, int(keep_until or 0)) if go_on else None)
        except BaseException:
            self._file.abandon()
            raise

    def frames_within(self, megabytes: float) -> int:
        """Return how many frames certainly fit into a recording of ``megabytes`` MB."""
        return max(int((megabytes * recorded_environment.MEGABYTE - self._static_bytes()) / self._frame_bytes()), 0)

    def megabytes(self, frames: int) -> float:
        """Return a size in MB, rounded up to a tenth, that a recording of the given number of frames cannot exceed."""
        room = frames * self._frame_bytes() + self._static_bytes()
        return float(np.ceil(10.0 * room / recorded_environment.MEGABYTE) / 10.0)

    def _static_bytes(self) -> float:
        # Return an upper bound for the bytes of a recording's shapes, texts, and names.
        model, environments = self._env.scene.model, len(self._environments)
        return float(environments * (_FACE * model.nmeshface + _CELL * model.nhfielddata) + _TEXTS)

    def _frame_bytes(self) -> float:
        return sum(recorded.frame_bytes(ROWS_TOGETHER) for recorded in self._environments)

    def start(self, iteration: int | None = None, steps: int | None = None, *, last_words: str = "") -> None:
        """Start a segment: from now on, ``capture`` records every selected environment.

        After ``steps`` frames (None: no limit), the recording pauses and logs the message ``last_words``. Each recorded
        frame contains the training iteration in the attribute ``iteration``, which this method sets.
        """
        self.iteration, self.captured = iteration, 0
        self._limit, self._last_words = -1 if steps is None else steps, last_words
        self._active = steps is None or steps > 0

    def sample(self, due: int, enough: int, most: int) -> None:
        """Start or resume a sample: from now on, ``capture`` records complete episodes of each selected environment.

        Only episodes that start after the control step ``due`` are recorded. After ``enough`` frames of an environment
        (0: no frames), recording stops at the end of its current episode; after ``most`` frames, at once.
        """
        now = self._env.common_step_counter
        for recorded in self._environments:
            last = recorded.sample.steps[-1] if recorded.sample.steps else -1
            goes_on = last == now and int(self._env.episode_length_buf[recorded.env_id]) > 0
            taken = len(recorded.sample.steps) - bisect_right(recorded.sample.steps, due)
            recorded.sample.begin(enough, most, taken=taken, is_in_episode=goes_on)

    def frames_until(self, step: int) -> int:
        """Return the number of frames up to the control step ``step`` in the environment with the most frames."""
        return max(bisect_right(recorded.sample.steps, step) for recorded in self._environments)

    def stop(self) -> None:
        """Stop recording motion and write the buffered frames to the recording."""
        self._active = False
        self.flush()

    def capture(self) -> None:
        """Record the environments' states after a control step, if ``start`` or ``sample`` started a recording."""
        step = self._env.common_step_counter
        self._events.look_back(step - 1)
        lengths = host_copy(self._env.episode_length_buf)
        taken = [t for t in self._environments if self._active or t.sample.takes(int(lengths[t.env_id]))]
        if not taken:
            return
        self._capturing = True
        try:
            dones, stamp = host_copy(self._env.termination_manager.dones), self._stamp(step)
            for recorded in taken:
                recorded.capture(stamp, int(lengths[recorded.env_id]), ends=bool(dones[recorded.env_id]))
            self._events.captured(stamp, [(recorded.env_id, recorded.paths) for recorded in taken])
            self.captured += 1
            if self.captured == self._limit:
                if self._last_words:
                    self.say(self._last_words)
                self.stop()
            elif self._flush_every is not None and len(taken[0].stamps) >= self._flush_every:
                self.flush()
        finally:
            self._capturing = False

    def scalars(self, values: Mapping[str, float], iteration: int) -> None:
        """Record a training iteration's scalars. The scalar ``a/b`` becomes the Rerun entity ``training/a/b``."""
        if self._scalars.add(self._stamp(self._env.common_step_counter, iteration), values):
            self._stale = True

    def say(self, text: str, level: str = "WARN") -> None:
        """Log a message about the recording itself, such as that the recording reached its size limit."""
        self._events.say(text, level, self._stamp(self._env.common_step_counter))

    def document(self, name: str, text: str) -> None:
        """Record a markdown text as ``documents/<name>``, which replaces an earlier text with the same name."""
        archetype = rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN)
        self._file.static(layout.join(layout.DOCUMENTS, name), archetype)
        if name not in self._documents:
            self._documents.append(name)
            self._stale = True

    def has_document(self, name: str) -> bool:
        """Return whether the recording, or the recording that it resumes, contains the text document ``name``."""
        return name in self._documents

    def flush(self, *, everything: bool = True) -> None:
        """Write the buffered data to the recording. Raise SimulationFailure if writing fails, such as on a full disk.

        Without ``everything``, small amounts stay in memory: scalars of a few iterations, and a few frames.
        """
        if not self._capturing:
            self._events.look_back(self._env.common_step_counter)
        for recorded in self._environments:
            if recorded.stamps and (everything or len(recorded.stamps) >= ROWS_TOGETHER):
                moments = times(recorded.stamps)
                for entity, columns in recorded.columns():
                    self._file.columns(entity, moments, columns)
                recorded.clear()
        for entity, stamps, columns in (*self._events.pieces(), *self._scalars.pieces(everything=everything)):
            self._file.columns(entity, times(stamps), columns)
        if self._stale:
            layouts, purpose, documents, training = self.layout_state()
            self._file.blueprint(blueprint(layouts, purpose, documents=documents, training=training))
            self._stale = False
        self._file.flush()

    def close(self) -> None:
        """Write the buffered data, and close the recording's file. A second call does nothing."""
        self._active = False
        if self._file.is_open:
            try:
                self.flush()
            finally:
                self._file.close()

    @property
    def unfinished(self) -> str | None:
        """The reason why the closed recording has no index, such as a full disk; None if there is no such reason."""
        return self._file.unfinished

    def layout_state(self) -> tuple[list[EnvLayout], Purpose, list[str], list[str]]:
        """Return the arguments of ``blueprint``: layouts, purpose, names of texts, keys of training scalars."""
        layouts = [recorded.layout for recorded in self._environments]
        return layouts, self._purpose, list(self._documents), list(self._scalars.keys)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _open(self, earlier: EarlierRecording | None) -> None:
        """Write the rows of the resumed recording, and all static data: properties, shapes, names, and the layout."""
        if earlier is not None:
            self._file.chunks(earlier.chunks)
            self._about["started"] = earlier.started
            self._documents = list(earlier.documents)
            self._scalars = TrainingScalars(earlier.keys)
            for recorded in self._environments:
                number, step = (earlier.last.get(recorded.paths.data("episode", name)) for name in ("number", "step"))
                if number is not None and step is not None:
                    recorded.episodes.restore(int(number[1]), step[0], int(step[1]))
                recorded.sample.steps = sorted(earlier.steps[recorded.paths.data("episode", "step")])
        self._file.property(layout.OWN, self._about)
        robot = recorded_environment.robot_facts(self._env, self._environments[0].layout)
        self._file.property(recorded_environment.ROBOT, robot)
        self._file.static("/", rr.ViewCoordinates.RIGHT_HAND_Z_UP)
        seen: set[str] = set()
        for recorded in self._environments:
            for entity, archetypes in recorded.statics():
                self._file.static(entity, *archetypes)
            for entity in (entity for channel in recorded.frames.channels for entity in channel.entities):
                if entity in seen:
                    key = f"env.{entity.replace('/', '.')}"
                    message = f"two channels would be recorded at '{entity}'"
                    raise ConfigError(message, key=key, expected="a term of another name")
                seen.add(entity)
        for entity, archetypes in self._environments[0].surroundings():
            self._file.static(entity, *archetypes)
        self._stale = True
        self._file.take_place()

    def _stamp(self, step: int, iteration: int | None = None) -> Stamp:
        iteration = self.iteration if iteration is None else iteration
        return Stamp(step, 1000 * round(step * self._env.step_dt * _US), -1 if iteration is None else iteration)


def times(stamps: Sequence[Stamp]) -> list[rr.TimeColumn]:
    """Return the times of frames as Rerun columns, without ``iteration`` if any frame has no training iteration."""
    steps, moments, iterations = (np.array(values, np.int64) for values in zip(*map(astuple, stamps), strict=True))
    sim_times = rr.TimeColumn(layout.SIM_TIME, duration=moments.astype("timedelta64[ns]"))
    columns = [rr.TimeColumn(layout.STEP, sequence=steps), sim_times]
    with_iteration = bool((iterations >= 0).all())
    return [*columns, rr.TimeColumn(layout.ITERATION, sequence=iterations)] if with_iteration else columns
