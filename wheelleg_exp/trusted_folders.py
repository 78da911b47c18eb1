"""The folders that this user has trusted on this machine, by naming them with ``--config-dir``.

Anybody may have written a record (of a run, a pipeline, a result), so its paths are not trusted. A recorded path is
used only if it leads to one of these folders or to the current project. Only ``cli/main.py`` adds folders: it knows
what the user typed.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

from wheelleg_exp.paths import cache_dir


def trust(folders: Iterable[Path]) -> None:
    """Record existing folders that the user has typed; if the file cannot be written, a later command asks again."""
    known = _known()
    existing = map(os.path.realpath, filter(Path.is_dir, folders))
    new = [place for place in dict.fromkeys(existing) if place not in known]
    with suppress(OSError):
        if new:
            _file().parent.mkdir(parents=True, exist_ok=True)
            with _file().open("a", encoding="utf-8", errors="surrogateescape") as lines:
                lines.writelines(f"{place}\n" for place in new if "\n" not in place)


def is_trusted(path: str | Path) -> bool:
    """Return whether a path leads to a trusted folder."""
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
