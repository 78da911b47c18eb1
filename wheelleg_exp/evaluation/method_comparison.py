"""Compare evaluations: one method over several training seeds, and one method against another."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace

import numpy as np
from scipy import stats

from wheelleg_exp.errors import RunDirectoryError
from wheelleg_exp.evaluation.metric_catalogue import LEVEL, Array, Metric, metrics_of, percentiles, resampled, worst
from wheelleg_exp.evaluation.result import Evaluation, plain
from wheelleg_exp.managers.streams import stream_seed

DIFFERS = "differs"  # No engine is better than another one.
ALPHA = 0.05  # significance level


@dataclass(frozen=True)
class Interval:
    """A metric's value with the lower and the upper end of its 95 % confidence interval.

    ``floor`` is the noise floor: two repetitions of the same experiment differ by at most ``floor`` in 95 % of cases.
    """

    value: float
    low: float
    high: float
    floor: float


@dataclass(frozen=True)
class Test:
    """The result of a statistical test that compares the episodes of two methods.

    ``test`` is ``McNemar`` or ``Wilcoxon`` for pairs of episodes, otherwise ``Fisher`` or ``Mann-Whitney``. ``p`` is
    two-sided. Without pairs, ``pairs`` is the size of the smaller group; ``untied`` is the number of pairs that differ.
    ``difference`` is second minus first: of shares or medians, or the median of the pairs' differences. ``effect`` (-1
    to 1, positive if the second is larger) is the rank-biserial correlation (Kerby, 2014), or the difference of shares.
    ``effect`` and ``difference`` can have opposite signs.
    """

    test: str
    p: float
    pairs: int
    untied: int | None
    difference: float
    effect: float


@dataclass(frozen=True)
class OverSeeds:
    """A metric's values in trainings that differ only in the seed, and the values' mean with a bootstrap interval."""

    metric: str
    unit: str
    better: str
    values: tuple[float, ...]
    mean: Interval
    interquartile_mean: float


@dataclass(frozen=True)
class Difference:
    """The difference between two methods in one metric.

    ``first`` and ``second`` are means over the trainings of each method; ``interval`` is first minus second, with its
    bootstrap interval. ``better`` is ``higher``, ``lower``, or empty for metrics without a better direction; between
    two engines, ``differs``. ``test`` and ``p`` are None for metrics of several columns; ``p`` is corrected for the
    number of metrics (Holm).
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
        """Whether the first method is significantly ``better`` or ``worse`` than the second or ``differs``, else empty.

        A difference is significant if its corrected p value is below ``ALPHA``, and mean, median, and effect size do
        not have opposite signs; without a test, if its confidence interval excludes 0.
        """
        value, low, high = self.interval.value, self.interval.low, self.interval.high
        sure = self.p < ALPHA if self.p is not None else low > 0.0 or high < 0.0
        if not sure or not self.better or value == 0.0 or math.isnan(value):
            return ""
        # Call no method better if the means favour one method, but the median or the ranks favour the other method.
        if self.test is not None and min(self.test.difference * value, self.test.effect * value) < 0.0:
            return ""
        if self.better == DIFFERS:
            return DIFFERS
        return "better" if (value > 0.0) == (self.better == "higher") else "worse"

    def as_dict(self) -> dict[str, object]:
        """Return the difference of two methods as a dictionary for JSON, in which None replaces NaN and inf."""
        return {key: plain(value) for key, value in {**asdict(self), "outcome": self.outcome}.items()}


# --- intervals ---


def interquartile_mean(values: Array) -> float:
    """Return the interquartile mean (mean of the middle half) of ``values``; NaN for an empty array.

    It ignores a quarter of the values, rounded down, at each end (Agarwal et al., 2021, arXiv:2108.13264).
    """
    return float(stats.trim_mean(values, 0.25)) if len(values) else math.nan


def clustered(values: Sequence[float], drawn: Sequence[Array], generator: np.random.Generator) -> Interval:
    """Return a metric's mean over S training seeds with a percentile interval of a bootstrap over seeds and episodes.

    Each seed has a value, and B bootstrap values in ``drawn``. The interval of one seed covers only episodes.
    """
    finite = [value for value in values if np.isfinite(value)]
    return interval(float(np.mean(finite)) if finite else math.nan, clustered_means(drawn, generator), generator)


