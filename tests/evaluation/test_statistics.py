"""Intervals and tests against hand-computed cases, the normal distribution, and published examples."""

from math import erfc

import numpy as np
import pytest

from wheelleg_exp.evaluation import method_comparison
from wheelleg_exp.evaluation.method_comparison import clustered, holm, interquartile_mean, mcnemar, wilcoxon


def generator() -> np.random.Generator:
    return np.random.default_rng(0)


def test_the_interquartile_mean_leaves_out_a_quarter_at_either_end():
    assert interquartile_mean(np.array([0.0, 1.0, 2.0, 100.0])) == 1.5
    assert interquartile_mean(np.array([9.0, 1.0, 2.0])) == 4.0  # With three values, no value is dropped.
    assert np.isnan(interquartile_mean(np.array([])))


def test_mcnemar_counts_only_the_pairs_that_differ():
    first = np.array([1] * 10 + [0] * 8 + [1] * 1 + [0] * 5)
    second = np.array([1] * 10 + [1] * 8 + [0] * 1 + [0] * 5)
    found = mcnemar(first, second)
    assert found.p == pytest.approx(2 * (1 + 9) / 2**9)
    assert (found.pairs, found.untied, found.difference) == (24, 9, pytest.approx(7 / 24))
    assert mcnemar(np.ones(64), np.ones(64)).p == 1.0


def test_wilcoxon_agrees_with_ranks_by_hand_and_leaves_equal_pairs_out():
    found = wilcoxon(np.zeros(5), np.array([1.0, 2.0, -3.0, 4.0, 5.0]))
    assert found.p == pytest.approx(2 * 5 / 32)
    assert (found.difference, found.effect) == (2.0, pytest.approx((12 - 3) / 15))
    first, second = np.arange(10.0), np.maximum(np.arange(10.0), 2 * np.arange(10.0) - 4)
    assert wilcoxon(first, second).p == wilcoxon(first[5:], second[5:]).p
    assert wilcoxon(first, first).p == 1.0


def test_the_effect_of_ranks_is_how_often_the_second_is_larger_less_how_often_the_first_is():
    found = method_comparison.mann_whitney(np.array([1.0, 3.0, 4.0]), np.array([2.0, 5.0, 6.0]))
    assert found.effect == pytest.approx((7 - 2) / 9)


def test_wilcoxon_agrees_with_its_normal_approximation():
    rng = generator()
    first, shift = rng.normal(size=400), rng.normal(0.1, 1.0, 400)
    second = first + shift
    ranks = np.abs(shift).argsort().argsort() + 1
    total, n = ranks[shift > 0].sum(), len(shift)
    z = (total - n * (n + 1) / 4) / np.sqrt(n * (n + 1) * (2 * n + 1) / 24)
    assert wilcoxon(first, second).p == pytest.approx(erfc(abs(z) / np.sqrt(2)), rel=1e-6)


def test_holm_multiplies_the_smallest_by_the_count_and_preserves_order():
    assert holm({"a": 0.04, "b": 0.01, "c": 0.03}) == pytest.approx({"a": 0.06, "b": 0.03, "c": 0.06})
    assert holm({"a": 0.9, "b": 0.8}) == {"a": 1.0, "b": 1.0}


def test_the_noise_floor_of_a_normal_value_is_that_of_a_difference_of_two():
    floor = method_comparison.noise_floor(generator().normal(3.0, 0.1, 200_000), generator())
    assert floor == pytest.approx(1.96 * 0.1 * np.sqrt(2), rel=0.02)


def test_one_seed_has_the_interval_of_its_episodes_and_seeds_that_differ_widen_it():
    found = clustered([1.0], [generator().normal(1.0, 0.1, 50_000)], generator())
    assert found.value == 1.0
    assert (found.low, found.high) == pytest.approx((1 - 0.196, 1 + 0.196), abs=0.01)
    found = clustered([0.0, 1.0, 2.0], [np.full(5000, value) for value in (0.0, 1.0, 2.0)], generator())
    assert (found.value, found.low, found.high) == (1.0, 0.0, 2.0)


def test_the_interval_over_seeds_adds_both_variances():
    rng = generator()
    centres = rng.normal(0.0, 1.0, 40)
    found = clustered(list(centres), [rng.normal(c, 0.5, 4000) for c in centres], rng)
    expected = np.sqrt((centres.var() + 0.25) / 40)
    assert (found.high - found.low) / (2 * 1.96) == pytest.approx(expected, rel=0.05)


def test_a_metric_that_no_episode_has_is_no_number():
    found = clustered([float("nan")], [np.array([np.nan])], generator())
    assert np.isnan([found.value, found.low, found.high, found.floor]).all()
