"""Comparing evaluated runs: over training seeds, with other runs, with the reference; kept under the first run."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

from wheelleg_exp.evaluation.comparison import Difference, OverSeeds, differences, over_seeds, plain
from wheelleg_exp.evaluation.verdicts import push_verdict, verdict
from wheelleg_exp.files import while_running, write_json
from wheelleg_exp.jobs.evaluate.evaluate import Evaluated
from wheelleg_exp.run.directory import create_exclusively

COMPARISON = "comparison.json"
FORMAT = 1


@dataclass(frozen=True)
class Compared:
    """What a comparison made.

    Attributes:
        folder: what was written, below the first run.
        seeds: every metric over the runs.
        differences: how they differ from those that they are held against; empty when they are against none.
        verdict: what that comes to, in words; empty likewise.
        push_verdict: what it comes to in push recovery; empty likewise, and where no pushes were measured.
        content: what stands in ``comparison.json``.
    """

    folder: Path
    seeds: list[OverSeeds]
    differences: list[Difference]
    verdict: str
    push_verdict: str
    content: dict[str, Any]


def compare(
    runs: Sequence[Evaluated],
    against: Sequence[Evaluated],
    reference: Evaluated | None,
    command: Sequence[str],
    name: str | None = None,
) -> Compared:
    """Compare evaluated runs and keep what was found under the first of them.

    Args:
        runs: of one method, trained with different seeds.
        against: of another; may be empty.
        reference: the reference controller; told beside them.
        command: the command line, for the manifest.
        name: what the runs are called together; by default by the id of the first.

    Raises:
        RunDirectoryError: they are of different scenarios.
    """
    seeds = over_seeds([made.evaluation for made in runs])
    found = differences([m.evaluation for m in runs], [m.evaluation for m in against]) if against else []
    names = name or called(runs), called(against) if against else ""
    # The reference was not trained.
    trainings = [len(side) for side in (runs, against) if side and side[0].checkpoint is not None]
    said = verdict(found, *names, trainings) if against else ""
    pushed = push_verdict(found, *names)
    evaluation = runs[0].evaluation
    content: dict[str, Any] = {
        "format": FORMAT,
        "protocol": evaluation.protocol["name"],
        "scenarios_sha256": evaluation.scenarios_sha256,
        "runs": [_which(made) for made in runs],
        "against": [_which(made) for made in against],
        "reference": None if reference is None else _which(reference),
        "over_seeds": {row.metric: plain(asdict(row)) for row in seeds},
        "differences": {row.metric: row.as_dict() for row in found},
        "verdict": said,
        "push_verdict": pushed,
    }
    run = runs[0].run
    folder = create_exclusively(run.evaluation, datetime.now().strftime("%Y-%m-%d_%H-%M-%S") + "_comparison")
    try:
        with while_running():
            write_json(folder / COMPARISON, content)
            results = {"protocol": content["protocol"], "verdict": said, "push_verdict": pushed}
            run.manifest().add("comparison", [folder / COMPARISON], results, command=command)
    except BaseException:
        shutil.rmtree(folder, ignore_errors=True)
        raise
    return Compared(folder, seeds, found, said, pushed, content)


def called(made: Sequence[Evaluated]) -> str:
    """Return what evaluated runs are called in a sentence."""
    names = [name_of(one) for one in made]
    return names[0] if len(names) == 1 else f"{names[0]} with {len(names) - 1} more of its kind"


def name_of(made: Evaluated) -> str:
    """Return what one is called in a table: the run's id, or the reference's name."""
    return made.run.id if made.checkpoint is not None else f"the {made.content['policy']}"


def _which(made: Evaluated) -> dict[str, Any]:
    about = {"run": made.run.id, "evaluation": made.folder.name, "starts_sha256": dict(made.evaluation.starts_sha256)}
    if made.checkpoint is None:
        return about | {"policy": made.content["policy"]}
    return about | {"checkpoint_sha256": made.content["checkpoint_sha256"]}
