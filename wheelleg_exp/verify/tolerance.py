"""Decide whether unequal numbers count as the same training.

Training amplifies a difference in the last digit. Two runs of the stock task with other matrix kernels agree to 1e-6
for about four iterations, and after eight have only their statistics in common. So no bound on every iteration can
hold. Two tests replace it:

- Start: in the first iteration whose scalars differ, each scalar agrees within ``START`` of the larger magnitude. So do
  the networks' parameters (Euclidean) if both runs have that checkpoint. Measured: 1e-6; with another seed, 0.4 and
      more.
- End: the return and the length of episodes, averaged over the last tenth of the iterations, agree within ``END`` of
  their range, or within ``SPREADS`` times their own fluctuation in these iterations if that is more. The fluctuation is
  large while a run still learns fast. Measured after 110 iterations: 0.001 of the range.

Iterations without a figure are skipped, such as those before the first episode has ended. A figure that only one run
has at the end fails the test; a figure that neither has is noted. Runs of at least 50 iterations without any comparable
figure are not shown to be within tolerance. Shorter runs, and the first parts of runs, only pass the start test.

If nothing allows two runs to differ, every bit must be equal and these tests do not apply.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

from wheelleg_exp.run.iteration_log import Line

START = 1e-3
END = 0.1
SPREADS = 2.0
FIGURES = ("Train/mean_reward", "Train/mean_episode_length")
_SHORTEST = 50  # iterations; the ends of shorter runs are not compared
_TINY = 1e-9  # smaller magnitudes count as zero: they are means of terms that cancel


@dataclass(frozen=True)
class Excess:
    """One number and its allowed deviation.

    Attributes:
        name: the number.
        iteration: its iteration; None for the mean over the last iterations.
        a: its value in A.
        b: its value in B.
        off: the deviation: relative at the start, absolute at the end.
        allowed: the largest allowed deviation.
    """

    name: str
    iteration: int | None
    a: float
    b: float
    off: float
    allowed: float

    @property
    def within(self) -> bool:
        """Whether the deviation is allowed."""
        return self.off <= self.allowed


@dataclass(frozen=True)
class Tolerance:
    """The measured deviations.

    Attributes:
        start: the largest deviations in the first iteration that differs.
        end: the deviation of each figure at the end.
        note: what was not compared.
        needs_end: whether the ends had to be compared.
    """

    start: list[Excess]
    end: list[Excess]
    note: str = ""
    needs_end: bool = False

    @property
    def unknown(self) -> bool:
        """Whether the start is allowed, but the ends could not be compared although they had to be."""
        return self.needs_end and not self.end and all(excess.within for excess in self.start)

    @property
    def within(self) -> bool:
        """Whether every required comparison was made and is allowed."""
        return not self.unknown and all(excess.within for excess in (*self.start, *self.end))

    def summary(self) -> str:
        """Return where the runs first differ, and by how much at most."""
        worst = max(self.start, key=lambda excess: excess.off, default=None)
        if worst is None:
            return "digests differ, and no scalar does"
        alike = ", and they end alike" if self.end else ""
        return f"they first differ in iteration {worst.iteration} by at most {worst.off:.1e} ({worst.name}){alike}"

    def as_dict(self) -> dict[str, Any]:
        """Return the deviations for JSON."""
        rows = {side: [asdict(e) | {"within": e.within} for e in getattr(self, side)] for side in ("start", "end")}
        return {"within": self.within, **rows, "note": self.note}

    def lines(self) -> list[str]:
        """Return the printed lines."""
        lines = [_start_line(excess) for excess in self.start] + [_end_line(excess) for excess in self.end]
        return [*lines, self.note] if self.note else lines


def judge(a: Sequence[Line], b: Sequence[Line], parameters: tuple[int, float] | None, *, whole: bool) -> Tolerance:
    """Measure the deviations of two runs.

    Args:
        a: the iterations of A.
        b: the iterations of B, as many.
        parameters: the first differing iteration and the relative distance of the networks there, if both were saved.
        whole: whether both runs ended with the last of these iterations.
    """
    parting = next((i for i, (x, y) in enumerate(zip(a, b, strict=True)) if x.scalars != y.scalars), None)
    start = [] if parting is None else _start(a[parting], b[parting])
    if parameters is not None:
        start.append(Excess("networks' parameters", parameters[0], math.nan, math.nan, parameters[1], START))
    if not whole or len(a) < _SHORTEST:
        note = "one run went on" if not whole else f"{len(a)} iterations are fewer than {_SHORTEST}"
        return Tolerance(start, [], f"the ends were not compared: {note}")
    ends = {name: _end(name, a, b) for name in FIGURES}
    missing = [name for name, excess in ends.items() if excess is None]
    note = f"not compared at the end, because neither run has it: {', '.join(missing)}" if missing else ""
    return Tolerance(start, [excess for excess in ends.values() if excess is not None], note, needs_end=True)


def _start(a: Line, b: Line) -> list[Excess]:
    """Return the scalar of an iteration with the largest deviation."""
    names = [name for name in dict.fromkeys([*a.scalars, *b.scalars]) if a.scalars.get(name) != b.scalars.get(name)]
    excesses = [_relative(name, a.iteration, a.scalars.get(name), b.scalars.get(name)) for name in names]
    return [max(excesses, key=lambda excess: excess.off)]


def _relative(name: str, iteration: int, a: Any, b: Any) -> Excess:
    if not (_is_number(a) and _is_number(b)):  # NaN is stored as text, and one side may lack the scalar
        return Excess(name, iteration, _number(a), _number(b), math.inf, START)
    scale = max(abs(a), abs(b), _TINY)
    return Excess(name, iteration, float(a), float(b), abs(a - b) / scale, START)


def _end(name: str, a: Sequence[Line], b: Sequence[Line]) -> Excess | None:
    """Return the deviation of a figure over the last tenth of the iterations; None if neither run has it there."""
    ones, others = ([_number(line.scalars.get(name)) for line in lines] for lines in (a, b))
    last = max(len(a) // 10, 2)
    one, other = _finite(ones[-last:]), _finite(others[-last:])
    if not (one or other):
        return None
    if min(len(one), len(other)) < 2:  # too few values for a fluctuation
        return Excess(name, None, _mean(one), _mean(other), math.inf, 0.0)
    values = _finite([*ones, *others])
    spread = max(values) - min(values)
    fluctuation = math.sqrt(statistics.variance(one) + statistics.variance(other))
    allowed = max(END * spread, SPREADS * fluctuation)
    return Excess(name, None, _mean(one), _mean(other), abs(_mean(one) - _mean(other)), allowed)


def _mean(values: Sequence[float]) -> float:
    return statistics.fmean(values) if values else math.nan


def _finite(values: Sequence[float]) -> list[float]:
    return [value for value in values if math.isfinite(value)]


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def _number(value: Any) -> float:
    return float(value) if _is_number(value) else math.nan


def _start_line(excess: Excess) -> str:
    values = "" if math.isnan(excess.a) else f" (A {excess.a:.9g}, B {excess.b:.9g})"
    sign = "within" if excess.within else "more than"
    return f"iteration {excess.iteration}: {excess.name} off by {excess.off:.1e}{values}, {sign} {excess.allowed:.0e}"


def _end_line(excess: Excess) -> str:
    sign = "within" if excess.within else "more than"
    means = f"{excess.name} {excess.a:.4g} and {excess.b:.4g}"
    if math.isinf(excess.off):
        return f"mean over the last tenth: {means}, and too few values to compare"
    return f"mean over the last tenth: {means}, apart {excess.off:.3g}, {sign} {excess.allowed:.3g}"
