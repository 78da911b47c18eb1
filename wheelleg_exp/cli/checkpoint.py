"""Which of a run's checkpoints a command is to take."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING

from wheelleg_exp.cli.printing.tables import hanging
from wheelleg_exp.errors import printable

if TYPE_CHECKING:
    from wheelleg_exp.run.directory import RunDirectory


def chosen_checkpoint(directory: RunDirectory, asked: str | None) -> Path:
    """Return the checkpoint that an iteration or a path names, or the last one; warn of one that was changed.

    Raises:
        RunDirectoryError: the run has no checkpoint, or none of that iteration, or its manifest is damaged.
    """
    checkpoint = _named(directory, asked)
    own = checkpoint.is_file() and checkpoint.resolve().parent == directory.path.resolve()
    if own and not directory.manifest().vouches_for(checkpoint):
        text = f"{checkpoint.name} is not what its run recorded; 'wheelleg verify RUN' tells what was changed"
        print(hanging(printable(f"warning: {text}"), 4), file=sys.stderr)
    return checkpoint


def _named(directory: RunDirectory, asked: str | None) -> Path:
    if asked is None:
        return directory.latest_checkpoint()
    if asked.isdigit():
        return directory.checkpoint(int(asked))
    inside = directory.path / asked
    return inside if inside.is_file() else Path(asked)
