"""Decide whether rounding alone can explain why two training runs have unequal numbers.

A training amplifies even a difference in the last digit of a number. In a test, two runs with different matrix kernels
agreed to 1e-6 for about four iterations, and after eight only in statistics such as the mean return. Two runs are
within tolerance if they pass two tests:

- Start: in the first iteration whose scalars differ, each scalar agrees within ``START`` of the larger magnitude, and
  so do the networks' parameters (Euclidean) if both runs have a checkpoint of that iteration. In tests, the scalars of
  two runs deviated by 1e-6 with different matrix kernels, and by at least 0.4 with different seeds.
- End: the return and the length of episodes, averaged over the last tenth of the iterations, agree within ``END`` of
  their range, or within ``SPREADS`` times their own fluctuation in these iterations if that is more. In a test with 110
  iterations, the final mean returns of two runs differed by 0.001 times the range of the return.

Averages skip iterations without a return or episode length. If only one run has such a final value, or if both lack
them after at least 50 iterations, the runs are not within tolerance. Runs with fewer than 50 iterations only need to
pass the first test. Without a known cause of unequal numbers, such as another CPU, two runs must be equal bit for bit.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Sequence
from dataclasses import asdict, dataclass

from wheelleg_exp.run.iteration_log import Line

START, END, SPREADS = 1e-3, 0.1, 2.0
FIGURES = ("Train/mean_reward", "Train/mean_episode_length")
_SHORTEST = 50  # Compare the final returns of two runs only if both runs have at least 50 iterations.
_TINY = 1e-9  # Divide a deviation by at least 1e-9, because smaller scalars are rounding errors.


@dataclass(frozen=True)
class Excess:
    """One number's values in two runs, the deviation between the values, and the largest allowed deviation."""

    name: str
    iteration: int | None  # ``iteration`` is the iteration of both values; None if both are means over iterations.
    a: float
    b: float
    off: float  # ``off`` is relative for two scalars, and absolute for two means over iterations.
    allowed: float

    @property
    def within(self) -> bool:
        return self.off <= self.allowed

    @property
    def sign(self) -> str:
        """The words between a deviation and its limit in a report: ``within`` or ``more than``."""
        return "within" if self.within else "more than"


@dataclass(frozen=True)
class Tolerance:
    """The measured deviations between the numbers of two runs, with the largest allowed deviations."""

    start: list[Excess]  # The largest deviations between two runs in the first iteration in which the runs differ.
    end: list[Excess]  # The deviations between two runs' final returns and between their final episode lengths.
    note: str = ""  # ``note`` names numbers that were not compared, and the reason.
    needs_end: bool = False  # True if the two runs must also agree at the end of the training.

    @property
    def unknown(self) -> bool:
        """True if the two runs agree at the start, but neither has a final return or a final episode length."""
        return self.needs_end and not self.end and all(excess.within for excess in self.start)

    @property
    def within(self) -> bool:
        return not self.unknown and all(excess.within for excess in (*self.start, *self.end))

    def summary(self) -> str:
        """Return a text such as ``they first differ in iteration 3 by at most 1.0e-06 (Train/mean_reward)``."""
        worst = max(self.start, key=lambda excess: excess.off, default=None)
        if worst is None:
            return "digests differ, and no scalar does"
        alike = ", and they end alike" if self.end else ""
        return f"they first differ in iteration {worst.iteration} by at most {worst.off:.1e} ({worst.name}){alike}"

    def as_dict(self) -> dict[str, object]:
        rows = {side: [asdict(e) | {"within": e.within} for e in getattr(self, side)] for side in ("start", "end")}
        return {"within": self.within, **rows, "note": self.note}

    def lines(self) -> list[str]:
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
    """Measure the deviations between two runs in the iterations that both runs have.

    ``parameters`` contains the first iteration in which the runs differ, and the relative distance of their parameters;
    None without a checkpoint of it. ``whole`` is true if ``a`` and ``b`` are the complete logs of both runs.
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
    """Return the scalar with the largest relative deviation between the log lines of two runs."""
    excesses = []
    for name in dict.fromkeys([*a.scalars, *b.scalars]):
        one, other = a.scalars.get(name), b.scalars.get(name)
        if one != other:
            # A scalar that is missing, or that the log contains as the text ``NaN``, becomes the float NaN.
            x, y = _number(one), _number(other)
            off = math.inf if math.isnan(x) or math.isnan(y) else abs(x - y) / max(abs(x), abs(y), _TINY)
            excesses.append(Excess(name, a.iteration, x, y, off, START))
    return max(excesses, key=lambda excess: excess.off)


def _end(name: str, a: Sequence[Line], b: Sequence[Line]) -> Excess | None:
    """Compare a scalar's mean over the last tenth of the iterations of two runs; None if neither has the scalar."""
    ones, others = ([_number(line.scalars.get(name)) for line in lines] for lines in (a, b))
    last = max(len(a) // 10, 2)
    one, other = _finite(ones[-last:]), _finite(others[-last:])
    if not (one or other):
        return None
    mean_a, mean_b = (statistics.fmean(values) if values else math.nan for values in (one, other))
    if min(len(one), len(other)) < 2:  # The standard deviation needs at least two values.
        return Excess(name, None, mean_a, mean_b, math.inf, 0.0)
    values = _finite([*ones, *others])
    fluctuation = math.sqrt(statistics.variance(one) + statistics.variance(other))
    allowed = max(END * (max(values) - min(values)), SPREADS * fluctuation)
    return Excess(name, None, mean_a, mean_b, abs(mean_a - mean_b), allowed)


def _finite(values: Sequence[float]) -> list[float]:
    return [value for value in values if math.isfinite(value)]


def _number(value: object) -> float:
    return float(value) if isinstance(value, (int, float)) and not isinstance(value, bool) else math.nan
