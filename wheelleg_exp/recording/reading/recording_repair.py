"""Repair a recording that was cut off or damaged."""

from __future__ import annotations

import os
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from wheelleg_exp.errors import RunDirectoryError
from wheelleg_exp.files import for_people, temporary_name
from wheelleg_exp.recording.reading.recording_contents import Contents, Health, closed_copy


@dataclass(frozen=True)
class Repaired:
    """The result of a repair.

    Attributes:
        path: the recording, which does not change.
        output: the repaired file; None when the recording is whole.
        health: how much of the recording can be read.
    """

    path: Path
    output: Path | None
    health: Health


def repair(path: Path, output: Path | None = None) -> Repaired:
    """Write every readable message of a recording, with an index, to another file.

    Args:
        path: the recording.
        output: the repaired file; by default ``<name>.repaired.rrd`` in the same folder.

    Raises:
        RunDirectoryError: nothing of the recording can be read, or the output exists or cannot be written.
    """
    health = Contents(path).health
    if health.is_whole:
        return Repaired(path, None, health)
    output = output or path.with_name(f"{path.stem}.repaired.rrd")
    _require_free(output)
    written = temporary_name(output)
    try:
        with closed_copy(path) as (closed, _), for_people(output):
            output.parent.mkdir(parents=True, exist_ok=True)
            written.write_bytes(closed.read_bytes())
            try:
                os.link(written, output)  # fails when the name was taken meanwhile
            except FileExistsError:
                _require_free(output)
    finally:
        with suppress(OSError):
            written.unlink(missing_ok=True)
    return Repaired(path, output, health)


def _require_free(output: Path) -> None:
    if output.exists() or output.is_symlink():
        raise RunDirectoryError(f"'{output}' exists and is not overwritten", expected="a free path (-o)")
