"""The teacher of a distillation: found as the config names it, kept beside the robot, and read from there."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from wheelleg_exp.asset import CachedConversion
from wheelleg_exp.errors import ConfigError, RunDirectoryError
from wheelleg_exp.paths import TEACHER
from wheelleg_exp.rl import checkpoint
from wheelleg_exp.run.directory import RunDirectory

_KEY = "agent.teacher_checkpoint"


def find_teacher(config: Mapping[str, Any]) -> dict[str, Path]:
    """Return the file of the teacher's checkpoint by its name beside the robot; nothing where none is named.

    Raises:
        ConfigError: there is no such run or checkpoint, or it is damaged.
    """
    named = config["agent"].get("teacher_checkpoint")
    if named is None:
        return {}
    try:
        path = Path(named)
        if not path.is_file():
            path = RunDirectory.open(named, config["run"]["root"]).latest_checkpoint()
        checkpoint.load(path)
    except RunDirectoryError as error:
        message = error.message if error.key is None else f"'{error.key}' {error.message}"
        raise ConfigError(message, key=_KEY, expected=error.expected, nearest=error.nearest) from error
    return {TEACHER: path}


def kept_teacher(asset: CachedConversion) -> dict[str, Any] | None:
    """Return the teacher's checkpoint that lies beside a robot; None where none does."""
    path = asset.output.parent / TEACHER
    return checkpoint.load(path) if path.is_file() else None
