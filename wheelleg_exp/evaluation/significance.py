"""Statistics of evaluations: intervals over training seeds, and tests of paired episodes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import stats

Array = np.ndarray[Any, Any]

LEVEL = 0.95  # confidence level of every interval
ALPHA = 0.05  # a difference with a smaller p value is significant


@dataclass(frozen=True)
class Interval:
    """A value and its confidence interval.

    Attributes:
        value: the statistic.
        low: lower end of the 95 % interval.
        high: upper end.
        floor: the noise floor: the difference of two such values that chance exceeds once in 20 times.
    """

    value: float
    low: float
    high: float
    floor: float


@dataclass(frozen=True)
class Test:
    """A statistical test of two columns of episodes.

    Attributes:
        test: ``McNemar`` or ``Wilcoxon`` for pairs; ``Fisher`` or ``Mann-Whitney`` without pairs.
        p: two-sided probability of a difference at least this large by chance.
        pairs: number of pairs; without pairs, the number of episodes of the smaller group.
        untied: number of pairs that differ; None without pairs.
        difference: second minus first: of shares, the median of the pairs' differences, or of medians without pairs.
        effect: effect size of the test from -1 to 1, positive if the second is larger: the rank-biserial correlation
            (Kerby, 2014), or the difference of shares. Its sign can differ from the median's, if many episodes differ
            slightly one way and some strongly the other way.
    """

    test: str
    p: float
    pairs: int
    untied: int | None
    difference: float
    effect: float


def interquartile_mean(values: Array) -> float:
    """Return the mean of the middle half of the values; NaN without values.

    A quarter of the values, rounded down, is dropped at either end. With fewer than four values, none is dropped.
    Agarwal et al., Deep Reinforcement Learning at the Edge of the Statistical Precipice (2021).
    """
    return float(stats.trim_mean(values, 0.25)) if len(values) else float("nan")


def clustered(values: Sequence[float], drawn: Sequence[Array], generator: np.random.Generator) -> Interval:
    """Return the mean over training seeds with its percentile bootstrap interval, clustered by seed.

    With one seed, the interval is over its episodes. It then says nothing about another training.

    ``values`` is the metric of each seed, (S,). ``drawn`` is the bootstrap values of the metric over the episodes
    of each seed, (B,) each.
    """
    finite = [value for value in values if np.isfinite(value)]
    value = float(np.mean(finite)) if finite else float("nan")
    return interval(value, clustered_means(drawn, generator), generator)


def clustered_means(drawn: Sequence[Array], generator: np.random.Generator) -> Array:
    """Return means over training seeds drawn with replacement, each with its own draw of episodes, (B,).

    The episodes of one seed are not independent draws of the trained method. So whole seeds are drawn, and then the
    episodes of each: Davison and Hinkley, Bootstrap Methods (1997), 3.8. The draws of a single seed stay in order.

    ``drawn`` is the bootstrap values of the metric over the episodes of each seed, (B,) each.
    """
    held = [np.asarray(column, dtype=np.float64) for column in drawn]
    held = [column[np.isfinite(column)] for column in held if np.isfinite(column).any()]
    if len(held) < 2:
        return held[0] if held else np.zeros(0)
    seeds, lengths = len(held), np.array([len(column) for column in held])
    resamples = int(lengths.max())
    # np.resize repeats shorter columns, but `places` only indexes their original part.
    padded = np.stack([np.resize(column, resamples) for column in held])
    chosen = generator.integers(seeds, size=(resamples, seeds))
    places = (generator.random((resamples, seeds)) * lengths[chosen]).astype(np.int64)
    means: Array = padded[chosen, places].mean(axis=1)
    return means


def interval(value: float, drawn: Array, generator: np.random.Generator) -> Interval:
    """Return a value with the percentile interval and the noise floor of its bootstrap values, (B,)."""
    finite = drawn[np.isfinite(drawn)]
    if not len(finite):
        return Interval(value, float("nan"), float("nan"), float("nan"))
    return Interval(value, *percentiles(finite), noise_floor(finite, generator))


def percentiles(drawn: Array) -> tuple[float, float]:
    """Return the ends of the 95 % percentile interval of bootstrap values, (B,)."""
    tail = 100 * (1 - LEVEL) / 2
    low, high = np.percentile(drawn, (tail, 100 - tail))
    return float(low), float(high)


def noise_floor(drawn: Array, generator: np.random.Generator) -> float:
    """Return the 95 % quantile of the difference between two independent draws of bootstrap values, (B,).

    If one method is evaluated twice with as many seeds and episodes, the two values differ by more once in 20 times.
    For normal values it is 1.96 √2 standard errors.
    """
    first, second = generator.choice(drawn, (2, len(drawn)))
    return float(np.quantile(np.abs(first - second), LEVEL))


def mcnemar(first: Array, second: Array) -> Test:
    """Return the exact McNemar test of paired outcomes of two policies on the same scenarios.

    Only scenarios in which exactly one policy succeeded count. By chance both cases are equally likely: the two-sided
    binomial test of Dwass (1955), McNemar (1947).

    ``second`` are the outcomes of the same scenarios, (E,).
    """
    won, lost = int(((first == 0) & (second == 1)).sum()), int(((first == 1) & (second == 0)).sum())
    p = float(stats.binomtest(won, won + lost).pvalue) if won + lost else 1.0
    share = (won - lost) / max(1, len(first))
    return Test("McNemar", p, len(first), won + lost, share, share)


def wilcoxon(first: Array, second: Array) -> Test:
    """Return the Wilcoxon signed-rank test of paired errors. Equal pairs are dropped.

    ``first`` are the errors, (E,), finite. ``second`` are the errors of the same scenarios, (E,), finite.
    """
    difference = np.asarray(second, dtype=np.float64) - first
    untied = int(np.count_nonzero(difference))
    p = float(stats.wilcoxon(difference, zero_method="wilcox").pvalue) if untied else 1.0
    median = float(np.median(difference)) if len(difference) else 0.0
    moved = difference[difference != 0.0]
    ranks = stats.rankdata(np.abs(moved))
    effect = float((ranks * np.sign(moved)).sum() / ranks.sum()) if untied else 0.0
    return Test("Wilcoxon", p, len(difference), untied, median, effect)


def fisher(first: Array, second: Array) -> Test:
    """Return Fisher's exact test of outcomes, 1 or 0, of two policies on different scenarios."""
    table = [[int(column.sum()), int(len(column) - column.sum())] for column in (first, second)]
    p = float(stats.fisher_exact(table).pvalue)
    share = float(second.mean() - first.mean())
    return Test("Fisher", p, min(len(first), len(second)), None, share, share)


def mann_whitney(first: Array, second: Array) -> Test:
    """Return the Mann-Whitney test of errors of two policies on different scenarios."""
    equal = len(np.unique(np.concatenate((first, second)))) == 1
    found = stats.mannwhitneyu(second, first)
    effect = float(2.0 * found.statistic / (len(first) * len(second)) - 1.0)
    median = float(np.median(second) - np.median(first))
    return Test(
        "Mann-Whitney", 1.0 if equal else float(found.pvalue), min(len(first), len(second)), None, median, effect
    )


def holm(tests: Mapping[str, float]) -> dict[str, float]:
    """Return the p values by name, corrected for the number of tests (Holm, 1979)."""
    ordered = sorted(tests, key=lambda name: tests[name])
    corrected, least = {}, 0.0
    # Corrected p values never decrease along the sorted tests.
    for rank, name in enumerate(ordered):
        least = max(least, min(1.0, (len(ordered) - rank) * tests[name]))
        corrected[name] = least
    return {name: corrected[name] for name in tests}
