"""Write the files of a running training: TensorBoard, ``iterations.jsonl``, recording, films, dataset, checkpoints."""

from __future__ import annotations

import io
import json
from collections.abc import Mapping
from contextlib import ExitStack
from types import TracebackType
from typing import Any

import numpy as np
from torch.utils.tensorboard import SummaryWriter

from wheelleg_exp.env import ManagerBasedRLEnv
from wheelleg_exp.errors import RunDirectoryError, SimulationFailure
from wheelleg_exp.files import for_people, json_plain, sync, write_bytes
from wheelleg_exp.jobs.rollout_files import close_dataset, write_dataset
from wheelleg_exp.jobs.train.scalar_logs import WandbLog, event_files, open_events
from wheelleg_exp.jobs.train.training_recording import Films, TrainingRecording
from wheelleg_exp.recording.recording_options import RecordingOptions
from wheelleg_exp.rl import checkpoint, digests
from wheelleg_exp.rl.ranks import digests_of_all, state_of_all_ranks
from wheelleg_exp.rl.trainer import Iteration, Trainer
from wheelleg_exp.run.manifest import Manifest
from wheelleg_exp.run.run_directory import FAILURE, RunDirectory


class Outputs:
    """The growing files of a run; readable at any moment, closed on exit.

    A checkpoint is written after the logs of its iterations are on the disk. So the logs of a run that was killed, even
    by a power failure, reach at least to its last checkpoint.

    Args:
        directory: the run directory.
        trainer: the training, at its first iteration.
        options: what is recorded.
        documents: texts for the recording, by name.
        events: whether to write TensorBoard's event files.
        wandb: the log of Weights & Biases, or None.

    Attributes:
        diverged_after: the first iteration after which the networks of the ranks differed, or None.
    """

    def __init__(
        self,
        directory: RunDirectory,
        trainer: Trainer,
        options: RecordingOptions,
        documents: Mapping[str, str],
        *,
        events: bool,
        wandb: WandbLog | None,
    ) -> None:
        self._directory = directory
        self._trainer = trainer
        self._options = options
        self._documents = documents
        self._events = events
        self._wandb = wandb
        self._tensorboard: SummaryWriter | None = None
        self._recording: TrainingRecording | None = None
        self._films: Films | None = None
        self._state: dict[str, Any] = {}
        self._last: int | None = None
        self.diverged_after: int | None = None

    def __enter__(self) -> Outputs:
        env, start = self._trainer.env.env, self._trainer.iteration
        with ExitStack() as opened:
            if self._events:
                self._tensorboard = open_events(self._directory.path)
                opened.callback(self._tensorboard.close)
            self._lines = opened.enter_context(self._directory.iterations.open("a", encoding="utf-8"))
            if self._options.enabled:
                self._recording = opened.enter_context(
                    TrainingRecording(self._directory, env, self._options, self._documents, start_iteration=start)
                )
            if self._options.video_every:
                self._films = opened.enter_context(Films(self._directory.videos, env, self._options, start))
            if self._wandb is not None:
                opened.enter_context(self._wandb)
            self._opened = opened.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            if error is None and self._last is not None:
                close_dataset(self._directory.dataset, self._trainer.env.env, self._last)
        finally:
            self._opened.__exit__(kind, error, trace)

    @property
    def note(self) -> str | None:
        """Why an earlier recording could not be continued; None if it was."""
        return None if self._recording is None else self._recording.note

    @property
    def unfinished(self) -> str | None:
        """Why the recording was not assembled when it was closed: no room, or no rerun program."""
        return None if self._recording is None else self._recording.unfinished

    @property
    def sent_to(self) -> str | None:
        """Where the scalars are sent; None if they stay in the run directory."""
        return None if self._wandb is None else self._wandb.place

    @property
    def missing_films(self) -> str | None:
        """Why films are missing; None if none are."""
        return None if self._films is None else self._films.ended

    def write(self, iteration: Iteration, due: bool) -> dict[str, str]:
        """Write the scalars and digests of one iteration, and start the next recorded episode if it is due.

        Args:
            iteration: the iteration.
            due: whether its checkpoint is due even if training is not stopped.

        Returns:
            The digests.

        Raises:
            RunDirectoryError: the run directory was removed.
        """
        if (
            not self._directory.iterations.exists()
        ):  # a checkpoint would create the folder again, with nothing else in it
            raise RunDirectoryError(
                f"'{self._directory.path}' was removed while it was written",
                expected="a folder that exists until the end",
            )
        if self._tensorboard is not None:
            for key, value in iteration.scalars.items():
                self._tensorboard.add_scalar(key, value, iteration.index)
            self._tensorboard.flush()
        self._state, self._last = self._trainer.state_dict(), iteration.index
        found, equal = digests_of_all(self._trainer.ranks, digested(self._trainer, self._state, due))
        if not equal and self.diverged_after is None:
            self.diverged_after = iteration.index
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
        if self._wandb is not None:
            self._wandb.write(iteration.scalars, iteration.index)
        if self._films is not None:
            self._films.write(iteration.index)
        write_dataset(self._directory.dataset, self._trainer.env.env, iteration.index)
        return found

    def checkpoint(self, iteration: int) -> str:
        """Write ``model_<iteration>.pt`` of the last written iteration, and return its name."""
        if self._recording is not None:
            self._recording.flush()
        for path in (self._directory.iterations, self._directory.recording, *event_files(self._directory.path)):
            sync(path)
        name = f"model_{iteration}.pt"
        write_bytes(
            self._directory.path / name, checkpoint.serialize(state_of_all_ranks(self._trainer.ranks, self._state))
        )
        return name

    def last_checkpoint(self) -> str | None:
        """Write the checkpoint of the last written iteration if it is missing; None before the first iteration."""
        if self._last is None:
            return None
        name = f"model_{self._last}.pt"
        return name if (self._directory.path / name).is_file() else self.checkpoint(self._last)


