"""Log the scalars of a training to TensorBoard's event files and to Weights & Biases.

An event file is a sequence of records: length (8 bytes), checksum of the length, content (an ``Event`` message),
checksum of the content. Weights & Biases receives only name, config, and scalars of a run. rsl_rl's own writer is not
used: it also sends the local path and a git diff, and uploads every video.
"""

from __future__ import annotations

import os
import struct
import time
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from google.protobuf.message import DecodeError
from tensorboard.compat.proto.event_pb2 import Event
from tensorboard.compat.tensorflow_stub.pywrap_tensorflow import masked_crc32c
from torch.utils.tensorboard import SummaryWriter

from wheelleg_exp.errors import WheellegError
from wheelleg_exp.files import cut, for_people, read_bytes
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
    """A context manager that sends the scalars of a training to Weights & Biases, under one id also after a resume."""

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
