"""Reproduce a result: train the runs that its record names, evaluate them, and compare every number to the bit."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from wheelleg_exp.config.checking.find_mistakes import compose_valid
from wheelleg_exp.config.composing.compose_sweep import digest_of
from wheelleg_exp.files import json_plain
from wheelleg_exp.jobs import result_record
from wheelleg_exp.jobs.compare_evaluations import compare
from wheelleg_exp.jobs.evaluate_policy import Evaluated, evaluate_run
from wheelleg_exp.jobs.result_record import EvaluationNumbers, MetricNumbers, Recipe, ResultManifest, ResultRecord
from wheelleg_exp.jobs.train.source_roots import shorten
from wheelleg_exp.jobs.training_job import JobRequest, run_request
from wheelleg_exp.run.environment import hardware, versions
from wheelleg_exp.run.records import ProcessFacts
from wheelleg_exp.run.run_directory import RunDirectory
from wheelleg_exp.stop_request import StopRequest
from wheelleg_exp.verify import run_differences
from wheelleg_exp.verify.run_differences import FactDifference

_COMMAND = ("wheelleg", "results")


@dataclass(frozen=True)
class Reproduction:
    """The result of a reproduction."""

    differences: list[str]  # Each text describes a number that differs bitwise from the number in the result record.
    machine: list[FactDifference]  # differences in hardware, versions, and threads that may change the result's numbers
    other_code: bool  # whether the current source files differ from those of the recorded trainings

    @property
    def verdict(self) -> str:
        """A sentence for the user: whether all numbers were reproduced exactly, and if not, possible causes."""
        if not self.differences:
            return "reproduced to the bit" + (", on another machine" if self.machine else "")
        why = ["with other source files"] if self.other_code else []
        why += [f"where {fact.section} differed ({', '.join(_fact_lines([fact]))})" for fact in self.machine]
        if not why:
            return "not reproduced to the bit, with the same source, on the same kind of machine"
        judged = "equal bits are promised only on the same kind of machine with the same versions and source"
        return f"not reproduced to the bit; it was made {'; '.join(why)}, and {judged}"


def reproduce(
    record: ResultRecord,
    manifests: Sequence[ResultManifest],
    root: Path,
    say: Callable[[str], None],
    config_dirs: Sequence[Path] = (),
    trained: dict[str, RunDirectory] | None = None,
) -> Reproduction:
    """Repeat the trainings and evaluations of a saved result, and compare every number with the recorded number.

    ``trained`` maps recipes to finished runs, so that no recipe is trained twice.
    """
    here = [ProcessFacts(versions=versions(), hardware=hardware())]
    differs = _fact_lines(_machine_differences(manifests[:1], here, early=True))
    for line in differs:
        say(f"differs: {line}")
    if differs:
        say("equal bits are promised only on the same kind of machine: other numbers here do not refute the page")
    trained = {} if trained is None else trained
    runs: list[Evaluated] = []
    for number, recorded in enumerate(record["runs"], start=1):
        run = _trained_run(recorded["train"], root, trained, say, config_dirs)
        say(f"run {number}: evaluating")
        runs.append(evaluate_run(run, None, record["words"], _COMMAND, None, config_dirs))
    reference = None
    if record["reference"] is not None:
        say("reference: evaluating")
        reference = evaluate_run(runs[0].run, None, record["words"], _COMMAND, None, config_dirs, reference=True)
    made = [run.run.manifest().facts for run in runs]
    trees = [one.source.tree for one in manifests], [one.source and one.source.tree for one in made]
    found = list(_differences(record, runs, reference))
    return Reproduction(found, _machine_differences(manifests, made), trees[0] != trees[1])


def evaluation_differences(recorded: EvaluationNumbers, made: Evaluated) -> Iterator[str]:
    """Yield texts that describe how a new evaluation differs from the recorded evaluation."""
    now = result_record.evaluation_numbers(made)
    for key in ("seed", "scenarios_sha256", "starts_sha256"):
        if now[key] != recorded[key]:
            yield f"{key} is {now[key]}, and was {recorded[key]}"
    for name in dict.fromkeys([*recorded["metrics"], *now["metrics"]]):
        was, is_now = recorded["metrics"].get(name), now["metrics"].get(name)
        if _value(was) != _value(is_now):
            yield f"{name} is {_value(is_now)}, and was {_value(was)}"
        else:
            yield from _leaf_differences(was, is_now, name)  # Equal metric values can still have different units.


def _differences(record: ResultRecord, runs: Sequence[Evaluated], reference: Evaluated | None) -> Iterator[str]:
    """Yield texts about networks, evaluations, and comparisons that differ from those of the recorded result."""
    equal = True
    for number, (recorded, made) in enumerate(zip(record["runs"], runs, strict=True), start=1):
        now = result_record.parameters(made.run)
        lines = [f"the networks are {now}, and were {recorded['parameters']}"] if now != recorded["parameters"] else []
        for line in (*lines, *evaluation_differences(recorded["evaluation"], made)):
            equal = False
            yield f"run {number}: {line}"
    if reference is not None and record["reference"] is not None:
        for line in evaluation_differences(record["reference"], reference):
            equal = False
            yield f"reference: {line}"
    if equal:
        against = [] if reference is None else [reference]
        compared = compare(runs, against, reference, _COMMAND, record["name"])
        now = json_plain(result_record.build_record(record["name"], compared, runs, reference, record["words"]))
        rest = [key for key in dict.fromkeys([*record, *now]) if key not in ("runs", "reference")]
        yield from _leaf_differences({key: record.get(key) for key in rest}, {key: now.get(key) for key in rest})


def _leaf_differences(was: object, now: object, *keys: str) -> Iterator[str]:
    """Yield a text for each number or string that differs between two nested values."""
    for change in run_differences.plain_changes(was, now, keys):
        yield f"{change.key} is {shorten(change.b)}, and was {shorten(change.a)}"


def _machine_differences(
    was: Sequence[ProcessFacts], now: Sequence[ProcessFacts], *, early: bool = False
) -> list[FactDifference]:
    """Return machine differences that may change results; ``early`` omits those that only an imported torch reports."""
    unknown = run_differences.UNKNOWN_BEFORE_TORCH if early else ()
    sides = ((one.processes, other.processes) for one, other in zip(was, now, strict=True))
    facts = [
        fact
        for one, other in sides
        for fact in run_differences.allowing(run_differences.environment_differences(one, other, unknown))
    ]
    return [fact for number, fact in enumerate(facts) if fact not in facts[:number]]


def _fact_lines(facts: Sequence[FactDifference]) -> list[str]:
    return [f"{fact.name} was {shorten(fact.a)}, is {shorten(fact.b)}" for fact in facts]


def _value(figure: MetricNumbers | None) -> str:
    return "absent" if figure is None else repr((figure["value"], figure["low"], figure["high"]))


def _trained_run(
    recipe: Recipe,
    root: Path,
    trained: dict[str, RunDirectory],
    say: Callable[[str], None],
    config_dirs: Sequence[Path] = (),
) -> RunDirectory:
    if repr(recipe) in trained:
        return trained[repr(recipe)]
    words = list(recipe["overrides"])
    if recipe["begins_with"] is not None and recipe["iteration"] is not None:
        parent = _trained_run(recipe["begins_with"], root, trained, say, config_dirs)
        words.append(f"init_from={parent.checkpoint(recipe['iteration'])}")
    say(f"wheelleg train {' '.join(words)}")
    path = _train([*words, f"run.root={root}", "recording.enabled=false"], config_dirs)
    trained[repr(recipe)] = RunDirectory.open(path, root)
    return trained[repr(recipe)]


def _train(words: list[str], config_dirs: Sequence[Path]) -> str:
    """Train a run with the recorded overrides ``words`` in a child process; return the path of the new run."""
    digest = digest_of(compose_valid(words, config_dirs=config_dirs))
    request = JobRequest("train", words, [str(folder) for folder in config_dirs], ["wheelleg", "train", *words], digest)
    with run_request(request, StopRequest()) as events:
        (path,) = [event["path"] for event in events if event["event"] == "run"]
    return str(path)
