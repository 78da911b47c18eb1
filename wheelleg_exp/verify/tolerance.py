"""Decide whether two runs with unequal numbers are the same training up to rounding.

A training amplifies a difference in the last digit of a number. Two runs of the stock task with other matrix kernels
agree to 1e-6 for about four iterations, and after eight iterations only their statistics agree. Therefore no tolerance
can apply to every iteration. Two runs are within tolerance if they pass two tests:

- Start: in the first iteration whose scalars differ, each scalar agrees within ``START`` of the larger magnitude, and
  so do the networks' parameters (Euclidean) if both runs have a checkpoint of that iteration. Other matrix kernels gave
  a deviation of 1e-6, another seed one of at least 0.4.
- End: the return and the length of episodes, averaged over the last tenth of the iterations, agree within ``END`` of
  their range, or within ``SPREADS`` times their own fluctuation in these iterations if that is more. The fluctuation is
  large while a run still learns fast. After 110 iterations, the deviation was 0.001 of the range.

Iterations without a value of the figure are skipped, such as those before the end of the first episode. A figure that
only one run has at the end fails the test. A figure that is missing in both runs gives a note. Runs of at least 50
iterations without any comparable figure are not within tolerance. Shorter runs, and the first parts of runs, only need
to pass the start test.

If no known difference of the runs allows unequal numbers, every bit must be equal and these tests do not apply.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

from wheelleg_exp.run.iteration_log import Line

START, END, SPREADS = 1e-3, 0.1, 2.0
FIGURES = ("Train/mean_reward", "Train/mean_episode_length")
_SHORTEST = 50  # The ends of runs with fewer iterations are not compared.
_TINY = 1e-9  # Smaller magnitudes are treated as zero, because small scalars are often means of terms that cancel.


@dataclass(frozen=True)
class Excess:
    """One number of two runs, its deviation between the runs, and the largest allowed deviation."""

    name: str
    iteration: int | None  # None for a mean over the last iterations
    a: float
    b: float
    off: float  # relative in the first differing iteration, absolute at the end of the runs
    allowed: float

    @property
    def within(self) -> bool:
        """Whether the number's deviation between the two runs is allowed."""
        return self.off <= self.allowed

    @property
    def sign(self) -> str:
        """Whether the deviation is below or above the largest allowed deviation, in words."""
        return "within" if self.within else "more than"


@dataclass(frozen=True)
class Tolerance:
    """The measured deviations of two runs."""

    start: list[Excess]  # largest deviations in the first iteration that differs
    end: list[Excess]  # the deviation of each figure at the end
    note: str = ""  # which figures were not compared
    needs_end: bool = False  # whether the last iterations of both runs had to be compared

    @property
    def unknown(self) -> bool:
        """Whether the first differing iteration is within tolerance, but the necessary end test was impossible."""
        return self.needs_end and not self.end and all(excess.within for excess in self.start)

    @property
    def within(self) -> bool:
        """Whether all deviations that had to be compared are allowed."""
        return not self.unknown and all(excess.within for excess in (*self.start, *self.end))

    def summary(self) -> str:
        """Return the iteration in which the runs first differ, and the largest deviation there."""
        worst = max(self.start, key=lambda excess: excess.off, default=None)
        if worst is None:
            return "digests differ, and no scalar does"
        alike = ", and they end alike" if self.end else ""
        return f"they first differ in iteration {worst.iteration} by at most {worst.off:.1e} ({worst.name}){alike}"

    def as_dict(self) -> dict[str, Any]:
        """Return the deviations of two runs as a JSON document."""
        rows = {side: [asdict(e) | {"within": e.within} for e in getattr(self, side)] for side in ("start", "end")}
        return {"within": self.within, **rows, "note": self.note}

    def lines(self) -> list[str]:
        """Return the deviations of two runs as printed lines."""
        lines = []
        for x in self.start:
            values = "" if math.isnan(x.a) else f" (A {x.a:.9g}, B {x.b:.9g})"
            lines.append(f"iteration {x.iteration}: {x.name} off by {x.off:.1e}{values}, {x.sign} {x.allowed:.0e}")
        for x in self.end:
            apart = f"apart {x.off:.3g}, {x.sign} {x.allowed:.3g}"
            apart = "and too few values to compare" if math.isinf(x.off) else apart
            lines.append(f"mean over the last tenth: {x.name} {x.a:.4g} and {x.b:.4g}, {apart}")
        return [*lines, self.note] if self.note else lines


def judge(a: Sequence[Line], b: Sequence[Line], parameters: tuple[int, float] | None, *, whole: bool) -> Tolerance:
    """Measure the deviations of two runs in the iterations that both runs have.

    ``parameters`` is the first differing iteration and the relative distance of the networks there, if both runs saved
    a checkpoint. ``whole`` is true if both runs ended with the last of these iterations.
    """
    parting = next(((x, y) for x, y in zip(a, b, strict=True) if x.scalars != y.scalars), None)
    start = [] if parting is None else [_start(*parting)]
    if parameters is not None:
        start.append(Excess("networks' parameters", parameters[0], math.nan, math.nan, parameters[1], START))
    if not whole or len(a) < _SHORTEST:
        note = "one run went on" if not whole else f"{len(a)} iterations are fewer than {_SHORTEST}"
        return Tolerance(start, [], f"the ends were not compared: {note}")
    ends = {name: _end(name, a, b) for name in FIGURES}
    missing = [name for name, excess in ends.items() if excess is None]
    note = f"not compared at the end, because neither run has it: {', '.join(missing)}" if missing else ""
    return Tolerance(start, [excess for excess in ends.values() if excess is not None], note, needs_end=True)


def _start(a: Line, b: Line) -> Excess:
    """Return the scalar of an iteration with the largest deviation."""
    excesses = []
    for name in dict.fromkeys([*a.scalars, *b.scalars]):
        one, other = a.scalars.get(name), b.scalars.get(name)
        if one != other:
            # NaN is stored as text, and one run can lack the scalar.
            x, y = _number(one), _number(other)
            off = math.inf if math.isnan(x) or math.isnan(y) else abs(x - y) / max(abs(x), abs(y), _TINY)
            excesses.append(Excess(name, a.iteration, x, y, off, START))
    return max(excesses, key=lambda excess: excess.off)


def _end(name: str, a: Sequence[Line], b: Sequence[Line]) -> Excess | None:
    """Return the deviation of a figure over the last tenth of the iterations; None if neither run has it there."""
    ones, others = ([_number(line.scalars.get(name)) for line in lines] for lines in (a, b))
    last = max(len(a) // 10, 2)
    one, other = _finite(ones[-last:]), _finite(others[-last:])
    if not (one or other):
        return None
    mean_a, mean_b = (statistics.fmean(values) if values else math.nan for values in (one, other))
    if min(len(one), len(other)) < 2:  # The fluctuation of a figure needs at least two values.
        return Excess(name, None, mean_a, mean_b, math.inf, 0.0)
    values = _finite([*ones, *others])
    fluctuation = math.sqrt(statistics.variance(one) + statistics.variance(other))
    allowed = max(END * (max(values) - min(values)), SPREADS * fluctuation)
    return Excess(name, None, mean_a, mean_b, abs(mean_a - mean_b), allowed)


def _finite(values: Sequence[float]) -> list[float]:
    return [value for value in values if math.isfinite(value)]


def _number(value: Any) -> float:
    return float(value) if isinstance(value, (int, float)) and not isinstance(value, bool) else math.nan
