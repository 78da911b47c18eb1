"""The recording of a training: sample episodes every so many iterations, and every iteration's scalars."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

from wheelleg_exp.env import ManagerBasedRLEnv
from wheelleg_exp.jobs.documents import run_documents
from wheelleg_exp.jobs.observing_recording import ObservingRecording
from wheelleg_exp.recording.aside import make_way
from wheelleg_exp.recording.options import RecordingOptions
from wheelleg_exp.recording.recorder import Recorder
from wheelleg_exp.run.directory import RunDirectory
from wheelleg_exp.run.inventory import MANIFEST_NAME


class TrainingRecording(ObservingRecording):
    """Records a training, from entering to leaving.

    Every iteration is in the file when ``write`` returns; of rollouts of less than 16 steps, the last few frames may
    wait for the next. A segment of motion begins with every ``interval``-th iteration, as long as the bound on the size
    leaves room for a whole one. Which segments there are follows from the
    numbers of the options alone, so that a recording that was gone on with holds what an uninterrupted one holds.

    Args:
        directory: the run directory.
        env: the environment.
        options: what is recorded.
        documents: texts that go into the recording, by name, besides those that the run directory tells.
        start_iteration: the first iteration that is still to come; above 0 the run's recording is gone on with: what
            lies past the environment's present control step is dropped, and a segment under way continues.

    Attributes:
        note: what people should know of it: what became of an earlier recording that could not be gone on with, and
            whether the bound on the size leaves room for a segment; None when there is nothing to tell.
    """

    def __init__(
        self,
        directory: RunDirectory,
        env: ManagerBasedRLEnv,
        options: RecordingOptions,
        documents: Mapping[str, str],
        *,
        start_iteration: int = 0,
    ) -> None:
        aside = make_way(directory.recording, go_on=start_iteration > 0)
        recorder = Recorder(
            directory.recording,
            env,
            recording_id=directory.id,
            name=directory.id,
            env_ids=options.env_ids,
            purpose="training",
            about={"task": _task(directory)},
            keep_until=env.common_step_counter if start_iteration > 0 else None,
        )
        super().__init__(env, recorder, live=options.live)
        self._options, self._first = options, start_iteration
        for name, text in {**run_documents(directory), **documents}.items():
            if name != "manifest" or not self._recorder.has_document(name):  # that of the start stays
                self._recorder.document(name, text)
        if aside:
            self._recorder.say(f"{aside}; this one begins with iteration {start_iteration}")
        frames = self._recorder.frames_within(options.max_mb)
        self._segments = frames // options.steps
        self.notes = [note for note in (aside, self._warning()) if note]
        self.note = "; ".join(self.notes) or None

    def _begin_recording(self) -> None:
        self._begin(self._first)
        if self._first == 0:
            self._tell_bound(0)

    def _warning(self) -> str | None:
        """Return that not even one segment fits, and what would do; None when one does."""
        if self._segments:
            return None
        steps, bound = self._options.steps, self._options.max_mb
        return (
            f"recording.max_mb={bound:g} leaves no room for a segment of {steps} steps beside shapes and texts, so no "
            f"motion is recorded; {self._recorder.megabytes(steps):.1f} are enough for one"
        )

    @property
    def unfinished(self) -> str | None:
        """Why the file was not put together when it was closed; None when it was, or is open."""
        return self._recorder.unfinished

    def write(self, scalars: Mapping[str, float], iteration: int) -> None:
        """Write one iteration's scalars, and start the next recorded episode when it is due."""
        self._recorder.scalars(scalars, iteration)
        following = iteration + 1
        if following % self._options.interval == 0:
            self._recorder.stop()
            self._begin(following)
            self._tell_bound(following)
        else:
            self._recorder.flush(everything=False)
            self._recorder.iteration = following
        if self._live is not None:
            self._live.show()

    def flush(self) -> None:
        """Bring everything so far into the file."""
        self._recorder.flush()

    def _begin(self, iteration: int) -> None:
        """Begin the segment that ``iteration`` belongs to, or go on with it."""
        number, since = divmod(iteration, self._options.interval)
        self._recorder.iteration = iteration
        if number < self._segments:
            done = since * (self._env.common_step_counter // iteration) if iteration else 0
            self._recorder.start(iteration, self._options.steps, captured=done)

    def _tell_bound(self, iteration: int) -> None:
        """Mark the iteration with which the first segment would begin that does not fit any more."""
        number = iteration // self._options.interval
        if number == self._segments == 0:
            self._recorder.say(str(self._warning()))
        elif number == self._segments:
            self._recorder.say(
                f"the bound of {self._options.max_mb:g} MB is reached after {number} recorded episodes; "
                "from here on there are scalars alone"
            )


def _task(directory: RunDirectory) -> Any:
    try:
        return json.loads((directory.path / MANIFEST_NAME).read_text(encoding="utf-8"))["task"]
    except (OSError, ValueError, LookupError):
        return None
