"""Compare the evaluations of several training seeds with each other and with a second group of runs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from wheelleg_exp.evaluation import method_comparison as comparison
from wheelleg_exp.evaluation.method_comparison import Difference, OverSeeds
from wheelleg_exp.evaluation.result import plain
from wheelleg_exp.files import write_json
from wheelleg_exp.jobs.evaluate_policy import Evaluated
from wheelleg_exp.jobs.rollout_files import dated_folder

COMPARISON = "comparison.json"
COMPARISON_FORMAT = 1


@dataclass(frozen=True)
class Compared:
    """The result of a comparison of runs: each metric over all runs, and differences from a second group of runs."""

    folder: Path
    seeds: list[OverSeeds]
    differences: list[Difference]  # empty without ``against``
    verdict: str  # empty without ``against``
    push_verdict: str
    content: dict[str, Any]  # the content of ``comparison.json``


def compare(
    runs: Sequence[Evaluated],
    against: Sequence[Evaluated],
    reference: Evaluated | None,
    command: Sequence[str],
    name: str | None = None,
    engines: Sequence[str] = (),
) -> Compared:
    """Compare the evaluations of runs, and save the comparison in the directory of the first run.

    ``runs`` and ``against`` are runs of two training methods with different seeds. ``name`` is the common name of
    ``runs``, by default the id of the first run. ``engines`` names two engines with which the same runs were evaluated.
    """
    seeds = comparison.over_seeds([made.evaluation for made in runs])
    found = comparison.differences([m.evaluation for m in runs], [m.evaluation for m in against]) if against else []
    names = name or group_name(runs), group_name(against) if against else ""
    # ``trainings`` counts the training runs of each method; an LQR controller has no training runs.
    trainings = [len(side) for side in (runs, against) if side and side[0].checkpoint is not None]
    if engines:
        found = [replace(row, better=comparison.DIFFERS if row.better else "") for row in found]
        said, pushed = comparison.engine_verdict(found, *engines), ""
        abouts = [made.evaluation.about for made in (*runs, *against)]
        if odd := dict.fromkeys(text for about in abouts for text in about.get("robot_differences", ())):
            said += f" The robot differs between {' and '.join(engines)}: {', '.join(odd)}."
    else:
        said = comparison.verdict(found, *names, trainings) if against else ""
        pushed = comparison.push_verdict(found, *names)
    evaluation = runs[0].evaluation
    content = {
        "format": COMPARISON_FORMAT,
        "protocol": evaluation.protocol["name"],
        "scenarios_sha256": evaluation.scenarios_sha256,
        "runs": [_identify(made) for made in runs],
        "against": [_identify(made) for made in against],
        "reference": None if reference is None else _identify(reference),
        "over_seeds": {row.metric: plain(asdict(row)) for row in seeds},
        "differences": {row.metric: row.as_dict() for row in found},
        "verdict": said,
        "push_verdict": pushed,
    }
    run = runs[0].run
    with dated_folder(run.evaluation, "_comparison") as folder:
        write_json(folder / COMPARISON, content)
        results = {"protocol": content["protocol"], "verdict": said, "push_verdict": pushed}
        if engines:
            values = {row.metric: [row.first, row.second, row.unit] for row in comparison.judged_metrics(found)}
            results |= {"engines": list(engines), "metrics": plain(values), "runs": len(runs)}
        run.manifest().add("comparison", [folder / COMPARISON], results, command=command)
    return Compared(folder, seeds, found, said, pushed, content)


def group_name(made: Sequence[Evaluated]) -> str:
    """Return a name for a group of evaluated runs, for use in a sentence."""
    names = [display_name(one) for one in made]
    return names[0] if len(names) == 1 else f"{names[0]} with {len(names) - 1} more of its kind"


def display_name(made: Evaluated) -> str:
    """Return the name of an evaluation in a table: the id of the run, or the name of the reference controller."""
    return made.run.id if made.checkpoint is not None else f"the {made.content['policy']} controller"


def _identify(made: Evaluated) -> dict[str, object]:
    about = {"run": made.run.id, "evaluation": made.folder.name, "starts_sha256": dict(made.evaluation.starts_sha256)}
    if made.checkpoint is None:
        return about | {"policy": made.content["policy"]}
    return about | {"checkpoint_sha256": made.content["checkpoint_sha256"]}
