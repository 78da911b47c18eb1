"""Reading evaluations that runs have kept, and finding the one that would be made again."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from wheelleg_exp.errors import RunDirectoryError
from wheelleg_exp.evaluation.result import FORMAT, Evaluation, Figure
from wheelleg_exp.files import for_people
from wheelleg_exp.jobs.evaluate.evaluate import EPISODES, RESULT, Evaluated
from wheelleg_exp.jobs.evaluate.settings import of_the_run
from wheelleg_exp.reading import Unreadable, json_value
from wheelleg_exp.run.directory import RunDirectory

_OWN = "an evaluation that wheelleg evaluate has written"


def read_content(folder: Path) -> dict[str, Any]:
    """Return what stands in a kept ``evaluation.json``.

    Raises:
        RunDirectoryError: it is missing or damaged, or of another version.
    """
    path = folder / RESULT
    try:
        with for_people(path, "read"):
            content = json_value(path.read_bytes())
    except Unreadable as error:
        raise RunDirectoryError(f"is damaged: {error.problem}", key=str(path), expected=_OWN) from error
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise RunDirectoryError(f"is no evaluation of format {FORMAT}", key=str(path), expected=_OWN)
    return content


def read_evaluation(folder: Path) -> Evaluation:
    """Return a kept evaluation, its episodes included.

    Raises:
        RunDirectoryError: a file of it is missing or damaged.
    """
    content = read_content(folder)
    try:
        metrics = {name: _figure(value) for name, value in content["metrics"].items()}
        kept = {key: content[key] for key in ("protocol", "seed", "scenarios_sha256", "starts_sha256", "about")}
        return Evaluation(episodes=read_episodes(folder / EPISODES), metrics=metrics, **kept)
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise RunDirectoryError(f"is damaged: {error!r}", key=str(folder), expected=_OWN) from error


def read_episodes(path: Path) -> dict[str, np.ndarray[Any, Any]]:
    """Return the columns of ``episodes.csv``: numbers, NaN where a cell is empty, or texts."""
    with for_people(path, "read"):
        rows = list(csv.reader(io.StringIO(path.read_text(encoding="utf-8"))))
    if not rows:
        raise RunDirectoryError("is empty", key=str(path), expected=_OWN)
    return {name: _column([row[i] for row in rows[1:]]) for i, name in enumerate(rows[0])}


def find_kept(run: RunDirectory, checkpoint: str, tree: Mapping[str, Any], overrides: Sequence[str]) -> Path | None:
    """Return the newest kept evaluation of a checkpoint under a protocol; None when there is none.

    Args:
        run: the run.
        checkpoint: the checkpoint's sha256.
        tree: what ``settings`` returns for the overrides: a protocol is the same in whatever words it was asked for.
        overrides: those of the run's own parameters and of the protocol.
    """
    asked = (checkpoint, tree["seed"], tree["protocol"], of_the_run(overrides))
    folders = [path.parent for path in run.evaluation.glob(f"*/{RESULT}")] if run.evaluation.is_dir() else []
    for folder in sorted(folders, reverse=True):
        content = read_content(folder)
        made = tuple(content.get(key) for key in ("checkpoint_sha256", "seed", "protocol"))
        if (*made, of_the_run(content.get("overrides") or [])) == asked:
            return folder
    return None


def as_evaluated(run: RunDirectory, checkpoint: Path, folder: Path) -> Evaluated:
    """Return a kept evaluation as if it had just been made."""
    return Evaluated(run, checkpoint, folder, read_evaluation(folder), read_content(folder))


def _figure(value: Mapping[str, Any]) -> Figure:
    numbers = {key: float("nan") if value[key] is None else float(value[key]) for key in ("value", "low", "high")}
    return Figure(**numbers, episodes=value["episodes"], unit=value["unit"], better=value["better"])


def _column(cells: Sequence[str]) -> np.ndarray[Any, Any]:
    try:
        return np.array([float(cell) if cell else np.nan for cell in cells])
    except ValueError:
        return np.array(cells)
