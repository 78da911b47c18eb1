"""Write a result: the record with all numbers, the page in Markdown, and the manifests of its runs; or reproduce it.

``reproduce`` trains the runs that a record names, evaluates them, and compares every number to the bit.
"""

from __future__ import annotations

import json
import math
import shlex
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import groupby
from pathlib import Path
from typing import TypedDict, cast

from wheelleg_exp.config.checking.find_mistakes import compose_valid
from wheelleg_exp.config.composing.compose_sweep import digest_of
from wheelleg_exp.errors import RunDirectoryError
from wheelleg_exp.files import for_people, json_plain, read_json, read_text, write_bytes, write_json, write_text
from wheelleg_exp.jobs.compare_evaluations import Compared, compare
from wheelleg_exp.jobs.evaluate_policy import Evaluated, evaluate_run
from wheelleg_exp.jobs.train.source_roots import shorten
from wheelleg_exp.jobs.training_job import JobRequest, run_request
from wheelleg_exp.paths import TEACHER
from wheelleg_exp.plain_data import yaml_value
from wheelleg_exp.run import records
from wheelleg_exp.run.environment import hardware, versions
from wheelleg_exp.run.records import ProcessFacts
from wheelleg_exp.run.run_config import require_overrides
from wheelleg_exp.run.run_directory import RunDirectory
from wheelleg_exp.run.source_changes import SourceRecord
from wheelleg_exp.run.stock_policies import PREFIX, refuse_stock
from wheelleg_exp.stop_request import StopRequest
from wheelleg_exp.verify import run_differences
from wheelleg_exp.verify.run_differences import FactDifference, is_the_machine

_MARK = "¹"
_FOOTNOTE = (
    f"{_MARK} marks a verdict that other training seeds may change: the 95 % interval of the metric's difference,"
    " over runs and episodes, contains 0."
)
_DEGREES = {"rad": "°", "rad/s": "°/s"}
_PLOTTED = ("stand", "walk", "push", "terrain", "robust")  # tests whose plots stand first on a page
# The metrics in the table of a page that is not folded away, with all margins.
_FIRST = (
    *("survival", "success", "worst_success", "worst_success_hardest", "worst_survival", "drift", "drift_worst"),
    *("yaw_drift", "error_vx_steady", "error_wz_steady", "zero_drift", "zero_yaw_drift", "torque_share_wheels"),
    *("height_rmse", "action_acceleration", "limit_0s", "limit_worst_0s", "limit_0.15s"),
)
_ROWS = 10  # number of rows of this table


class Recipe(TypedDict):
    """The overrides of a training, and the recipe and the iteration of the run with which it starts."""

    overrides: list[str]
    begins_with: Recipe | None
    iteration: int | None


class MetricNumbers(TypedDict):
    """A metric of one evaluation; None replaces NaN and inf."""

    value: float | None
    low: float | None
    high: float | None


class EvaluationNumbers(TypedDict):
    """An evaluation's seed, digests, and metrics, which a repetition must reproduce exactly."""

    seed: int
    scenarios_sha256: str
    starts_sha256: Mapping[str, str]
    metrics: Mapping[str, MetricNumbers]


class _Profile(TypedDict, total=False):
    profile: str | None
    mujoco: str
    contacts: str


class About(_Profile):
    """The robot's profile, the steps of the evaluation, s, and, since November 2026, the engine and its contacts."""

    physics_dt_s: float
    step_dt_s: float


class RunEntry(TypedDict):
    """A run of a result: its id, its training, the digest of its networks, and its evaluation."""

    id: str
    train: Recipe
    parameters: str
    evaluation: EvaluationNumbers


class IntervalNumbers(MetricNumbers):
    """A value with its interval and its noise floor."""

    floor: float | None


class SeedsRow(TypedDict):
    """A metric of all runs, and its mean."""

    unit: str
    values: list[float | None]
    mean: IntervalNumbers


class DifferenceRow(TypedDict):
    """The difference between the runs and the reference in one metric."""

    interval: IntervalNumbers
    outcome: str


class ResultRecord(TypedDict):
    """The content of ``NAME.json``: all numbers of a result."""

    format: int
    name: str
    words: list[str]
    protocol: str
    about: About
    scenarios_sha256: str
    against: str | None
    runs: list[RunEntry]
    reference: EvaluationNumbers | None
    over_seeds: Mapping[str, SeedsRow]
    differences: Mapping[str, DifferenceRow] | None
    verdict: str
    push_verdict: str


