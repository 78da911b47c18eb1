"""How evaluations are printed side by side."""

from __future__ import annotations

import math
from collections.abc import Sequence

from wheelleg_exp.cli.printing.evaluation import print_untold
from wheelleg_exp.cli.printing.tables import hanging, print_table
from wheelleg_exp.evaluation.comparison import Difference
from wheelleg_exp.jobs.evaluate.compare import Compared, name_of
from wheelleg_exp.jobs.evaluate.evaluate import Evaluated

_DEGREES = {"rad": "°", "rad/s": "°/s"}


def print_comparison(made: Compared, runs: Sequence[Evaluated], reference: Evaluated | None) -> None:
    """Print every metric of the runs side by side, and how they differ from what they are held against."""
    print(f"protocol {made.content['protocol']}, scenarios {made.content['scenarios_sha256'][:12]}")
    for number, run in enumerate(runs, start=1):
        print(f"run {number}: {name_of(run)}")
    several = len(runs) > 1
    heads = [f"run {number}" for number in range(1, len(runs) + 1)]
    over = ["mean", "95 % interval", "noise floor"] if several else []
    columns = ["metric", "unit", *heads, *over, *(["reference"] if reference is not None else [])]
    rows, untold = [], []
    for row in made.seeds:
        factor, unit = _scale(row.unit)
        cells = [_number(value, factor) for value in row.values]
        if several:
            mean = row.mean
            cells += [_number(mean.value, factor), _between(mean.low, mean.high, factor), _number(mean.floor, factor)]
        if reference is not None:
            figure = reference.evaluation.metrics.get(row.metric)
            cells.append("-" if figure is None else _number(figure.value, factor))
        if set(cells) == {"-"}:
            untold.append(row.metric)
        else:
            rows.append((row.metric, unit, *cells))
    print_table(columns, rows, heads=1)
    print_untold(untold)
    if several:
        print(hanging("intervals are of a bootstrap over the runs and, within each, its episodes", 0))


def print_differences(made: Compared) -> None:
    """Print how the runs differ from what they are held against, metric by metric, and in a sentence."""
    shown = [row for row in made.differences if row.better and math.isfinite(row.interval.value)]
    rows = [_difference(row) for row in shown]
    print()
    print_table(("metric", "unit", "these", "those", "difference", "95 % interval", "test", "p", "is"), rows)
    print(hanging("p: two-sided, of paired episodes where they began alike, corrected for all tests (Holm)", 0))
    for said in filter(None, (made.push_verdict, made.verdict)):
        print(f"\n{hanging(said, 0)}")


def _difference(row: Difference) -> tuple[str, ...]:
    factor, unit = _scale(row.unit)
    value = row.interval
    test = ("", "") if row.test is None or row.p is None else (row.test.test, f"{row.p:.2g}")
    numbers = (_number(row.first, factor), _number(row.second, factor), _number(value.value, factor))
    return row.metric, unit, *numbers, _between(value.low, value.high, factor), *test, row.outcome or "-"


def _scale(unit: str) -> tuple[float, str]:
    return (180.0 / math.pi if unit in _DEGREES else 1.0), _DEGREES.get(unit, unit)


def _between(low: float, high: float, factor: float) -> str:
    ends = _number(low, factor), _number(high, factor)
    return "-" if "-" in ends else " to ".join(ends)


def _number(value: float, factor: float) -> str:
    return f"{value * factor:.3g}" if math.isfinite(value) else "-"
