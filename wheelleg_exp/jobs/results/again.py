"""Getting a result again: trains what its record names, evaluates it, and compares to the bit."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from wheelleg_exp.errors import SimulationFailure
from wheelleg_exp.jobs.evaluate.evaluate import Evaluated, evaluate_reference, evaluate_run
from wheelleg_exp.jobs.results.record import numbers, parameters
from wheelleg_exp.run.directory import RunDirectory

_LAST_WORDS = 4  # lines
_MAIN = "from wheelleg_exp.cli.main import main; import sys; sys.exit(main())"


def again(record: Mapping[str, Any], root: Path, say: Callable[[str], None]) -> list[str]:
    """Train and evaluate what a record names; return in words what came out otherwise, nothing when all is equal.

    Args:
        record: of the result.
        root: an empty folder for the runs.
        say: told what is being done.

    Raises:
        SimulationFailure: a training ended with an error.
    """
    trained: dict[str, RunDirectory] = {}
    found: list[str] = []
    first = None
    for number, kept in enumerate(record["runs"], start=1):
        run = _trained(kept["train"], root, trained, say)
        first = first or run
        if parameters(run) != kept["parameters"]:
            found.append(f"run {number}: the networks are {parameters(run)}, and were {kept['parameters']}")
        say(f"run {number}: evaluating")
        made = evaluate_run(run, None, record["words"], ["wheelleg", "results"])
        found += [f"run {number}: {line}" for line in differing(kept["evaluation"], made)]
    if record["reference"] is not None and first is not None:
        say("reference: evaluating")
        made = evaluate_reference(first, record["words"], ["wheelleg", "results"])
        found += [f"reference: {line}" for line in differing(record["reference"], made)]
    return found


def differing(kept: Mapping[str, Any], made: Evaluated) -> Iterator[str]:
    """Yield in words what of an evaluation is not as it was."""
    now = numbers(made)
    for key in ("scenarios_sha256", "starts_sha256"):
        if now[key] != kept[key]:
            yield f"{key} is {now[key]}, and was {kept[key]}"
    for name in dict.fromkeys([*kept["metrics"], *now["metrics"]]):
        was, is_now = kept["metrics"].get(name), now["metrics"].get(name)
        if was != is_now:
            yield f"{name} is {_value(is_now)}, and was {_value(was)}"


def _value(figure: Mapping[str, Any] | None) -> str:
    return "absent" if figure is None else repr((figure["value"], figure["low"], figure["high"]))


def _trained(
    recipe: Mapping[str, Any], root: Path, trained: dict[str, RunDirectory], say: Callable[[str], None]
) -> RunDirectory:
    """Return the run of a recipe, trained if it has not been yet."""
    if repr(recipe) in trained:
        return trained[repr(recipe)]
    words = list(recipe["overrides"])
    if recipe["begins_with"] is not None:
        parent = _trained(recipe["begins_with"], root, trained, say)
        words.append(f"init_from={parent.checkpoint(recipe['iteration'])}")
    say(f"wheelleg train {' '.join(words)}")
    before = _runs(root)
    _train([*words, f"run.root={root}", "recording.enabled=false"])
    (path,) = _runs(root) - before
    trained[repr(recipe)] = RunDirectory.open(path, root)
    return trained[repr(recipe)]


def _train(words: Sequence[str]) -> None:
    """Train in a process of its own, as the command line does: threads and libraries are prepared anew."""
    done = subprocess.run([sys.executable, "-c", _MAIN, "train", *words], capture_output=True, text=True, check=False)
    if done.returncode:
        last = " ".join(done.stderr.split("\n")[-_LAST_WORDS:]).strip()
        raise SimulationFailure(f"wheelleg train {' '.join(words)} ended with status {done.returncode}: {last}")


def _runs(root: Path) -> set[Path]:
    return {path.parent for path in root.glob("*/*/manifest.json")}