@dataclass(frozen=True, kw_only=True)
class ResultManifest(ProcessFacts):
    """The part of a run's manifest that ``write_results`` saves next to a result."""

    id: str
    seeds: tuple[int, ...] = ()
    results: Mapping[str, object] = field(default_factory=dict)
    source: SourceRecord = field(default_factory=SourceRecord)


def result_page(record: ResultRecord, manifests: Sequence[ResultManifest]) -> str:
    """Return a result as Markdown."""
    groups = {test: list(names) for test, names in groupby(record["over_seeds"], lambda name: name.partition("/")[0])}
    plots = [f"![{test} of the first run]({record['name']}/{test}.png)\n" for test in groups if test in _PLOTTED]
    parts = [f"# {record['name']}\n", *plots, *_introduction(record, manifests)]
    first = [name for name in record["over_seeds"] if _short(name) in _FIRST or "/margin/" in name][:_ROWS]
    folded = f'<details markdown="1"><summary>All {len(record["over_seeds"])} metrics</summary>\n'
    parts += [*_table(record, first, str), "", folded]
    parts += [f"{record['verdict']}\n"] if record["verdict"] else []
    for test, names in groups.items():
        parts += [f"## {test}\n", *_table(record, names, _short), ""]
    parts.append("</details>\n")
    parts += ["## How it was made\n", "```"]
    for run in record["runs"]:
        parts += _commands(run["train"])
    reference = " --reference" if record["reference"] else ""
    parts.append(f"wheelleg results {record['name']} RUN ...{reference} {shlex.join(record['words'])}".rstrip())
    parts += ["```\n", "| run | seed | commit | networks |", "|---|---|---|---|"]
    for run, manifest in zip(record["runs"], manifests, strict=True):
        commit = str(manifest.source.commit)[:12] + (" and changes" if manifest.source.dirty else "")
        seeds = ", ".join(map(str, manifest.seeds))
        link = f"[{manifest.id}]({record['name']}/{manifest.id}.json)"
        parts.append(f"| {link} | {seeds} | {commit} | `{run['parameters']}` |")
    again = f"`nox -s results -- {record['name']}`"
    parts.append(f"\n{again} retrains and re-evaluates the policies to check this page's numbers.")
    return "\n".join(parts) + "\n"


def _short(metric: str) -> str:
    return metric.partition("/")[2]


def _introduction(record: ResultRecord, manifests: Sequence[ResultManifest]) -> Iterator[str]:
    about = record["about"]
    profile = f"The config file with `profile: {about['profile']}` defines the robot. " if about.get("profile") else ""
    seeds = ", ".join(str(seed) for manifest in manifests for seed in manifest.seeds)
    scenarios = record["scenarios_sha256"][:16]
    yield f"This page evaluates policies in the test episodes of `protocol={record['protocol']}` (docs/evaluation.md)."
    steps = f"physics step was {about['physics_dt_s']:.6g} s, the control step {about['step_dt_s']:.6g} s"
    ground = f", on MuJoCo {about['mujoco']} with contacts of {about['contacts']}" if "contacts" in about else ""
    yield f"The evaluation protocol and its seed have the SHA-256 `{scenarios}…`. {profile}The {steps}{ground}."
    took = [manifest.results.get("seconds") for manifest in manifests]
    times = ", ".join(f"{seconds:.0f} s" for seconds in took if isinstance(seconds, (int, float)))
    machines = dict.fromkeys(machine for manifest in manifests for machine in machines_of(manifest))
    several = any(run["train"]["begins_with"] for run in record["runs"])
    what = "The last training of each seed" if several else "Training one policy per seed"
    yield f"{what} ({seeds}) took {times} on {', and on '.join(machines)}.\n"
    if record["push_verdict"]:
        yield f"**{record['push_verdict']}**\n"
    count, differences = len(record["runs"]), record["differences"] or {}
    if any(_outcome(difference, count).endswith(_MARK) for difference in differences.values()):
        yield f"{_FOOTNOTE}\n"


def machines_of(manifest: ProcessFacts) -> Iterator[str]:
    """Yield the CPU, core count, and GPU of each machine that trained the run: before each resume, and at the end."""
    for process in manifest.processes:
        hardware, device = process.hardware or {}, (process.threads or {}).get("device", "cpu")
        gpu = "" if device == "cpu" else " and a GPU"
        yield f"{hardware.get('cpu')}, {hardware.get('cores_usable')} cores{gpu}"