def clustered_means(drawn: Sequence[Array], generator: np.random.Generator) -> Array:
    """Return B bootstrap means over resampled training seeds and over resampled episodes of each seed, (B,).

    The episodes of one seed are not independent samples of the method, so the seeds are resampled first, and then their
    episodes (Davison and Hinkley, Bootstrap Methods, 1997, section 3.8). A single seed's finite values are returned.
    """
    held = [np.asarray(column, dtype=np.float64) for column in drawn]
    held = [column[np.isfinite(column)] for column in held if np.isfinite(column).any()]
    if len(held) < 2:
        return held[0] if held else np.zeros(0)
    seeds, lengths = len(held), np.array([len(column) for column in held])
    resamples = int(lengths.max())
    # Pad short columns, so that one array holds all columns; the indices ``places`` never select the padding.
    padded = np.stack([np.resize(column, resamples) for column in held])
    chosen = generator.integers(seeds, size=(resamples, seeds))
    places = (generator.random((resamples, seeds)) * lengths[chosen]).astype(np.int64)
    means: Array = padded[chosen, places].mean(axis=1)
    return means


def interval(value: float, drawn: Array, generator: np.random.Generator) -> Interval:
    """Return a metric's value with a percentile interval and a noise floor, computed from bootstrap values (B,)."""
    finite = drawn[np.isfinite(drawn)]
    if not len(finite):
        return Interval(value, math.nan, math.nan, math.nan)
    return Interval(value, *percentiles(finite), noise_floor(finite, generator))


def noise_floor(drawn: Array, generator: np.random.Generator) -> float:
    """Return a metric's noise floor: the 95 % quantile of ``|a - b|`` for random bootstrap values a and b."""
    first, second = generator.choice(drawn, (2, len(drawn)))
    return float(np.quantile(np.abs(first - second), LEVEL))


# --- statistical tests ---


def mcnemar(first: Array, second: Array) -> Test:
    """Return the exact McNemar test of two policies' paired outcomes (success 1, failure 0) in equal scenarios.

    Only scenarios in which exactly one policy succeeded count: McNemar (1947); two-sided binomial test of Dwass (1955).
    """
    won, lost = int(((first == 0) & (second == 1)).sum()), int(((first == 1) & (second == 0)).sum())
    p = float(stats.binomtest(won, won + lost).pvalue) if won + lost else 1.0
    share = (won - lost) / max(1, len(first))
    return Test("McNemar", p, len(first), won + lost, share, share)


def wilcoxon(first: Array, second: Array) -> Test:
    """Return the Wilcoxon signed-rank test of paired finite errors of two policies. Equal pairs are dropped."""
    difference = np.asarray(second, dtype=np.float64) - first
    untied = int(np.count_nonzero(difference))
    p = float(stats.wilcoxon(difference, zero_method="wilcox").pvalue) if untied else 1.0
    median = float(np.median(difference)) if len(difference) else 0.0
    moved = difference[difference != 0.0]
    ranks = stats.rankdata(np.abs(moved))
    effect = float((ranks * np.sign(moved)).sum() / ranks.sum()) if untied else 0.0
    return Test("Wilcoxon", p, len(difference), untied, median, effect)


def fisher(first: Array, second: Array) -> Test:
    """Return Fisher's exact test of two policies' unpaired outcomes (success 1, failure 0)."""
    table = [[int(column.sum()), int(len(column) - column.sum())] for column in (first, second)]
    share, p = float(second.mean() - first.mean()), float(stats.fisher_exact(table).pvalue)
    return Test("Fisher", p, min(len(first), len(second)), None, share, share)


def mann_whitney(first: Array, second: Array) -> Test:
    """Return the Mann-Whitney test of the unpaired errors of two policies."""
    found = stats.mannwhitneyu(second, first)
    # scipy's Mann-Whitney test returns NaN if all values are equal.
    p = 1.0 if len(np.unique(np.concatenate((first, second)))) == 1 else float(found.pvalue)
    effect = float(2.0 * found.statistic / (len(first) * len(second)) - 1.0)
    median = float(np.median(second) - np.median(first))
    return Test("Mann-Whitney", p, min(len(first), len(second)), None, median, effect)


