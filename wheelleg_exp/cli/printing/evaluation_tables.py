"""Print the metrics of an evaluation, and of several evaluations side by side."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import groupby
from typing import Any

from wheelleg_exp.cli.printing.terminal import hanging, print_table
from wheelleg_exp.evaluation.method_comparison import Difference
from wheelleg_exp.jobs.evaluate_policy import Compared, Evaluated, display_name

_DEGREES = {"rad": "°", "rad/s": "°/s"}


def print_evaluation(content: Mapping[str, Any]) -> None:
    """Print the content of ``evaluation.json``: one table for each group of metrics, with angles in degrees."""
    about, protocol = content["about"], content["protocol"]
    dt, step = about.get("physics_dt_s"), about.get("step_dt_s")
    print(f"protocol {protocol['name']}, seed {content['seed']}, scenarios {content['scenarios_sha256'][:12]}")
    print(f"robot profile {about.get('profile')}, {about.get('engine')}, physics step {dt:.6g} s, control {step:.6g} s")
    for group, found in groupby(content["metrics"], lambda name: name.split("/")[0]):
        print()
        names = list(found)
        rows = [_row(name, content["metrics"][name]) for name in names if content["metrics"][name]["episodes"]]
        print_table((group, "value", "95 % interval", "unit", "episodes"), rows)
        _print_unmeasured([name.split("/", 1)[1] for name in names if not content["metrics"][name]["episodes"]])


def _print_unmeasured(names: Sequence[str]) -> None:
    """Print the metrics without a value, such as the drift if every robot fell immediately."""
    if names:
        print(hanging(f"no episode has a value for: {', '.join(names)}", 4))


def _row(name: str, figure: Mapping[str, Any]) -> tuple[str, str, str, str, str]:
    factor, unit = _scale(figure["unit"])
    ends = [figure[key] for key in ("value", "low", "high")]
    value, low, high = ("-" if end is None else f"{end * factor:.4g}" for end in ends)
    between = "-" if "-" in (low, high) else f"{low} to {high}"
    return name.split("/", 1)[1], value, between, unit, str(figure["episodes"])


def print_comparison(made: Compared, runs: Sequence[Evaluated], reference: Evaluated | None) -> None:
    """Print every metric of the runs and of the reference controller side by side."""
    print(f"protocol {made.content['protocol']}, scenarios {made.content['scenarios_sha256'][:12]}")
    for number, run in enumerate(runs, start=1):
        print(f"run {number}: {display_name(run)}")
    several = len(runs) > 1
    heads = [f"run {number}" for number in range(1, len(runs) + 1)]
    over = ["mean", "95 % interval", "noise floor"] if several else []
    columns = ["metric", "unit", *heads, *over, *(["reference"] if reference is not None else [])]
    rows, unmeasured = [], []
    for row in made.seeds:
        factor, unit = _scale(row.unit)
        cells = [_difference_number(value, factor) for value in row.values]
        if several:
            mean = row.mean
            cells += [
                _difference_number(mean.value, factor),
                _between(mean.low, mean.high, factor),
                _difference_number(mean.floor, factor),
            ]
        if reference is not None:
            figure = reference.evaluation.metrics.get(row.metric)
            cells.append("-" if figure is None else _difference_number(figure.value, factor))
        if set(cells) == {"-"}:
            unmeasured.append(row.metric)
        else:
            rows.append((row.metric, unit, *cells))
    print_table(columns, rows, heads=1)
    _print_unmeasured(unmeasured)
    if several:
        print(hanging("intervals: bootstrap over the runs and, within each run, over its episodes", 0))


def print_differences(made: Compared) -> None:
    """Print the differences between the runs and the opposite runs, metric by metric, and the verdict."""
    shown = [row for row in made.differences if row.better and math.isfinite(row.interval.value)]
    rows = [_difference(row) for row in shown]
    print()
    print_table(("metric", "unit", "these", "those", "difference", "95 % interval", "test", "p", "is"), rows)
    print(hanging("p: two-sided, paired if episodes have equal starts, corrected for all tests (Holm)", 0))
    for verdict in filter(None, (made.push_verdict, made.verdict)):
        print(f"\n{hanging(verdict, 0)}")


def _difference(row: Difference) -> tuple[str, ...]:
    factor, unit = _scale(row.unit)
    value = row.interval
    test = ("", "") if row.test is None or row.p is None else (row.test.test, f"{row.p:.2g}")
    numbers = (
        _difference_number(row.first, factor),
        _difference_number(row.second, factor),
        _difference_number(value.value, factor),
    )
    return row.metric, unit, *numbers, _between(value.low, value.high, factor), *test, row.outcome or "-"


def _scale(unit: str) -> tuple[float, str]:
    return (180.0 / math.pi if unit in _DEGREES else 1.0), _DEGREES.get(unit, unit)


def _between(low: float, high: float, factor: float) -> str:
    ends = _difference_number(low, factor), _difference_number(high, factor)
    return "-" if "-" in ends else " to ".join(ends)


def _difference_number(value: float, factor: float) -> str:
    return f"{value * factor:.3g}" if math.isfinite(value) else "-"