def _table(record: ResultRecord, names: Sequence[str], label: Callable[[str], str]) -> Iterator[str]:
    count = len(record["runs"])
    over = ["mean", "95 % interval", "noise floor"] if count > 1 else ["95 % interval"]
    reference, against = record["reference"], record["differences"]
    heads = ["metric", "unit", *(f"run {i}" for i in range(1, count + 1)), *over]
    heads += ["reference"] if reference else []
    heads += ["against it"] if against else []
    yield "| " + " | ".join(heads) + " |"
    yield "|---|---|" + "---:|" * (len(heads) - 2)
    for name in names:
        row = record["over_seeds"][name]
        factor, unit = (180.0 / math.pi if row["unit"] in _DEGREES else 1.0), _DEGREES.get(row["unit"], row["unit"])
        mean = row["mean"]
        middle, *ends = (_number(mean[key], factor) for key in ("value", "low", "high"))
        between = ends[0] if ends[0] == "–" else "" if ends == [middle, middle] else " to ".join(ends)
        cells = [_number(value, factor) for value in row["values"]]
        cells += [middle, between, _number(mean["floor"], factor)] if count > 1 else [between]
        if reference:
            cells.append(_number(one["value"] if (one := reference["metrics"].get(name)) else None, factor))
        if against:
            cells.append(_outcome(against[name], count) if name in against else "")
        yield f"| {label(name)} | {unit} | " + " | ".join(cells) + " |"


def _outcome(difference: DifferenceRow, count: int) -> str:
    """Return a comparison's outcome, with a footnote mark if other training seeds may give another outcome."""
    outcome, low, high = difference["outcome"], difference["interval"]["low"], difference["interval"]["high"]
    alone = outcome and count > 1 and low is not None and high is not None and low < 0.0 < high
    return f"{outcome} {_MARK}" if alone else outcome


def _commands(recipe: Recipe) -> Iterator[str]:
    before = recipe["begins_with"]
    if before is not None:
        yield from _commands(before)
    tail = f" init_from=the-run-above/model_{recipe['iteration']}.pt" if before is not None else ""
    yield f"wheelleg train {shlex.join(recipe['overrides'])}{tail}"


def _number(value: float | None, factor: float) -> str:
    return "–" if value is None or not math.isfinite(value) else f"{value * factor:.4g}"


FORMAT = 2
# Saved results omit manifest entries about folders or processes of the user's machine.
_MANIFEST_KEYS = ("id", "task", "status", "started", "ended", "seeds", "versions", "hardware", "threads", "results")
_MORE_MANIFEST_KEYS = ("init_from", "files", "sha256", "last_ended_by")
_MACHINE_KEYS = ("versions", "hardware", "threads")
_LENGTH, _THREADS, _EXPECTED = "agent.max_iterations=", "agent.torch_threads=", "what wheelleg results has written"
# A reproduced training ignores the original run's overrides of ``run``, ``init_from``, and ``recording``.
_LOCATION_PREFIXES = ("run.", "run=", "init_from=", "recording.")


