"""Growing files, cut behind a checkpoint and brought to the disk."""

from __future__ import annotations

import os
from pathlib import Path

from wheelleg_exp.run.files import for_people


def cut(path: Path, size: int) -> None:
    """Drop what stands in a file past ``size`` bytes, on the disk as well."""
    if not path.exists():
        return
    with for_people(path):
        os.truncate(path, size)
    sync(path)


def sync(path: Path) -> None:
    """Bring a file's content to the disk, so that it outlives a power cut."""
    if not path.exists():
        return
    with for_people(path):
        descriptor = os.open(path, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
