"""Write the output files of a training: logs, recordings, films, datasets, and checkpoints."""

from __future__ import annotations

import json
from collections.abc import Mapping
from contextlib import ExitStack
from types import TracebackType

from torch.utils.tensorboard import SummaryWriter

from wheelleg_exp.errors import RunDirectoryError
from wheelleg_exp.files import for_people, json_plain, sync, write_bytes
from wheelleg_exp.jobs.rollout_files import close_dataset, write_dataset
from wheelleg_exp.jobs.train.prepare_training import Training
from wheelleg_exp.jobs.train.scalar_logs import WandbLog, event_files, open_events
from wheelleg_exp.jobs.train.training_recording import Films, TrainingRecording
from wheelleg_exp.rl import checkpoint, digests
from wheelleg_exp.rl.options import Learning
from wheelleg_exp.rl.ranks import digests_of_all, state_of_all_ranks
from wheelleg_exp.rl.trainer import Iteration, Trainer


class Outputs:
    """The output files of a running training, which are readable at any moment and closed on exit.

    Logs are synced before each checkpoint. ``diverged_after`` is the first iteration after which ranks differ, or None.
    """

    def __init__(self, training: Training) -> None:
        recipe = training.recipe
        self._directory, self._trainer = training.directory, training.trainer
        self._options = recipe.experiment.recording
        self._documents = {"config": f"```yaml\n{recipe.hydra_files['config.yaml']}\n```"}
        self._logger = recipe.experiment.agent.logger
        self.wandb = WandbLog(training.directory, recipe.config) if self._logger == "wandb" else None
        self._tensorboard: SummaryWriter | None = None
        self.recording: TrainingRecording | None = None
        self.films: Films | None = None
        self._state: dict[str, object] = {}
        self._last: int | None = None
        self.diverged_after: int | None = None

    def __enter__(self) -> Outputs:
        env, start = self._trainer.env.env, self._trainer.iteration
        with ExitStack() as opened:
            if self._logger is not None:
                self._tensorboard = open_events(self._directory.path)
                opened.callback(self._tensorboard.close)
            self._lines = opened.enter_context(self._directory.iterations.open("a", encoding="utf-8"))
            if self._options.enabled:
                own = (self._directory, env, self._options, self._documents)
                self.recording = opened.enter_context(TrainingRecording(*own, start_iteration=start))
            if self._options.video_every:
                self.films = opened.enter_context(Films(self._directory.videos, env, self._options, start))
            if self.wandb is not None:
                opened.enter_context(self.wandb)
            self._opened = opened.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            if error is None and self._last is not None:
                close_dataset(self._directory.dataset, self._trainer.env.env, self._last)
        finally:
            try:
                self._opened.__exit__(kind, error, trace)
            except BaseException as second:
                if error is None:
                    raise
                # Report the training's error instead of a later error from closing files.
                error.add_note(f"the files could not be closed: {second}")

    def write(self, iteration: Iteration, due: bool) -> dict[str, str]:
        """Write the scalars and state digests of an iteration; return the digests. If ``due``, a checkpoint follows."""
        # Do not create a new, incomplete run directory if the user has removed the directory.
        if not self._directory.iterations.exists():
            message = f"'{self._directory.path}' was removed while it was written"
            raise RunDirectoryError(message, expected="a folder that exists until the end")
        if self._tensorboard is not None:
            for key, value in iteration.scalars.items():
                self._tensorboard.add_scalar(key, value, iteration.index)
            self._tensorboard.flush()
        self._state, self._last = self._trainer.state_dict(), iteration.index
        found, equal = digests_of_all(self._trainer.ranks, digested(self._trainer, self._state, due))
        if not equal and self.diverged_after is None:
            self.diverged_after = iteration.index
        line: dict[str, object] = {"iteration": iteration.index, "digest_format": digests.FORMAT}
        line |= {"digests": found, "scalars": iteration.scalars}
        with for_people(self._directory.iterations):
            self._lines.write(json.dumps(json_plain(line), allow_nan=False) + "\n")
            self._lines.flush()
        if self.recording is not None:
            self.recording.write(iteration.scalars, iteration.index)
        if self.wandb is not None:
            self.wandb.write(iteration.scalars, iteration.index)
        if self.films is not None:
            self.films.write(iteration.index)
        write_dataset(self._directory.dataset, self._trainer.env.env, f"{iteration.index:06d}.npz")
        return found

    def checkpoint(self, iteration: int) -> str:
        """Write the checkpoint ``model_<iteration>.pt`` of the last iteration, and return the checkpoint's name."""
        if self.recording is not None:
            self.recording.flush()
        for path in (self._directory.iterations, self._directory.recording, *event_files(self._directory.path)):
            sync(path)
        name, state = f"model_{iteration}.pt", state_of_all_ranks(self._trainer.ranks, self._state)
        write_bytes(self._directory.path / name, checkpoint.serialize(state))
        return name

    def last_checkpoint(self) -> str | None:
        """Write the checkpoint of the last iteration unless it exists; return its name, or None before iteration 0."""
        if self._last is None:
            return None
        name = f"model_{self._last}.pt"
        return name if (self._directory.path / name).is_file() else self.checkpoint(self._last)


def checkpoint_due(iteration: int, agent: Learning) -> bool:
    """Return whether an iteration always has a checkpoint: every ``save_interval`` iterations, and the last one."""
    return iteration + 1 == agent.max_iterations or iteration % agent.save_interval == 0


def digested(trainer: Trainer, state: dict[str, object], due: bool) -> dict[str, object]:
    """Return the part of the training state that is hashed for the run's log."""
    # Hash the whole training state if a checkpoint is due or if the physics engine is bitwise reproducible.
    # If the physics engine is not reproducible, hash only the networks, because no run can reproduce the whole state.
    # On a GPU, hashing the whole state takes longer than a training iteration.
    return state if due or trainer.env.env.scene.sim.exact else digests.networks(state)


def summary(scalars: Mapping[str, object]) -> dict[str, object]:
    """Return those final scalars of a training, such as the mean reward, that the run's manifest records."""
    keys = ("Train/mean_reward", "Train/mean_episode_length", "Policy/mean_std")
    chosen = {key: scalars[key] for key in keys if key in scalars}
    return chosen | {k: v for k, v in scalars.items() if k.startswith("Episode_Termination/")}
