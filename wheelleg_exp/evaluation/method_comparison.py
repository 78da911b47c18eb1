"""Compare evaluations: one method over several training seeds, and one method against another.

``verdict`` and ``push_verdict`` summarise the differences in words.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from wheelleg_exp.errors import RunDirectoryError
from wheelleg_exp.evaluation import significance
from wheelleg_exp.evaluation.metric_catalogue import Array, Metric, metrics_of, resampled, worst
from wheelleg_exp.evaluation.result import Evaluation
from wheelleg_exp.evaluation.significance import ALPHA, Interval, Test
from wheelleg_exp.managers.streams import stream_seed


@dataclass(frozen=True)
class OverSeeds:
    """One metric over several trainings that differ by their seed.

    Attributes:
        metric: ``group/metric``.
        unit: unit of all numbers.
        better: ``higher``, ``lower``, or empty.
        values: value of each training.
        mean: mean over the trainings, with its interval clustered by training.
        interquartile_mean: over the trainings.
    """

    metric: str
    unit: str
    better: str
    values: tuple[float, ...]
    mean: Interval
    interquartile_mean: float


@dataclass(frozen=True)
class Difference:
    """The difference of two methods in one metric.

    Attributes:
        metric: ``group/metric``.
        unit: unit of all numbers.
        better: ``higher``, ``lower``, or empty. It is empty for worst values, whose differences cannot be tested.
        first: mean over the trainings of the method in question.
        second: mean over the trainings of the other method.
        interval: first minus second, with its bootstrap interval.
        test: test of the episodes; None for metrics of several columns.
        p: p value of the test, corrected for the number of metrics (Holm); None without a test.
    """

    metric: str
    unit: str
    better: str
    first: float
    second: float
    interval: Interval
    test: Test | None
    p: float | None

    @property
    def outcome(self) -> str:
        """``better`` or ``worse`` if the first method's difference is significant, else empty.

        The corrected test must be significant and agree with the sign of the means. Without a test, the interval must
        exclude 0.
        """
        value, low, high = self.interval.value, self.interval.low, self.interval.high
        sure = self.p < ALPHA if self.p is not None else low > 0.0 or high < 0.0
        if not sure or not self.better or value == 0.0 or math.isnan(value):
            return ""
        if self.test is not None and min(self.test.difference * value, self.test.effect * value) < 0.0:
            return ""  # the median or the ranks point one way, and a few episodes pull the means the other way
        return "better" if (value > 0.0) == (self.better == "higher") else "worse"

    def as_dict(self) -> dict[str, Any]:
        """Return the difference for JSON, with None for NaN and inf."""
        return plain({**asdict(self), "outcome": self.outcome})


def over_seeds(evaluations: Sequence[Evaluation]) -> list[OverSeeds]:
    """Return every metric that all evaluations have, over the trainings.

    ``evaluations`` are the evaluations of trainings that differ by their seed, in the same scenarios.

    Raises:
        RunDirectoryError: their scenarios differ.
    """
    require_same_scenarios(evaluations)
    found = []
    for metric in _shared(evaluations):
        values = tuple(evaluation.value(metric.name) for evaluation in evaluations)
        mean = significance.clustered(values, _draws(metric, evaluations), _generator(evaluations[0], metric, "seeds"))
        finite = np.array([value for value in values if math.isfinite(value)])
        iqm = significance.interquartile_mean(finite)
        found.append(OverSeeds(metric.name, metric.unit, metric.better, values, mean, iqm))
    return found


def differences(first: Sequence[Evaluation], second: Sequence[Evaluation]) -> list[Difference]:
    """Return the differences of two methods in every metric that both have.

    Episodes with the same start are pairs. Several trainings of a method count with their mean in each scenario.

    ``first`` are the evaluations of the method in question, one per training seed. ``second`` are the evaluations
    of the other method.

    Raises:
        RunDirectoryError: their scenarios differ.
    """
    everyone = [*first, *second]
    require_same_scenarios(everyone)
    found = [_difference(metric, first, second, paired(everyone, metric.test)) for metric in _shared(everyone)]
    corrected = significance.holm({row.metric: row.test.p for row in found if row.test is not None and row.better})
    return [replace(row, p=corrected.get(row.metric)) for row in found]


def paired(evaluations: Sequence[Evaluation], test: str) -> bool:
    """Return whether the episodes of a test had the same starts in all evaluations."""
    return len({evaluation.starts_sha256.get(test) for evaluation in evaluations}) == 1


def require_same_scenarios(evaluations: Sequence[Evaluation]) -> None:
    """Raise RunDirectoryError unless all evaluations have the same scenarios."""
    digests = list(dict.fromkeys(evaluation.scenarios_sha256 for evaluation in evaluations))
    if len(digests) > 1:
        raise RunDirectoryError(
            "evaluations of different scenarios cannot be compared: " + ", ".join(d[:12] for d in digests),
            expected="the same protocol, numbers, and seed for all evaluations",
        )


def plain(value: Any) -> Any:
    """Return a value for JSON, with None for NaN and inf."""
    if isinstance(value, Mapping):
        return {key: plain(inner) for key, inner in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(inner) for inner in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _shared(evaluations: Sequence[Evaluation]) -> list[Metric]:
    """Return the metrics that all evaluations have."""
    first = evaluations[0]
    tests = list(dict.fromkeys(first.episodes["test"].tolist()))
    shared = [name for name in first.episodes if all(name in one.episodes for one in evaluations)]
    found = []
    for test in tests:
        mine = first.episodes["test"] == test
        found += metrics_of(test, {name: first.episodes[name][mine] for name in shared}, first.protocol)
    return [metric for metric in found if all(metric.name in one.metrics for one in evaluations)]


def _draws(metric: Metric, evaluations: Sequence[Evaluation]) -> list[Array]:
    resamples = int(evaluations[0].protocol["resamples"])
    return [resampled(metric, one.episodes, one.seed, resamples) for one in evaluations]


def _generator(evaluation: Evaluation, metric: Metric, use: str) -> np.random.Generator:
    return np.random.default_rng(stream_seed(evaluation.seed, f"bootstrap.{use}.{metric.name}"))


def _difference(
    metric: Metric, first: Sequence[Evaluation], second: Sequence[Evaluation], are_pairs: bool
) -> Difference:
    means = [float(np.mean([one.value(metric.name) for one in group])) for group in (first, second)]
    generator = _generator(first[0], metric, "difference")
    drawn = [significance.clustered_means(_draws(metric, group), generator) for group in (first, second)]
    count = min(map(len, drawn))
    interval = significance.interval(means[0] - means[1], drawn[0][:count] - drawn[1][:count], generator)
    if metric.reduce is worst:  # neither a test nor a bootstrap is valid for the maximum of a sample
        bare = Interval(interval.value, math.nan, math.nan, math.nan)
        return Difference(metric.name, metric.unit, "", means[0], means[1], bare, None, None)
    test = _test(metric, first, second, are_pairs) if len(metric.columns) == 1 else None
    return Difference(metric.name, metric.unit, metric.better, means[0], means[1], interval, test, None)


def _test(metric: Metric, first: Sequence[Evaluation], second: Sequence[Evaluation], are_pairs: bool) -> Test | None:
    (name,) = metric.columns
    if are_pairs:
        kept = np.logical_and.reduce([metric.kept(one.episodes) for one in (*first, *second)])
        one, other = (np.mean([each.episodes[name][kept] for each in group], axis=0) for group in (first, second))
    else:
        one, other = (np.concatenate([metric.values(each.episodes)[0] for each in group]) for group in (first, second))
    # Pairs stay aligned: an episode is dropped from both sides if one side is not finite.
    finite = np.isfinite(one) & np.isfinite(other) if are_pairs else None
    if finite is not None:
        one, other = one[finite], other[finite]
    if not len(one) or not len(other):
        return None
    outcomes = bool(np.isin(np.concatenate((one, other)), (0.0, 1.0)).all())
    if are_pairs:
        return significance.mcnemar(other, one) if outcomes else significance.wilcoxon(other, one)
    return significance.fisher(other, one) if outcomes else significance.mann_whitney(other, one)


_LIMIT, _WORST = "push/limit_", "push/limit_worst_"


def verdict(found: Sequence[Difference], first: str, second: str, trainings: Sequence[int]) -> str:
    """Return a summary of the differences in words.

    ``first`` is the name of the method in question. ``second`` is the name of the other method.
    """
    tested = [row for row in found if row.better and math.isfinite(row.interval.value)]
    better = [row.metric for row in tested if row.outcome == "better"]
    worse = [row.metric for row in tested if row.outcome == "worse"]
    if not better and not worse:
        text = f"No difference between {first} and {second} is significant in any of {len(tested)} metrics."
    elif not worse:
        text = f"{first} is better than {second} in {_listed(better, len(tested))}, and worse in none."
    elif not better:
        text = f"{first} is worse than {second} in {_listed(worse, len(tested))}, and better in none."
    else:
        text = f"{first} is better than {second} in {_listed(better, len(tested))}, and worse in {_listed(worse)}."
    if min(trainings, default=0) == 1:
        text += " A single training per method compares policies, not methods: another seed can give another result."
    return text


def push_verdict(found: Sequence[Difference], first: str, second: str) -> str:
    """Return one line that says whether a method survives harder pushes than another; empty without push tests.

    It is better if it survives significantly harder pushes of every kind: kicks, and pulses of each length.

    ``first`` is the name of the method in question. ``second`` is the name of the other method.
    """
    rows = {row.metric: row for row in found}
    kinds = [name.removeprefix(_WORST) for name in rows if name.startswith(_WORST)]
    limits = [(kind, rows[_LIMIT + kind]) for kind in kinds if _LIMIT + kind in rows]
    if not limits:
        return ""
    outcomes = {row.outcome for _, row in limits}
    if len(outcomes) == 1:
        word = f"{outcomes.pop() or 'neither better nor worse'} in push recovery than"
    elif {"better", "worse"} <= outcomes:
        word = "better in some pushes and worse in others than"
    else:
        word = f"{'better' if 'better' in outcomes else 'worse'} in some pushes, not in all, than"
    text = f"{first} is {word} {second}: it survives " + "; ".join(_limit(kind, row) for kind, row in limits) + "."
    ratios = [f"{row.second / row.first:.2g} times {_push(kind)}" for kind, row in limits if row.first]
    text += f" {second[0].upper()}{second[1:]} survives {' and '.join(ratios)} that {first} survives." if ratios else ""
    single = [row for name, row in rows.items() if name.startswith(_LIMIT) and "°" in name]
    counts = [(len([row for row in single if row.outcome == word]), word) for word in ("better", "worse")]
    tally = " and ".join(f"{word} in {count}" for count, word in counts if count)
    return text + (f" Of {len(single)} directions and kinds it is {tally}." if tally else "")


def _push(kind: str, article: str = "the") -> str:
    return f"{article} kick" if kind == "0s" else f"{article} push over {kind.removesuffix('s')} s"


def _limit(kind: str, row: Difference) -> str:
    apart = f"{row.interval.value:+.3g}, 95 % interval {row.interval.low:+.3g} to {row.interval.high:+.3g}"
    sure = "" if row.p is None else f", p {row.p:.2g}"
    return f"{_push(kind, 'a')} of {row.first:.3g} against {row.second:.3g} {row.unit} ({apart}{sure})"


def _listed(names: Sequence[str], of: int | None = None) -> str:
    counted = f"{len(names)} metric" + ("s" if len(names) > 1 else "")
    return f"{counted}{'' if of is None else f' of {of}'} ({', '.join(names)})"
