"""What a training run writes as it goes: TensorBoard, ``iterations.jsonl``, the recording, checkpoints."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping
from contextlib import ExitStack
from types import TracebackType
from typing import Any

import torch
from torch.utils.tensorboard import SummaryWriter

from wheelleg_exp.jobs.training_recording import TrainingRecording
from wheelleg_exp.recording.options import RecordingOptions
from wheelleg_exp.rl import checkpoint
from wheelleg_exp.rl.trainer import Iteration, Trainer
from wheelleg_exp.run.directory import RunDirectory
from wheelleg_exp.run.files import for_people, json_plain, write_bytes

_DIGEST_LENGTH = 16


class Outputs:
    """The growing files of a run; readable at any moment, closed on exit.

    Args:
        directory: the run directory.
        trainer: the training.
        options: what is recorded.
        documents: texts that go into the recording, by name.
    """

    def __init__(
        self,
        directory: RunDirectory,
        trainer: Trainer,
        options: RecordingOptions,
        documents: Mapping[str, str],
    ) -> None:
        self._directory = directory
        self._trainer = trainer
        self._options = options
        self._documents = documents
        self._recording: TrainingRecording | None = None

    def __enter__(self) -> Outputs:
        with ExitStack() as opened:
            self._tensorboard = SummaryWriter(log_dir=str(self._directory.path))
            opened.callback(self._tensorboard.close)
            self._lines = opened.enter_context(self._directory.iterations.open("a", encoding="utf-8"))
            if self._options.enabled:
                made = TrainingRecording(self._directory, self._trainer.env.env, self._options, self._documents)
                self._recording = opened.enter_context(made)
            self._close = opened.pop_all().close
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._close()

    def write(self, iteration: Iteration) -> None:
        """Write one iteration's scalars and digests, and start the next recorded episode when it is due."""
        for key, value in iteration.scalars.items():
            self._tensorboard.add_scalar(key, value, iteration.index)
        self._tensorboard.flush()
        line = {"iteration": iteration.index, "digests": digests(self._trainer), "scalars": iteration.scalars}
        with for_people(self._directory.iterations):
            self._lines.write(json.dumps(json_plain(line), allow_nan=False) + "\n")
            self._lines.flush()
        if self._recording is not None:
            self._recording.write(iteration.scalars, iteration.index)

    def checkpoint(self, iteration: int) -> str:
        """Write ``model_<iteration>.pt`` and return its name."""
        name = f"model_{iteration}.pt"
        write_bytes(self._directory.path / name, checkpoint.serialize(self._trainer.state_dict()))
        if self._recording is not None:
            self._recording.flush()
        return name


def digests(trainer: Trainer) -> dict[str, str]:
    """Return short digests of the networks' parameters, the simulations' state and the random streams."""
    algorithm, env = trainer.algorithm, trainer.env.env
    parameters = [*algorithm.actor.state_dict().values(), *algorithm.critic.state_dict().values()]
    return {
        "parameters": _digest(parameters),
        "environment": _digest([env.scene.sim.state, env.episode_length_buf]),
        "streams": _digest([*env.streams.state_dict()["generators"].values(), torch.get_rng_state()]),
    }


def _digest(tensors: Iterable[torch.Tensor]) -> str:
    digest = hashlib.sha256()
    for tensor in tensors:
        digest.update(tensor.detach().cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()[:_DIGEST_LENGTH]


def summary(scalars: Mapping[str, float]) -> dict[str, Any]:
    """Return the scalars that tell how training ended, for the manifest."""
    keys = ("Train/mean_reward", "Train/mean_episode_length", "Policy/mean_std")
    chosen = {key: scalars[key] for key in keys if key in scalars}
    return chosen | {k: v for k, v in scalars.items() if k.startswith("Episode_Termination/")}