def holm(tests: Mapping[str, float]) -> dict[str, float]:
    """Return the p values of statistical tests by name, corrected for the number of tests with Holm's method (1979)."""
    ordered = sorted(tests, key=lambda name: tests[name])
    corrected, least = {}, 0.0
    # Holm's method keeps the order: a larger p value never gets a smaller corrected p value.
    for rank, name in enumerate(ordered):
        least = max(least, min(1.0, (len(ordered) - rank) * tests[name]))
        corrected[name] = least
    return {name: corrected[name] for name in tests}


# --- comparisons ---


def over_seeds(evaluations: Sequence[Evaluation]) -> list[OverSeeds]:
    """Return each metric's mean over training seeds. Raise RunDirectoryError if evaluations differ in scenarios."""
    require_same_scenarios(evaluations)
    found = []
    for metric in _shared(evaluations):
        values = tuple(evaluation.value(metric.name) for evaluation in evaluations)
        mean = clustered(values, _draws(metric, evaluations), _generator(evaluations[0], metric, "seeds"))
        iqm = interquartile_mean(np.array([value for value in values if math.isfinite(value)]))
        found.append(OverSeeds(metric.name, metric.unit, metric.better, values, mean, iqm))
    return found


def differences(first: Sequence[Evaluation], second: Sequence[Evaluation]) -> list[Difference]:
    """Return the difference of two methods in each common metric; raise RunDirectoryError if their scenarios differ.

    Each method has one evaluation per seed. With equal start states, episodes are averaged over seeds and paired.
    """
    everyone = [*first, *second]
    require_same_scenarios(everyone)
    found = [_difference(metric, first, second, paired(everyone, metric.test)) for metric in _shared(everyone)]
    corrected = holm({row.metric: row.test.p for row in found if row.test is not None and row.better})
    return [replace(row, p=corrected.get(row.metric)) for row in found]


def paired(evaluations: Sequence[Evaluation], test: str) -> bool:
    """Return whether the episodes of a test had equal start states in all evaluations."""
    return len({evaluation.starts_sha256.get(test) for evaluation in evaluations}) == 1


def require_same_scenarios(evaluations: Sequence[Evaluation]) -> None:
    """Raise RunDirectoryError unless all evaluations have the same scenarios."""
    digests = list(dict.fromkeys(evaluation.scenarios_sha256 for evaluation in evaluations))
    if len(digests) > 1:
        message = "evaluations of different scenarios cannot be compared: " + ", ".join(d[:12] for d in digests)
        raise RunDirectoryError(message, expected="the same protocol, numbers, and seed for all evaluations")


def _shared(evaluations: Sequence[Evaluation]) -> list[Metric]:
    first = evaluations[0]
    shared = [name for name in first.episodes if all(name in one.episodes for one in evaluations)]
    found: list[Metric] = []
    for test in dict.fromkeys(first.episodes["test"].tolist()):
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
    if metric.reduce is worst:  # For a maximum over episodes, neither a statistical test nor a bootstrap is valid.
        bare = Interval(means[0] - means[1], math.nan, math.nan, math.nan)
        return Difference(metric.name, metric.unit, "", means[0], means[1], bare, None, None)
    generator = _generator(first[0], metric, "difference")
    drawn = [clustered_means(_draws(metric, group), generator) for group in (first, second)]
    count = min(map(len, drawn))
    found = interval(means[0] - means[1], drawn[0][:count] - drawn[1][:count], generator)
    test = _test(metric, first, second, are_pairs) if len(metric.columns) == 1 else None
    return Difference(metric.name, metric.unit, metric.better, means[0], means[1], found, test, None)


