"""Test the reductions from episodes to metrics against hand-computed cases."""

import math

import numpy as np
import pytest

from wheelleg_exp.evaluation import metric_catalogue as metrics
from wheelleg_exp.evaluation.metric_catalogue import Metric, area, figure, gain, highest, mean, skill


def of(*columns):
    return [np.array(column, dtype=float) for column in columns]


def test_the_gain_is_the_slope_of_the_line():
    command = np.array([-0.3, -0.1, 0.1, 0.3])
    assert gain(of(command, 0.8 * command + 0.05)) == pytest.approx(0.8)
    assert math.isnan(gain(of([0.2, 0.2], [0.1, 0.3])))


@pytest.mark.parametrize(("score", "expected"), [(0.4, 0.0), (1.0, 1.0), (0.1, -0.5), (0.7, 0.5)])
def test_skill_is_measured_from_standing_still(score, expected):
    assert skill(of([score, score], [0.3, 0.5])) == pytest.approx(expected)


def test_a_cell_is_commandable_when_its_mean_errors_are_and_nobody_fell():
    cell, vx, wz = [0, 0, 1, 1, 2, 2, 3, 3], [0.05, 0.13, 0, 0, 0, math.inf, 0, 0], [0, 0, 0.2, 0.1, 0, 0, 0, 0]
    assert area(of(cell, vx, wz), band=0.1) == pytest.approx(2 / 4)  # The first and the last cell are within the band.
    assert area([np.array([[0.0, 0.0], [0.0, 1.0]]), np.array([[0.0, 0.0], [0.0, 1.0]])], band=0.1).tolist() == [1, 0.5]


def test_levels_are_passed_from_the_first_on():
    level, success = [0, 0, 1, 1, 2, 2, 3, 3], [1, 1, 1, 1, 1, 0, 1, 1]
    assert highest(of(level, success), share=0.9) == 2
    assert highest(of(level, success), share=0.5) == 4
    assert highest(of([0, 0], [0, 0]), share=0.5) == 0


def test_the_worst_cell_counts_and_episodes_have_equal_weights_in_a_quadratic_mean():
    assert metrics.worst_mean(of([0, 0, 1, 1], [1, 1, 0, 1])) == pytest.approx(0.5)
    assert metrics.worst_median(of([0, 0, 0, 1], [1, 2, 9, 3])) == pytest.approx(2.0)
    assert metrics.quadratic(of([3.0, 4.0])) == pytest.approx(math.sqrt(12.5))


def test_a_metric_is_of_the_rows_of_its_test_that_have_a_number():
    episodes = {"test": np.array(["stand", "stand", "walk"]), "height": np.array([1.0, math.nan, 5.0])}
    found = figure(Metric("stand/height", ("height",), mean, "m"), episodes, 1, 50)
    assert (found.value, found.low, found.high, found.episodes) == (1.0, 1.0, 1.0, 1)
    nobody = figure(Metric("push/height", ("height",), mean, "m"), episodes, 1, 50)
    assert (nobody.episodes, nobody.as_dict()["value"]) == (0, None)


def test_the_lean_at_a_height_covers_all_speeds_and_both_directions():
    names = ["h=0.05 vx=0", "h=0.05 vx=0.3", "h=0.1 vx=0", "h=0.1 vx=0.3"]
    columns = {"cell_name": np.array(names), "lean_rad": np.array([0.1, -0.3, 0.2, 0.0])}
    found = {metric.name: metric for metric in metrics.metrics_of("height", columns, {})}
    episodes = {"test": np.full(4, "height"), **columns}
    for height, lean, worst in (("h=0.05", -0.1, 0.3), ("h=0.1", 0.1, 0.2)):
        for name, value in (("lean", lean), ("lean_worst", worst)):
            assert figure(found[f"height/{name}/{height}"], episodes, 1, 50).value == pytest.approx(value)


def test_the_interval_is_that_of_a_mean():
    draws = np.random.default_rng(3).normal(2.0, 1.0, size=400)
    episodes = {"test": np.full(400, "stand"), "x": draws}
    found = figure(Metric("stand/x", ("x",), mean), episodes, 1, 4000)
    error = 1.96 * draws.std() / math.sqrt(400)  # The central limit theorem gives the expected interval.
    assert (found.low, found.high) == pytest.approx((draws.mean() - error, draws.mean() + error), abs=0.01)
