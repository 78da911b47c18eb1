"""The recording of a training: sample episodes every so many iterations, and every iteration's scalars."""

from __future__ import annotations

from collections.abc import Mapping
from types import TracebackType
from typing import Self

from wheelleg_exp.env import ManagerBasedRLEnv
from wheelleg_exp.recording.options import RecordingOptions
from wheelleg_exp.recording.recorder import Recorder
from wheelleg_exp.run.directory import RunDirectory


class TrainingRecording:
    """Records a training, from entering to leaving.

    Args:
        directory: the run directory.
        env: the environment.
        options: what is recorded.
        documents: texts that go into the recording, by name.
    """

    def __init__(
        self,
        directory: RunDirectory,
        env: ManagerBasedRLEnv,
        options: RecordingOptions,
        documents: Mapping[str, str],
    ) -> None:
        self._env, self._options = env, options
        self._recorder = Recorder(
            directory.recording,
            env,
            recording_id=directory.id,
            name=directory.id,
            env_ids=options.env_ids,
            purpose="training",
        )
        for name, text in documents.items():
            self._recorder.document(name, text)

    def __enter__(self) -> Self:
        self._env.observers.append(self._recorder.capture)
        self._recorder.start(0, self._options.steps)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._env.observers.remove(self._recorder.capture)
        self._recorder.close()

    def write(self, scalars: Mapping[str, float], iteration: int) -> None:
        """Write one iteration's scalars, and start the next recorded episode when it is due."""
        self._recorder.scalars(scalars, iteration)
        following = iteration + 1
        if following % self._options.interval == 0:
            self._recorder.stop()
            self._recorder.start(following, self._options.steps)
        self._recorder.iteration = following

    def flush(self) -> None:
        """Bring everything so far into the file."""
        self._recorder.flush()