def checkpoint_due(iteration: int, agent: Mapping[str, Any]) -> bool:
    """Return whether an iteration always has a checkpoint: every ``save_interval`` iterations, and the last one."""
    return iteration + 1 == int(agent["max_iterations"]) or iteration % int(agent["save_interval"]) == 0


def digested(trainer: Trainer, state: dict[str, Any], due: bool) -> dict[str, Any]:
    """Return the part of an iteration's state to digest.

    All of it if a checkpoint is due or the engine is bitwise reproducible. Else only the networks: hashing the
    remaining state, which no later run can reproduce, takes longer than a GPU takes for an iteration.
    """
    return state if due or trainer.env.env.scene.sim.exact else digests.networks(state)


def summary(scalars: Mapping[str, Any]) -> dict[str, Any]:
    """Return the scalars that describe the end of a training, for the manifest."""
    keys = ("Train/mean_reward", "Train/mean_episode_length", "Policy/mean_std")
    chosen = {key: scalars[key] for key in keys if key in scalars}
    return chosen | {k: v for k, v in scalars.items() if k.startswith("Episode_Termination/")}


def save_failure(
    directory: RunDirectory, manifest: Manifest, error: SimulationFailure, iteration: int, env: ManagerBasedRLEnv
) -> None:
    """Write the evidence of a failed training: arrays by name, and ``about``, a JSON text that describes them."""
    entry: dict[str, Any] = {"file": FAILURE, "key": error.key, "iteration": iteration, "message": error.message}
    names = {
        "joints": env.scene.robot.joint_names,
        "bodies": env.scene.robot.body_names,
        "reward_terms": env.reward_manager.active_terms,
        "observations": env.observation_manager.active_terms,
    }
    arrays = {name: value.cpu().numpy() for name, value in error.evidence.items()}
    buffer = io.BytesIO()
    np.savez(buffer, allow_pickle=False, about=np.array(json.dumps({**entry, **names})), **arrays)
    write_bytes(directory.path / FAILURE, buffer.getvalue())
    manifest.record(failure=entry)