def write_results(
    name: str, folder: Path, found: Compared, runs: Sequence[Evaluated], reference: Evaluated | None, words: list[str]
) -> list[Path]:
    """Write ``NAME.md``, ``NAME.json`` and a manifest of each run, replacing earlier ones; return the written files."""
    record = build_record(name, found, runs, reference, words)
    manifests = [result_manifest(made.run) for made in runs]
    files = [folder / name / f"{manifest['id']}.json" for manifest in manifests]
    earlier = earlier_manifests(name, folder)
    with for_people(folder, "written to"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    for path, manifest in zip(files, manifests, strict=True):
        write_json(path, manifest)
    write_json(folder / f"{name}.json", record)
    write_text(folder / f"{name}.md", result_page(record, read_manifests(record, folder)))
    plots = {folder / name / plot.name: plot.read_bytes() for plot in runs[0].folder.glob("*.png")}
    for path, image in plots.items():
        write_bytes(path, image)
    with for_people(folder, "written to"):
        for path in earlier.difference(files, plots):
            path.unlink(missing_ok=True)
    return [folder / f"{name}.md", folder / f"{name}.json", *files]


def earlier_manifests(name: str, folder: Path) -> set[Path]:
    """Return the run manifests that an earlier ``wheelleg results NAME`` has copied into the folder ``NAME/``."""
    path = folder / f"{name}.json"
    if not path.exists():
        return set()
    found = {folder / name / f"{run['id']}.json" for run in read_record(path)["runs"]}
    found.update((folder / name).glob("*.png"))
    return {path for path in found if path.parent == folder / name and path.is_file()}


def build_record(
    name: str, compared: Compared, runs: Sequence[Evaluated], reference: Evaluated | None, words: Sequence[str]
) -> ResultRecord:
    """Return the content of ``NAME.json``, which contains all numbers of a result that is named ``NAME``."""
    return {
        "format": FORMAT,
        "name": name,
        "words": list(words),
        "protocol": compared.content["protocol"],
        "about": cast(About, dict(runs[0].evaluation.about)),
        "scenarios_sha256": compared.content["scenarios_sha256"],
        "against": "reference" if compared.differences else None,
        "runs": [
            {
                "id": str(made.run.manifest().data["id"]),
                "train": recipe(made.run),
                "parameters": parameters(made.run),
                "evaluation": evaluation_numbers(made),
            }
            for made in runs
        ],
        "reference": None if reference is None else evaluation_numbers(reference),
        "over_seeds": compared.content["over_seeds"],
        "differences": compared.content["differences"],
        "verdict": compared.verdict,
        "push_verdict": compared.push_verdict,
    }


def read_record(path: Path) -> ResultRecord:
    """Read a result record that ``write_results`` has written."""
    record = read_json(path)
    if not isinstance(record, dict) or record.get("format") != FORMAT:
        raise RunDirectoryError("the file is not a record of wheelleg results", key=str(path), expected=_EXPECTED)
    return records.read_record(ResultRecord, record, "broken result record", path)


def read_manifests(record: ResultRecord, folder: Path) -> list[ResultManifest]:
    """Read the manifests of a result's runs, which ``write_results`` copied into the folder with the result's name."""
    paths = [folder / record["name"] / f"{run['id']}.json" for run in record["runs"]]
    return [records.read_record(ResultManifest, read_json(path), "broken manifest", path) for path in paths]


def read_result(name: str, folder: Path) -> tuple[ResultRecord, list[ResultManifest]]:
    """Read a result's numbers and run manifests; raise RunDirectoryError if ``NAME.md`` and ``NAME.json`` disagree."""
    path = folder / f"{name}.json"
    record = read_record(path)
    if record["name"] != name:
        message = f"the record is of '{record['name']}'"
        raise RunDirectoryError(message, key=str(path), expected="a record of its own name")
    if not record["runs"]:
        raise RunDirectoryError("the result record contains no run", key=str(path), expected=_EXPECTED)
    trained = [word for run in record["runs"] for word in _recipe_overrides(run["train"])]
    require_overrides([*record["words"], *trained], path)
    manifests = read_manifests(record, folder)
    page = folder / f"{name}.md"
    if read_text(page) != result_page(record, manifests):
        expected = "the page that wheelleg results wrote: only one of page and record was changed"
        raise RunDirectoryError("the result's page and the result's JSON file differ", key=str(page), expected=expected)
    return record, manifests


def _recipe_overrides(made: Recipe) -> list[str]:
    """Return a training's overrides, followed by those of the training that produced its initial policy."""
    return [*made["overrides"], *(_recipe_overrides(made["begins_with"]) if made["begins_with"] else ())]


def recipe(run: RunDirectory) -> Recipe:
    """Return how to train a run again: its overrides, and the recipe of the run with which it starts.

    A run that was resumed exactly, on another machine, or with other threads counts as one training. If one
    uninterrupted training cannot reproduce the run, raise RunDirectoryError.
    """
    facts = run.manifest().facts
    refuse_stock(run.path, facts.stock)
    words = [word for entry in facts.resumes for word in entry.overrides]
    longer = [word for word in words if not word.startswith(_THREADS)]
    exact = True
    for entry in facts.resumes:  # A resume can be inexact only because of other hardware or another number of threads.
        changed = [(each.get("section"), each.get("name")) for each in entry.differences]
        machine = all(section == "hardware" or (section, name) == ("threads", "torch") for section, name in changed)
        exact = exact and (entry.exact is True or (machine and is_the_machine(entry)))
    if facts.status != "finished" or not exact or any(not word.startswith(_LENGTH) for word in longer):
        expected = "a finished run whose resumes changed nothing but its length, the machine, or the number of threads"
        raise RunDirectoryError("the run was not an uninterrupted training", key=run.id, expected=expected)
    if (run.asset / TEACHER).is_file():
        message = "the run learned from another run's policy"
        raise RunDirectoryError(message, key=run.id, expected="a run that its own commands reproduce")
    with for_people(run.hydra, "read"):
        overrides = [str(word) for word in yaml_value((run.hydra / "overrides.yaml").read_bytes()) or []]
    if longer:
        overrides = [*(word for word in overrides if not word.startswith(_LENGTH)), longer[-1]]
    words = [word for word in overrides if not word.lstrip("+~").startswith(_LOCATION_PREFIXES)]
    began = facts.init_from
    if began is not None and began.named.startswith(PREFIX):
        words.append(f"init_from={began.named}")  # Every user has the policies that ship with ``wheelleg_exp``.
    elif began is not None:
        parent = RunDirectory.open(str(began.run), run.root)
        return Recipe(overrides=words, begins_with=recipe(parent), iteration=began.iteration)
    return Recipe(overrides=words, begins_with=None, iteration=None)


def require_one_method(runs: Sequence[RunDirectory]) -> None:
    """Raise RunDirectoryError if any setting except the seed differs between the given runs."""
    first, *others = (_method(recipe(run)) for run in runs)
    for run, other in zip(runs[1:], others, strict=True):
        if other != first:
            message = f"the run was trained differently from {runs[0].id}: {_describe_difference(other, first)}"
            expected = "runs that differ only in their seed (see wheelleg diff)"
            raise RunDirectoryError(message, key=run.id, expected=expected)


def _method(made: Recipe) -> Recipe:
    words = sorted(word for word in made["overrides"] if not word.startswith("seed="))
    return {**made, "overrides": words, "begins_with": made["begins_with"] and _method(made["begins_with"])}


def _describe_difference(one: Recipe, other: Recipe) -> str:
    """Describe the different overrides or initial policies of two trainings, such as 'with agent.gamma=0.9'."""
    words = set(one["overrides"]), set(other["overrides"])
    sides = (("with", *words), ("without", *words[::-1]))
    parts = [f"{side} {word}" for side, mine, its in sides for word in sorted(mine - its)]
    if parts:
        return ", ".join(parts)
    if one["begins_with"] and other["begins_with"] and one["begins_with"] != other["begins_with"]:
        return f"the run it starts with was trained {_describe_difference(one['begins_with'], other['begins_with'])}"
    return "it starts with another checkpoint"


def parameters(run: RunDirectory) -> str:
    """Return the digest (hash) of a run's final networks."""
    with for_people(run.iterations, "read"):
        last = run.iterations.read_text(encoding="utf-8").splitlines()[-1]
    return str(json.loads(last)["digests"]["parameters"])


def evaluation_numbers(made: Evaluated) -> EvaluationNumbers:
    """Return an evaluation's seed, scenario hashes, and metrics, which a repetition must reproduce exactly."""
    keys = ("seed", "scenarios_sha256", "starts_sha256", "metrics")
    return cast(EvaluationNumbers, {key: made.content[key] for key in keys})


def result_manifest(run: RunDirectory) -> dict[str, object]:
    """Return those entries of a run's manifest that ``write_results`` saves in the file ``<run id>.json``."""
    data = run.manifest().data
    source = data.get("source") or {}
    result = {key: data[key] for key in (*_MANIFEST_KEYS, *_MORE_MANIFEST_KEYS) if key in data}
    if began := result.get("init_from"):
        result["init_from"] = {**began, "named": Path(str(began["named"])).name}  # without the folders of this machine
    result["source"] = {key: source.get(key) for key in ("commit", "tree", "dirty")}
    result["resumes"] = [
        {
            **{key: entry.get(key) for key in ("when", "iteration", "exact", "why")},
            "before": {key: entry["before"].get(key) for key in _MACHINE_KEYS} if entry.get("before") else None,
        }
        for entry in data["resumes"]
    ]
    return result


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

    ``trained`` maps recipes to finished runs, so that no recipe is trained twice. ``say`` receives texts about the
    progress.
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
    now = evaluation_numbers(made)
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
        now = parameters(made.run)
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
        now = json_plain(build_record(record["name"], compared, runs, reference, record["words"]))
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
