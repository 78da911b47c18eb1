"""Keeping an earlier recording that cannot be gone on with."""

from __future__ import annotations

import os
from pathlib import Path

from wheelleg_exp.files import for_people
from wheelleg_exp.recording.writing.continuing import problem_with


def make_way(path: Path, *, go_on: bool) -> str | None:
    """Move an earlier recording aside unless it can be gone on with, and remove what an interrupted resume left.

    Args:
        path: the recording.
        go_on: whether the recording is to be gone on with; otherwise nothing stands there yet.

    Returns:
        What became of it, in words, None when there is nothing to tell.
    """
    if not go_on:
        return None
    for left in path.parent.glob(f".{path.name}.*.tmp"):
        left.unlink(missing_ok=True)
    if not path.exists():
        return "the earlier part of this recording is missing"
    problem = problem_with(path)
    if problem is None:
        return None
    return f"the earlier part of this recording stands in {_moved(path).name}: {problem}"


def _moved(path: Path) -> Path:
    """Give a file a name that nothing else has."""
    number = 1
    while True:
        target = path.with_name(f"{path.name}.damaged" + (f"-{number}" if number > 1 else ""))
        with for_people(target):
            try:
                os.link(path, target)
            except FileExistsError:
                number += 1
                continue
            path.unlink()
            return target
