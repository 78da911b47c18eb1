"""TensorBoard's event files, cut behind a checkpoint so that a resumed run has each step once.

A file is a row of records: length (8 bytes), checksum of the length, content, checksum of the content. The content is
an ``Event`` message: the file's version first, then scalars by step.
"""

from __future__ import annotations

import struct
import time
from collections import defaultdict
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from google.protobuf.message import DecodeError  # type: ignore[import-untyped]
from tensorboard.compat.proto.event_pb2 import Event  # type: ignore[import-untyped]
from tensorboard.compat.tensorflow_stub.pywrap_tensorflow import masked_crc32c  # type: ignore[import-untyped]
from torch.utils.tensorboard import SummaryWriter

from wheelleg_exp.files import cut, for_people, read_bytes

PATTERN = "events.out.tfevents.*"
_HEADER, _FOOTER = 12, 4


def event_files(folder: Path) -> list[Path]:
    """Return the event files of a run, the oldest first."""
    return sorted(folder.glob(PATTERN))


def open_events(folder: Path) -> SummaryWriter:
    """Return the writer of a new event file, which TensorBoard reads after those that are there.

    It reads them by name: the second in which one was begun, then process and number as text. So two never begin in
    one second.
    """
    seconds = {path.name.removeprefix(PATTERN[:-1])[:10] for path in event_files(folder)}
    if f"{int(time.time()):010d}" in seconds:
        time.sleep(1.0)
    return SummaryWriter(log_dir=str(folder))


def cut_events(folder: Path, lines: Sequence[Mapping[str, Any]]) -> None:
    """Let the event files hold the scalars of ``lines`` and nothing else.

    What stands past them is dropped. Files that lack some of them, as after a loss of data, are written anew.

    Args:
        folder: the run directory.
        lines: the iterations that stay, as the log of iterations has them.

    Raises:
        SimulationFailure: the disk is full.
    """
    found: dict[int, set[str]] = defaultdict(set)
    for path in event_files(folder):
        _cut_file(path, len(lines), found)
    if any(not set(line["scalars"]) <= found[index] for index, line in enumerate(lines)):
        _write_anew(folder, lines)


def _cut_file(path: Path, steps: int, found: dict[int, set[str]]) -> None:
    """Drop everything from the first record past ``steps`` on; note the tags that stay, by step."""
    end, kept = 0, 0
    for event, stop in _events(path):
        tags = [value.tag for value in event.summary.value]
        if tags and not 0 <= event.step < steps:
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


def _events(path: Path) -> Iterator[tuple[Event, int]]:
    """Yield the whole records of a file with the positions at which they end."""
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


def _write_anew(folder: Path, lines: Collection[Mapping[str, Any]]) -> None:
    for path in event_files(folder):
        with for_people(path):
            path.unlink()
    with for_people(folder), open_events(folder) as writer:
        for line in lines:
            for key, value in line["scalars"].items():
                writer.add_scalar(key, float(value), line["iteration"])
