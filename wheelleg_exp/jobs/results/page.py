"""A result as a page of Markdown."""

from __future__ import annotations

import math
import shlex
from collections.abc import Iterator, Mapping, Sequence
from itertools import groupby
from typing import Any

_MARK = "¹"
_OF_THESE = (
    f"{_MARK} marks verdicts of these runs that other seeds may not show: the 95 % interval of the difference, over"
    " runs and episodes, holds 0."
)
_DEGREES = {"rad": "°", "rad/s": "°/s"}


def page(record: Mapping[str, Any], manifests: Sequence[Mapping[str, Any]]) -> str:
    """Return a result as Markdown.

    Args:
        record: what ``record.write_results`` writes.
        manifests: of its runs.
    """
    parts = [f"# {record['name']}\n", *_about(record, manifests)]
    for group, names in groupby(record["over_seeds"], lambda metric: metric.partition("/")[0]):
        parts += [f"## {group}\n", *_table(record, list(names)), ""]
    parts += ["## How it was made\n", *_made(record, manifests)]
    return "\n".join(parts) + "\n"


def _about(record: Mapping[str, Any], manifests: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    about = record["about"]
    profile = f"robot profile `{about['profile']}`, " if about.get("profile") else ""
    seeds = ", ".join(str(seed) for manifest in manifests for seed in manifest.get("seeds") or [])
    yield (
        f"Protocol `{record['protocol']}`, scenarios `{record['scenarios_sha256'][:16]}`; training seeds {seeds}; "
        f"{profile}physics step {about['physics_dt_s']:.6g} s, "
        f"control step {about['step_dt_s']:.6g} s."
    )
    took = [manifest["results"].get("seconds") for manifest in manifests]
    times = ", ".join(f"{seconds:.0f} s" for seconds in took if isinstance(seconds, (int, float)))
    machines = dict.fromkeys(machine for manifest in manifests for machine in machines_of(manifest))
    yield f"Trained in {times} on {', and on '.join(machines)}.\n"
    if record["push_verdict"]:
        yield f"**{record['push_verdict']}**\n"
    if record["verdict"]:
        yield f"{record['verdict']}\n"
    count, differences = len(record["runs"]), record["differences"] or {}
    if any(_outcome(difference, count).endswith(_MARK) for difference in differences.values()):
        yield f"{_OF_THESE}\n"


def machines_of(manifest: Mapping[str, Any]) -> Iterator[str]:
    """Yield the machines on which a run was trained, the first first; one that was resumed may have several."""
    for process in (*(entry["before"] or {} for entry in manifest.get("resumes") or ()), manifest):
        hardware = process.get("hardware") or {}
        yield f"{hardware.get('cpu')}, {hardware.get('cores_usable')} cores"


def _table(record: Mapping[str, Any], names: Sequence[str]) -> Iterator[str]:
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
        ends = [_number(mean[end], factor) for end in ("low", "high")]
        between = ends[0] if ends[0] == "–" else " to ".join(ends)
        cells = [_number(value, factor) for value in row["values"]]
        cells += [_number(mean["value"], factor), between, _number(mean["floor"], factor)] if count > 1 else [between]
        if reference:
            cells.append(_number(reference["metrics"].get(name, {}).get("value"), factor))
        if against:
            cells.append(_outcome(against.get(name, {}), count))
        yield f"| {name.partition('/')[2]} | {unit} | " + " | ".join(cells) + " |"


def _outcome(difference: Mapping[str, Any], count: int) -> str:
    """Return the verdict; marked where the runs alone bear it out, and their seeds do not."""
    outcome = str(difference.get("outcome", ""))
    low, high = (difference.get("interval", {}).get(end) for end in ("low", "high"))
    alone = outcome and count > 1 and low is not None and high is not None and low < 0.0 < high
    return f"{outcome} {_MARK}" if alone else outcome


def _made(record: Mapping[str, Any], manifests: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    yield "```"
    for run in record["runs"]:
        yield from _commands(run["train"])
    reference = " --reference" if record["reference"] else ""
    yield f"wheelleg results {record['name']} RUN ...{reference} {shlex.join(record['words'])}".rstrip()
    yield "```\n"
    yield "| run | seed | commit | networks |"
    yield "|---|---|---|---|"
    for run, manifest in zip(record["runs"], manifests, strict=True):
        source = manifest["source"]
        commit = str(source.get("commit"))[:12] + (" and changes" if source.get("dirty") else "")
        seeds = ", ".join(map(str, manifest.get("seeds") or []))
        link = f"[{manifest['id']}]({record['name']}/{manifest['id']}.json)"
        yield f"| {link} | {seeds} | {commit} | `{run['parameters']}` |"
    yield f"\n`nox -s results -- {record['name']}` trains and evaluates them again and compares to the bit."


def _commands(recipe: Mapping[str, Any]) -> Iterator[str]:
    before = recipe["begins_with"]
    if before is not None:
        yield from _commands(before)
    tail = " init_from=" + "the-run-above" if before is not None else ""
    yield f"wheelleg train {shlex.join(recipe['overrides'])}{tail}"


def _number(value: float | None, factor: float) -> str:
    return "–" if value is None or not math.isfinite(value) else f"{value * factor:.4g}"
