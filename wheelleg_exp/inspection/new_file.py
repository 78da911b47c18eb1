"""Writing files that are not there yet."""

from __future__ import annotations

from pathlib import Path

from wheelleg_exp.errors import RunDirectoryError
from wheelleg_exp.run.files import for_people, write_bytes


def require_new(path: Path) -> None:
    """Raise RunDirectoryError when there is something at ``path``."""
    if path.exists() or path.is_symlink():
        raise RunDirectoryError(f"'{path}' exists and is not overwritten", expected="a path that is not taken")


def write_new(path: Path, content: bytes) -> None:
    """Write a file that is not there yet, whole or not at all; its folder is made when missing.

    Raises:
        RunDirectoryError: the file exists, or cannot be written.
    """
    require_new(path)
    with for_people(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        write_bytes(path, content)