def _test(metric: Metric, first: Sequence[Evaluation], second: Sequence[Evaluation], are_pairs: bool) -> Test | None:
    (name,) = metric.columns
    if are_pairs:
        counted = np.logical_and.reduce([metric.mask(one.episodes) for one in (*first, *second)])
        one, other = (np.mean([each.episodes[name][counted] for each in group], axis=0) for group in (first, second))
        # If a metric of one method is not finite in an episode, drop the episode from both methods.
        finite = np.isfinite(one) & np.isfinite(other)
        one, other = one[finite], other[finite]
    else:
        one, other = (np.concatenate([metric.values(each.episodes)[0] for each in group]) for group in (first, second))
    if not len(one) or not len(other):
        return None
    if np.isin(np.concatenate((one, other)), (0.0, 1.0)).all():
        return mcnemar(other, one) if are_pairs else fisher(other, one)
    return wilcoxon(other, one) if are_pairs else mann_whitney(other, one)


# --- functions that describe comparisons of methods in words ---

_LIMIT, _WORST = "push/limit_", "push/limit_worst_"


def verdict(found: Sequence[Difference], first: str, second: str, trainings: Sequence[int]) -> str:
    """Return a summary of the differences between two methods in words."""
    tested = [row for row in found if row.better and math.isfinite(row.interval.value)]
    better, worse = ([row.metric for row in tested if row.outcome == word] for word in ("better", "worse"))
    text = f"No difference between {first} and {second} is significant in any of {len(tested)} metrics."
    if better:
        also = _listed(worse) if worse else "none"
        text = f"{first} is better than {second} in {_listed(better, len(tested))}, and worse in {also}."
    elif worse:
        text = f"{first} is worse than {second} in {_listed(worse, len(tested))}, and better in none."
    if min(trainings, default=0) == 1:
        text += " A single training per method compares policies, not methods: another seed can give another result."
    return text


# The largest difference of two engines that agree: of a share, and of any other metric relative to the first engine.
_SHARE, _RATIO = 0.02, 0.1
_JUDGED = {
    *("survival", "success", "error_vx", "error_wz", "drift", "zero_drift", "height_rmse", "pitch_std"),
    *("torque_rms_legs", "torque_rms_wheels", "saturation_legs", "saturation_wheels", "action_acceleration"),
}


def judged_metrics(found: Sequence[Difference]) -> list[Difference]:
    """Return the differences that decide whether two engines agree about the same policies."""
    named = [(row.metric.rpartition("/")[2], row) for row in found if math.isfinite(row.first)]
    return [row for name, row in named if name in _JUDGED or (name.startswith("limit_") and "°" in name)]


def engine_verdict(found: Sequence[Difference], first: str, second: str) -> str:
    """Return a sentence that names the metrics in which two engines disagree about the same policies.

    Drift, chatter, and tracking count too, not only survival. A difference counts if its confidence interval excludes
    0, and if it exceeds 0.02 of a share, or 10 % of the first engine's value.
    """
    judged = judged_metrics(found)
    if not judged:
        return f"No metric can be compared between {first} and {second}."
    said = []
    for row in judged:
        change = row.second - row.first
        limit = _SHARE if not row.unit else _RATIO * abs(row.first)
        is_sure = math.isnan(change) or row.interval.low > 0.0 or row.interval.high < 0.0
        if is_sure and not abs(change) <= limit:
            if math.isnan(row.second):
                text = "no value"
            elif row.unit and row.first != 0.0:
                text = f"{row.second / row.first:.3g} times"
            else:
                text = f"{row.second:.3g}, not {row.first:.3g}"
            said.append(f"{row.metric} ({text})")
    if said:
        return f"{second} differs from {first} in {len(said)} of {len(judged)} metrics: {', '.join(said)}."
    what = "survival, tracking, drift, torque, chatter, and pushes"
    return f"{second} confirms {first} in all {len(judged)} metrics of {what}."


def push_verdict(found: Sequence[Difference], first: str, second: str) -> str:
    """Return a text about which of two methods survives harder pushes; return an empty text if no push was tested.

    A method is better if it survives significantly harder pushes of every kind: kicks, and pulses of each length.
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
    if ratios:
        text += f" {second[0].upper()}{second[1:]} can survive {' and '.join(ratios)}"
        text += f" that the policies of '{first}' can survive."
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
