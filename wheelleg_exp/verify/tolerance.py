"""When numbers that are not equal count as the same training.

Training amplifies a difference in the last digit: of the stock task, two runs with other matrix kernels agree to
1e-6 for about four iterations, and have nothing in common but their statistics after eight. So no bound on every
iteration can hold, and two things are asked instead:

- where the runs part they part by rounding: in the first iteration whose scalars differ, each agrees within ``START``
  of the larger magnitude, and so do the networks' parameters (Euclidean) when both runs kept that checkpoint
  (measured: 1e-6; another seed: 0.4 and more);
- they end alike: the return and the length of episodes, averaged over the last tenth of the iterations, agree within
  ``END`` of the range that they went through or, where that is more, within ``SPREADS`` times their own fluctuation
  in these iterations, which is large while they still learn fast (measured after 110 iterations: 0.001 of the range).
  Iterations without the figure, as before the first episode has ended, are left out. A figure that one run alone has at
  the end is not alike; one that neither has is noted; and runs of at least 50 iterations of which no figure can be
  compared are not shown to be within tolerance. Shorter runs, and the beginnings of runs, are held to the start alone.

Neither is asked of runs between which nothing allows a difference: there, every bit must be equal.
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
_SHORTEST = 50  # iterations that a run must have for its end to say something
_TINY = 1e-9  # magnitudes below are zero: a mean of what cancels


@dataclass(frozen=True)
class Excess:
    """One number and how far it may be off.

    Attributes:
        name: the number.
        iteration: of which iteration; None for the mean over the last ones.
        a: its value in A.
        b: its value in B.
        off: how far they are apart, relative at the start, absolute at the end.
        allowed: how far they may be.
    """

    name: str
    iteration: int | None
    a: float
    b: float
    off: float
    allowed: float

    @property
    def within(self) -> bool:
        """Whether it is allowed."""
        return self.off <= self.allowed


@dataclass(frozen=True)
class Tolerance:
    """What was measured against the tolerances.

    Attributes:
        start: the worst numbers where the runs part.
        end: each figure at the end.
        note: what was not compared.
        needs_end: whether the ends had to be compared.
    """

    start: list[Excess]
    end: list[Excess]
    note: str = ""
    needs_end: bool = False

    @property
    def unknown(self) -> bool:
        """Whether the start is allowed, and the ends would have had to be compared and could not."""
        return self.needs_end and not self.end and all(excess.within for excess in self.start)

    @property
    def within(self) -> bool:
        """Whether everything is allowed, and everything that had to be compared was."""
        return not self.unknown and all(excess.within for excess in (*self.start, *self.end))

    def summary(self) -> str:
        """Return where the runs part, and by how much at most."""
        worst = max(self.start, key=lambda excess: excess.off, default=None)
        if worst is None:
            return "digests differ, and no scalar does"
        alike = ", and they end alike" if self.end else ""
        return f"they part in iteration {worst.iteration} by at most {worst.off:.1e} ({worst.name}){alike}"

    def as_dict(self) -> dict[str, Any]:
        """Return it for JSON."""
        rows = {side: [asdict(e) | {"within": e.within} for e in getattr(self, side)] for side in ("start", "end")}
        return {"within": self.within, **rows, "note": self.note}

    def lines(self) -> list[str]:
        """Return it for people."""
        told = [_start_line(excess) for excess in self.start] + [_end_line(excess) for excess in self.end]
        return [*told, self.note] if self.note else told


def judge(a: Sequence[Line], b: Sequence[Line], parameters: tuple[int, float] | None, *, whole: bool) -> Tolerance:
    """Measure two runs against the tolerances.

    Args:
        a: A's iterations.
        b: B's, as many.
        parameters: iteration and relative distance of the networks where the runs part, if they were kept.
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
    note = f"not compared at the end, for neither run has it: {', '.join(missing)}" if missing else ""
    return Tolerance(start, [excess for excess in ends.values() if excess is not None], note, needs_end=True)


def _start(a: Line, b: Line) -> list[Excess]:
    """Return the worst scalar of an iteration."""
    names = [name for name in dict.fromkeys([*a.scalars, *b.scalars]) if a.scalars.get(name) != b.scalars.get(name)]
    excesses = [_relative(name, a.iteration, a.scalars.get(name), b.scalars.get(name)) for name in names]
    return [max(excesses, key=lambda excess: excess.off)]


def _relative(name: str, iteration: int, a: Any, b: Any) -> Excess:
    if not (_is_number(a) and _is_number(b)):  # NaN is written as text; or one side has no such scalar
        return Excess(name, iteration, _number(a), _number(b), math.inf, START)
    scale = max(abs(a), abs(b), _TINY)
    return Excess(name, iteration, float(a), float(b), abs(a - b) / scale, START)


def _end(name: str, a: Sequence[Line], b: Sequence[Line]) -> Excess | None:
    """Return how far a figure is off over the last tenth; None when neither run has it there."""
    ones, others = ([_number(line.scalars.get(name)) for line in lines] for lines in (a, b))
    last = max(len(a) // 10, 2)
    one, other = _finite(ones[-last:]), _finite(others[-last:])
    if not (one or other):
        return None
    if min(len(one), len(other)) < 2:  # no mean with a fluctuation
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
