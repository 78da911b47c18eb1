"""Repair a truncated or damaged Rerun recording."""

from __future__ import annotations

import os
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from wheelleg_exp.files import for_people, require_new, temporary_name
from wheelleg_exp.recording.reading.recording_contents import Contents, Health, closed_copy


@dataclass(frozen=True)
class Repaired:
    """A repair: the file that was read, its health, and the repaired file, None if the file that was read was whole."""

    path: Path
    output: Path | None
    health: Health


def repair(path: Path, output: Path | None = None) -> Repaired:
    """Write a repaired copy of a recording, which contains every readable message and an index.

    The default is ``<name>.repaired.rrd``. An unreadable recording or an existing output raises RunDirectoryError.
    """
    health = Contents(path).health
    if health.is_whole:
        return Repaired(path, None, health)
    output = output or path.with_name(f"{path.stem}.repaired.rrd")
    require_new(output)
    written = temporary_name(output)
    try:
        with closed_copy(path) as (closed, _), for_people(output):
            output.parent.mkdir(parents=True, exist_ok=True)
            written.write_bytes(closed.read_bytes())
            try:
                os.link(written, output)  # A hard link, unlike a rename, never replaces an existing file.
            except FileExistsError:
                require_new(output)
    finally:
        with suppress(OSError):
            written.unlink(missing_ok=True)
    return Repaired(path, output, health)
