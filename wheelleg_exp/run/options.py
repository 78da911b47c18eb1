"""What may stand under ``run.`` in the config."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from wheelleg_exp.constraints import NonNegative, Pattern

NAME = r"[A-Za-z0-9][A-Za-z0-9._-]{0,99}"  # what may be part of a folder's name
NAME_WORDS = "up to 100 letters, digits, '.', '_' and '-', beginning with a letter or digit"


@dataclass
class RunOptions:
    """Where a run is written, and how much of the source tree it keeps.

    Args:
        root: folder in which run directories are made; a relative one is below the working directory.
        name: last part of the run directory's name; letters, digits, ``.``, ``_`` and ``-``.
        max_patch_mb: largest source patch that is kept, in megabytes (10^6 bytes).
    """

    root: str = "runs"
    name: Annotated[str, Pattern(NAME, NAME_WORDS)] | None = None
    max_patch_mb: NonNegative = 50.0
