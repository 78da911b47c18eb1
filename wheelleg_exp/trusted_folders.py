"""The folders that this user has worked with on this machine: configs and sources that were named, or stood in.

A run directory may come from anybody, and so may the paths in it. A path that a run has recorded is used unasked only
when it leads to one of these folders.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

from wheelleg_exp.paths import cache_dir


def trust(folders: Iterable[Path]) -> None:
    """Note folders that the user has named, or stood in; where nothing can be written a later command asks again."""
    known = _known()
    new = [place for place in dict.fromkeys(map(os.path.realpath, folders)) if place not in known]
    with suppress(OSError):
        if new:
            _file().parent.mkdir(parents=True, exist_ok=True)
            with _file().open("a", encoding="utf-8", errors="surrogateescape") as lines:
                lines.writelines(f"{place}\n" for place in new if "\n" not in place)


def is_trusted(path: str | Path) -> bool:
    """Return whether a path leads to a folder that was noted."""
    return real(path) in _known() - {""}


def real(path: str | Path) -> str:
    """Return what a path leads to, absolute and without links; nothing for a text that is no path."""
    try:
        return os.path.realpath(path)
    except ValueError:  # a zero in it
        return ""


def _known() -> set[str]:
    try:
        return set(_file().read_text(encoding="utf-8", errors="surrogateescape").split("\n"))
    except OSError:
        return set()


def _file() -> Path:
    return cache_dir() / "trusted_folders.txt"
