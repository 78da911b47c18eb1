"""Write the output files of a training: logs, recordings, films, datasets, and checkpoints.

Scalars go to TensorBoard's event files, and to Weights & Biases, which receives only name, config, and scalars of a
run. rsl_rl's own writer is not used: it also sends the local path and a git diff, and uploads every video. An event
file is a sequence of records: length (8 bytes), checksum of the length, content (an ``Event`` message), checksum of the
content.
"""

from __future__ import annotations

import json
import os
import struct
import time
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType

from google.protobuf.message import DecodeError
from tensorboard.compat.proto.event_pb2 import Event
from tensorboard.compat.tensorflow_stub.pywrap_tensorflow import masked_crc32c
from torch.utils.tensorboard import SummaryWriter

from wheelleg_exp.errors import RunDirectoryError, WheellegError
from wheelleg_exp.files import cut, for_people, json_plain, read_bytes, sync, write_bytes
from wheelleg_exp.jobs.rollout_files import close_dataset, write_dataset
from wheelleg_exp.jobs.train.prepare_training import Training
from wheelleg_exp.jobs.train.training_recording import Films, TrainingRecording
from wheelleg_exp.rl import checkpoint, digests
from wheelleg_exp.rl.options import Learning
from wheelleg_exp.rl.ranks import digests_of_all, state_of_all_ranks
from wheelleg_exp.rl.trainer import Iteration, Trainer
from wheelleg_exp.run.iteration_log import LogLine
from wheelleg_exp.run.run_directory import RunDirectory

EVENT_FILES = "events.out.tfevents.*"
_HEADER, _FOOTER = 12, 4


def event_files(folder: Path) -> list[Path]:
    """Return the event files of a run, the oldest first."""
    return sorted(folder.glob(EVENT_FILES))


def open_events(folder: Path) -> SummaryWriter:
    """Return the writer of a new event file, which TensorBoard reads after all existing event files."""
    # TensorBoard sorts event files by the second of their creation, so create at most one file per second.
    seconds = {path.name.removeprefix(EVENT_FILES[:-1])[:10] for path in event_files(folder)}
    if f"{int(time.time()):010d}" in seconds:
        time.sleep(1.0)
    return SummaryWriter(log_dir=str(folder))


def cut_events(folder: Path, lines: Sequence[LogLine]) -> None:
    """From TensorBoard's event files, remove each scalar that the run's iteration log ``lines`` does not contain."""
    # If scalars are missing in the event files, write all scalars of the run's log into a new file.
    found: dict[int, set[str]] = defaultdict(set)
    for path in event_files(folder):
        # Cut each event file at its first scalar after the last logged iteration.
        end, kept = 0, 0
        for event, stop in _events(path):
            tags = [value.tag for value in event.summary.value]
            if tags and not 0 <= event.step < len(lines):
                break
            if tags:
                found[event.step].update(tags)
                kept += 1
            end = stop
        if kept:
            cut(path, end)
        else:
            with for_people(path):
                path.unlink()
    if any(not set(line["scalars"]) <= found[index] for index, line in enumerate(lines)):
        for path in event_files(folder):
            with for_people(path):
                path.unlink()
        with for_people(folder), open_events(folder) as writer:
            for line in lines:
                for key, value in line["scalars"].items():
                    writer.add_scalar(key, float(str(value)), line["iteration"])


def _events(path: Path) -> Iterator[tuple[Event, int]]:
    """Yield the complete records of a TensorBoard event file, each with its end position."""
    data = read_bytes(path)
    start = 0
    while start + _HEADER <= len(data):
        length, checksum = struct.unpack_from("<QI", data, start)
        stop = start + _HEADER + length + _FOOTER
        if checksum != masked_crc32c(data[start : start + 8]) or stop > len(data):
            return
        event = Event()
        try:
            event.ParseFromString(data[start + _HEADER : stop - _FOOTER])
        except DecodeError:
            return
        yield event, stop
        start = stop


# ``_WANDB_SETTINGS`` stop wandb from sending host name, program, packages, console output, and source code.
_WANDB_SETTINGS: dict[str, object] = {"console": "off", "host": "", "save_code": False, "x_save_requirements": False}
_WANDB_SETTINGS |= dict.fromkeys(("silent", "disable_code", "disable_git", "disable_job_creation"), True)
_WANDB_SETTINGS |= dict.fromkeys(("x_disable_machine_info", "x_disable_meta", "x_disable_stats"), True)


class WandbLog:
    """A context manager that sends the scalars of a training to Weights & Biases, under one id also after a resume.

    The environment variables of wandb (``WANDB_MODE``, ...) choose where wandb sends the scalars.
    """

    def __init__(self, directory: RunDirectory, config: Mapping[str, object]) -> None:
        self._directory, self._config = directory, config

    def __enter__(self) -> WandbLog:
        import wandb

        task, moment = self._directory.path.parent.name, self._directory.manifest().started
        try:
            self._run = wandb.init(
                project=os.environ.get("WANDB_PROJECT", "wheelleg_exp"),
                name=f"{task}/{self._directory.id}",
                id=f"{task}-{self._directory.id}-{moment:%f}",  # Microseconds make the wandb run's id unique.
                resume="allow",
                dir=os.environ.get("WANDB_DIR", str(self._directory.root)),
                config=dict(self._config),
                force=True,  # Without ``force``, wandb waits for a user to enter an API key.
                settings=wandb.Settings(**_WANDB_SETTINGS),
            )
        except wandb.Error as error:
            message = f"Weights & Biases cannot be reached: {str(error).splitlines()[0]}"
            expected = "a login ('wandb login'), or WANDB_MODE=offline in the environment"
            raise WheellegError(message, key="agent.logger", expected=expected) from error
        return self

    def __exit__(self, *error: object) -> None:
        self._run.finish(exit_code=0 if error[0] is None else 1)

    @property
    def place(self) -> str:
        """The web address of the run at Weights & Biases, or the local folder that ``wandb sync`` can upload."""
        return str(Path(self._run.dir).parent if self._run.offline else self._run.url)

    def write(self, scalars: Mapping[str, float], iteration: int) -> None:
        """Send the scalars of one iteration; Weights & Biases ignores iterations that it already has."""
        self._run.log(dict(scalars), step=iteration)


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
    # Hash the whole training state if a checkpoint is due or if the physics engine is bitwise reproducible on the CPU.
    # If the physics engine is not reproducible, hash only the networks, because no run can reproduce the whole state.
    # On a GPU, hash only the networks, too, because hashing the whole state takes longer than a training iteration.
    engine = trainer.env.env.scene.sim
    return state if due or (engine.exact and engine.device.type == "cpu") else digests.networks(state)


def summary(scalars: Mapping[str, object]) -> dict[str, object]:
    """Return those final scalars of a training, such as the mean reward, that the run's manifest records."""
    keys = ("Train/mean_reward", "Train/mean_episode_length", "Policy/mean_std")
    chosen = {key: scalars[key] for key in keys if key in scalars}
    return chosen | {k: v for k, v in scalars.items() if k.startswith("Episode_Termination/")}
