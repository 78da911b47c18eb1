import math

import pytest

from wheelleg_exp.run.iteration_log import Line
from wheelleg_exp.verify.tolerance import END, START, judge

LONG = 100


def line(iteration, scalars):
    return Line(iteration, {}, scalars, None, {}, 0)


def run(reward=lambda i: float(i), value=lambda i: 1.0, length=lambda i: 50.0, iterations=LONG):
    return [
        line(i, {"Train/mean_reward": reward(i), "Train/mean_episode_length": length(i), "Loss/value": value(i)})
        for i in range(iterations)
    ]


def reward_end(found):
    (end,) = [excess for excess in found.end if excess.name == "Train/mean_reward"]
    return end


def test_only_the_worst_scalar_of_the_first_different_iteration_is_compared_with_rounding():
    off = run(value=lambda i: 1.0 if i < 7 else 1.0 + 1e-5 if i == 7 else 5.0, length=lambda i: 50.0 + 1e-5 * (i == 7))
    found = judge(run(), off, None, whole=True)
    (start,) = found.start
    assert (start.iteration, start.name, start.off) == (7, "Loss/value", pytest.approx(1e-5, rel=1e-3))
    assert found.within


@pytest.mark.parametrize(("by", "within"), [(START * 0.99, True), (START * 1.02, False)])
def test_the_bound_at_the_start_is_relative_to_the_larger_magnitude(by, within):
    assert judge(run(value=lambda i: 1e6), run(value=lambda i: 1e6 * (1 + by)), None, whole=True).within == within


@pytest.mark.parametrize("value", ["nan", None])
def test_values_that_are_missing_or_nan_in_one_run_are_beyond_every_bound(value):
    found = judge(run(), run(value=lambda i: value), None, whole=True)
    assert (found.start[0].off, found.within) == (math.inf, False)
    other = run(reward=lambda i: value if i >= 90 else float(i), value=lambda i: 1.0 + 1e-6)
    found = judge(run(), other, None, whole=True)
    assert not found.within
    assert any("too few values to compare" in line for line in found.lines())


@pytest.mark.parametrize(("distance", "within"), [(START / 2, True), (START * 2, False), (math.nan, False)])
def test_a_known_distance_of_the_parameters_counts(distance, within):
    assert judge(run(), run(value=lambda i: 1.0 + 1e-6), (0, distance), whole=True).within == within


@pytest.mark.parametrize(("off", "within"), [(0.9, True), (1.1, False)])
def test_the_ends_may_be_apart_by_a_tenth_of_the_range_they_went_through(off, within):
    spread = LONG - 1  # The rewards jump from 0 to 99, and end on a plateau without noise.
    a = run(reward=lambda i: 0.0 if i < 50 else float(spread))
    found = judge(a, run(reward=lambda i: 0.0 if i < 50 else spread * (1 - END * off)), None, whole=True)
    (end,) = [excess for excess in found.end if excess.name == "Train/mean_reward"]
    assert (end.allowed, end.off) == (pytest.approx(END * spread), pytest.approx(END * off * spread))
    assert end.within == within


def test_fluctuation_that_is_larger_than_that_widens_the_bound_to_twice_itself():
    a = run(reward=lambda i: float(i % 2))
    b = run(reward=lambda i: float(i % 2) + 0.5)
    end = reward_end(judge(a, b, None, whole=True))
    variance = 10 * 0.25 / 9  # This is the variance of five zeros and five ones.
    assert end.allowed == pytest.approx(2 * math.sqrt(2 * variance))
    assert end.within


@pytest.mark.parametrize(("iterations", "whole"), [(49, True), (LONG, False)])
def test_short_runs_and_unfinished_runs_have_no_end_to_compare(iterations, whole):
    a, b = run(iterations=iterations), run(iterations=iterations, reward=lambda i: i + 1e-4)
    found = judge(a, b, None, whole=whole)
    assert found.end == []
    assert "ends were not compared" in found.lines()[-1]


def late(i):
    """Return a figure that is missing before the end of the first episode."""
    return None if i == 0 else float(i)


def without(lines, *names):
    return [line(x.iteration, {k: v for k, v in x.scalars.items() if k not in names}) for x in lines]


def test_iterations_without_the_figure_do_not_spare_the_run_the_comparison_of_its_end():
    a, b = run(reward=late), run(reward=lambda i: late(i) and late(i) * 0.05, value=lambda i: 1.0 + 1e-6)
    found = judge(a, b, None, whole=True)
    end = reward_end(found)
    assert end.allowed == pytest.approx(END * (99 - 0.05))
    assert end.off == pytest.approx(94.5 * 0.95)  # The value is the mean of 90 to 99, reduced by 5 %.
    assert not found.within


def test_what_neither_run_has_is_noted_and_the_other_figure_decides():
    a, b = (without(lines, "Train/mean_reward") for lines in (run(), run(value=lambda i: 1.0 + 1e-6)))
    found = judge(a, b, None, whole=True)
    assert found.within
    assert [excess.name for excess in found.end] == ["Train/mean_episode_length"]
    assert found.lines()[-1] == "not compared at the end, because neither run has it: Train/mean_reward"


@pytest.mark.parametrize(("iterations", "within"), [(49, True), (50, False)])
def test_a_long_run_of_which_no_figure_can_be_compared_is_not_shown_to_be_within(iterations, within):
    a, b = (
        without(lines, "Train/mean_reward", "Train/mean_episode_length")
        for lines in (run(iterations=iterations), run(iterations=iterations, value=lambda i: 1.0 + 1e-6))
    )
    found = judge(a, b, None, whole=True)
    assert (found.within, found.unknown) == (within, not within)
    assert "not compared" in found.note
