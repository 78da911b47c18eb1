"""Write and read the saved evaluations of a run, and the margins that they measured."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from wheelleg_exp.errors import RunDirectoryError
from wheelleg_exp.evaluation.lqr_balancer import Reference
from wheelleg_exp.evaluation.result import FORMAT, Evaluation, Figure
from wheelleg_exp.files import for_people, read_json, write_text
from wheelleg_exp.run.records import Addition

RESULT, EPISODES = "evaluation.json", "episodes.csv"
_EXPECTED = "an evaluation that wheelleg evaluate has written"


def write_episodes(path: Path, episodes: Mapping[str, np.ndarray]) -> None:
    """Write the evaluated episodes as CSV, one per row; Python's number format preserves every bit of a float."""
    file = io.StringIO()
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow(episodes)
    for row in zip(*(column.tolist() for column in episodes.values()), strict=True):
        # NaN becomes an empty cell, and a whole number is written without a decimal point.
        writer.writerow("" if x != x else int(x) if isinstance(x, float) and x.is_integer() else x for x in row)
    write_text(path, file.getvalue())


def read_content(folder: Path) -> dict[str, Any]:
    """Return the content of a saved ``evaluation.json``."""
    path = folder / RESULT
    content = read_json(path)
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise RunDirectoryError(f"the file is not an evaluation in format {FORMAT}", key=str(path), expected=_EXPECTED)
    return content


def read_evaluation(folder: Path) -> Evaluation:
    """Load a saved evaluation and the episodes of this evaluation."""
    content = read_content(folder)
    try:
        metrics = {}
        for name, value in content["metrics"].items():
            numbers = (math.nan if value[key] is None else float(value[key]) for key in ("value", "low", "high"))
            found, low, high = numbers
            metrics[name] = Figure(found, low, high, value["episodes"], value["unit"], value["better"])
        facts = {key: content[key] for key in ("protocol", "seed", "scenarios_sha256", "starts_sha256", "about")}
        return Evaluation(episodes=read_episodes(folder / EPISODES), metrics=metrics, **facts)
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise RunDirectoryError(f"the evaluation is damaged: {error!r}", key=str(folder), expected=_EXPECTED) from error


def read_episodes(path: Path) -> dict[str, np.ndarray]:
    """Return the columns of ``episodes.csv``: texts, or numbers with NaN for empty cells."""
    with for_people(path, "read"):
        rows = list(csv.reader(io.StringIO(path.read_text(encoding="utf-8"))))
    if not rows:
        raise RunDirectoryError("the file is empty", key=str(path), expected=_EXPECTED)
    return {name: _column([row[i] for row in rows[1:]]) for i, name in enumerate(rows[0])}


# ``MARGINS`` maps the margins that reports and bundles show to their names and units.
MARGINS = {
    "robust/margin/delay": ("delay of the actions", "s"),
    "robust/margin/noise": ("noise of the sensors", "times noise_std"),
    "robust/margin/kick": ("kick forwards or backwards", "m/s"),
    "robust/margin/slope": ("slope of the floor", "rad"),
}


class Margin(NamedTuple):
    """The largest change of one property that a policy survives, and that of the reference controller if measured."""

    name: str
    unit: str
    policy: float
    reference: float | None


def margins_of(additions: Sequence[Addition], checkpoint_sha256: str | None = None) -> list[Margin]:
    """Return the margins of a run's newest evaluation that measured any, of a checkpoint if given; [] without one."""

    def margins(results: Mapping[str, object]) -> dict[str, float]:
        metrics = results.get("metrics")
        found = {name: metrics.get(name) for name in MARGINS} if isinstance(metrics, Mapping) else {}
        return {name: value for name, value in found.items() if isinstance(value, (int, float))}

    results = [(entry.kind, entry.results) for entry in additions if margins(entry.results)]
    sha, scenarios = "checkpoint_sha256", "scenarios_sha256"
    mine = [r for kind, r in results if kind == "evaluation" and checkpoint_sha256 in (None, r.get(sha))]
    if not mine:
        return []
    same = [r for kind, r in results if kind == Reference.name and r.get(scenarios) == mine[-1].get(scenarios)]
    reference = margins(same[-1]) if same else {}
    return [Margin(*MARGINS[name], value, reference.get(name)) for name, value in margins(mine[-1]).items()]


def _column(cells: Sequence[str]) -> np.ndarray:
    try:
        return np.array([float(cell) if cell else np.nan for cell in cells])
    except ValueError:
        return np.array(cells)
