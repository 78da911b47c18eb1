"""What a training run writes as it goes: TensorBoard, ``iterations.jsonl``, the recording, checkpoints."""

from __future__ import annotations

import json
from collections.abc import Mapping
from contextlib import ExitStack
from types import TracebackType
from typing import Any

from torch.utils.tensorboard import SummaryWriter

from wheelleg_exp.jobs.event_files import event_files
from wheelleg_exp.jobs.log_files import sync
from wheelleg_exp.jobs.training_recording import TrainingRecording
from wheelleg_exp.recording.options import RecordingOptions
from wheelleg_exp.rl import checkpoint, digests
from wheelleg_exp.rl.trainer import Iteration, Trainer
from wheelleg_exp.run.directory import RunDirectory
from wheelleg_exp.run.files import for_people, json_plain, write_bytes


class Outputs:
    """The growing files of a run; readable at any moment, closed on exit.

    A checkpoint is written after all that tells of its iterations is on the disk: the logs of a run that broke off,
    by a power cut even, reach at least as far as its last checkpoint.

    Args:
        directory: the run directory.
        trainer: the training, at the iteration from which it goes on.
        options: what is recorded.
        documents: texts that go into the recording, by name.
        logger: ``tensorboard``, or None for no event files.
    """

    def __init__(
        self,
        directory: RunDirectory,
        trainer: Trainer,
        options: RecordingOptions,
        documents: Mapping[str, str],
        logger: str | None = "tensorboard",
    ) -> None:
        self._directory = directory
        self._trainer = trainer
        self._options = options
        self._documents = documents
        self._logger = logger
        self._tensorboard: SummaryWriter | None = None
        self._recording: TrainingRecording | None = None
        self._state: dict[str, Any] = {}

    def __enter__(self) -> Outputs:
        with ExitStack() as opened:
            if self._logger is not None:
                self._tensorboard = SummaryWriter(log_dir=str(self._directory.path))
                opened.callback(self._tensorboard.close)
            self._lines = opened.enter_context(self._directory.iterations.open("a", encoding="utf-8"))
            if self._options.enabled:
                self._recording = opened.enter_context(self._training_recording())
            self._close = opened.pop_all().close
        return self

    def _training_recording(self) -> TrainingRecording:
        return TrainingRecording(
            self._directory,
            self._trainer.env.env,
            self._options,
            self._documents,
            start_iteration=self._trainer.iteration,
        )

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._close()

    @property
    def note(self) -> str | None:
        """What became of an earlier recording that could not be gone on with."""
        return None if self._recording is None else self._recording.note

    @property
    def unfinished(self) -> str | None:
        """Why the recording was not put together when it was closed, for want of room or of rerun's program."""
        return None if self._recording is None else self._recording.unfinished

    def write(self, iteration: Iteration) -> dict[str, str]:
        """Write one iteration's scalars and digests; return the digests.

        The next recorded episode begins here when it is due.
        """
        if self._tensorboard is not None:
            for key, value in iteration.scalars.items():
                self._tensorboard.add_scalar(key, value, iteration.index)
            self._tensorboard.flush()
        self._state = self._trainer.state_dict()
        found = digests.of_state(self._state)
        line = {
            "iteration": iteration.index,
            "digest_format": digests.FORMAT,
            "digests": found,
            "scalars": iteration.scalars,
        }
        with for_people(self._directory.iterations):
            self._lines.write(json.dumps(json_plain(line), allow_nan=False) + "\n")
            self._lines.flush()
        if self._recording is not None:
            self._recording.write(iteration.scalars, iteration.index)
        return found

    def checkpoint(self, iteration: int) -> str:
        """Write ``model_<iteration>.pt`` of the iteration that was written last, and return its name."""
        if self._recording is not None:
            self._recording.flush()
        for path in (self._directory.iterations, self._directory.recording, *event_files(self._directory.path)):
            sync(path)
        name = f"model_{iteration}.pt"
        write_bytes(self._directory.path / name, checkpoint.serialize(self._state))
        return name


def summary(scalars: Mapping[str, Any]) -> dict[str, Any]:
    """Return the scalars that tell how training ended, for the manifest."""
    keys = ("Train/mean_reward", "Train/mean_episode_length", "Policy/mean_std")
    chosen = {key: scalars[key] for key in keys if key in scalars}
    return chosen | {k: v for k, v in scalars.items() if k.startswith("Episode_Termination/")}
