"""Test comparisons of synthetic evaluations: intervals, tests, and verdicts."""

from dataclasses import replace

import numpy as np
import pytest

from wheelleg_exp.errors import RunDirectoryError
from wheelleg_exp.evaluation.method_comparison import differences, engine_verdict, over_seeds, push_verdict, verdict
from wheelleg_exp.evaluation.metric_catalogue import figure, metrics_of
from wheelleg_exp.evaluation.result import Evaluation

N = 64


def made(survived, height, drift=0.0, *, starts="a", scenarios="s") -> Evaluation:
    """Return an evaluation of the ``stand`` test with the given columns."""
    columns = {
        "test": np.full(N, "stand"),
        "survived": np.broadcast_to(np.asarray(survived, dtype=float), N).copy(),
        "height_rmse_m": np.broadcast_to(np.asarray(height, dtype=float), N).copy(),
        "drift_max_m": np.broadcast_to(np.asarray(drift, dtype=float), N).copy(),
        "time_to_failure_s": np.full(N, 60.0),
    }
    metrics = {m.name: figure(m, columns, 1, 4000) for m in metrics_of("stand", columns, {})}
    return Evaluation({"name": "stand", "resamples": 4000}, 1, scenarios, {"stand": starts}, columns, metrics)


def by_name(found):
    return {row.metric: row for row in found}


def noise(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).uniform(0.8, 1.2, N)


def test_the_same_policy_against_itself_differs_in_nothing():
    one = made(1.0, 1e-3 * noise(0))
    found = differences([one], [one])
    assert {row.outcome for row in found} == {""}
    assert by_name(found)["stand/height_rmse"].interval.value == 0.0
    assert "No difference between A and B is significant" in verdict(found, "A", "B", (1, 1))


def test_small_gains_on_the_same_scenarios_are_found_only_in_pairs():
    base = 1e-3 * noise(0)
    first, second = base - 1e-7 * noise(1), made(1.0, base)
    found = by_name(differences([made(1.0, first)], [second]))
    height, survival = found["stand/height_rmse"], found["stand/survival"]
    assert (height.test.test, height.outcome) == ("Wilcoxon", "better")
    assert (survival.test.test, survival.outcome) == ("McNemar", "")
    assert height.interval.high < 0.0
    height = by_name(differences([made(1.0, first, starts="b")], [second]))["stand/height_rmse"]
    assert (height.test.test, height.outcome) == ("Mann-Whitney", "")


def test_a_policy_that_falls_more_is_worse_and_the_metric_is_named():
    fallen = np.arange(N) >= 20
    found = differences([made(fallen, 1e-3)], [made(1.0, 1e-3)])
    row = by_name(found)["stand/survival"]
    assert (row.outcome, row.test.untied) == ("worse", 20)
    assert row.interval.value == pytest.approx(-20 / N)
    assert row.p == pytest.approx(2 / 2**20 * sum(r.test is not None and bool(r.better) for r in found))
    said = verdict(found, "A", "B", (1, 1))
    assert said.startswith("A is worse than B in 1 metric of ")
    assert "(stand/survival), and better in none." in said
    assert "compares policies, not methods" in said


def test_a_worst_value_is_shown_and_not_judged():
    drifts = np.linspace(0.01, 0.02, N)
    first, second = drifts.copy(), drifts + 1e-3
    first[-1] = 0.05  # The first method drifts less in all other episodes.
    rows = by_name(differences([made(1.0, 1e-3, first)], [made(1.0, 1e-3, second)]))
    assert rows["stand/drift"].outcome == "better"
    worst = rows["stand/drift_worst"]
    assert (worst.first, worst.second) == (0.05, pytest.approx(0.021))
    assert (worst.test, worst.p, worst.outcome) == (None, None, "")
    assert np.isnan(worst.interval.low)


def test_ranks_that_point_another_way_than_median_and_mean_are_no_verdict():
    change = np.concatenate((np.full(30, -3e-3), np.full(30, 1e-3), np.full(4, 2e-2)))
    drifts = np.full(N, 0.05)
    row = by_name(differences([made(1.0, 1e-3, drifts + change)], [made(1.0, 1e-3, drifts)]))["stand/drift"]
    assert row.test.p < 0.05
    assert (row.test.difference, row.first - row.second) == (pytest.approx(1e-3), pytest.approx(2e-2 / N))
    assert row.test.effect == pytest.approx((30 * 15.5 + 250 - 30 * 45.5) / 2080)
    sure = replace(row, p=0.01)
    assert sure.outcome == ""
    assert replace(sure, test=replace(row.test, effect=0.3)).outcome == "worse"
    assert replace(sure, test=replace(row.test, effect=0.3, difference=-1e-3)).outcome == ""


def pushed(kick, pulse) -> Evaluation:
    """Return an evaluation of the ``push`` test with pushes from two directions."""
    names = np.array(["0° over 0 s", "90° over 0 s", "0° over 0.15 s", "90° over 0.15 s"])
    cell = np.repeat(np.arange(4), N // 4)
    limit = np.where(cell < 2, kick, pulse)
    columns = {"test": np.full(N, "push"), "cell": cell, "cell_name": names[cell], "limit_m_s": limit}
    metrics = {m.name: figure(m, columns, 1, 400) for m in metrics_of("push", columns, {})}
    return Evaluation({"name": "push", "resamples": 400}, 1, "s", {"push": "a"}, columns, metrics)


@pytest.mark.parametrize(
    ("kick", "pulse", "said"),
    [
        (0.6, 0.7, "A is better in push recovery than B: it survives a kick of 0."),
        (0.2, 0.1, "A is worse in push recovery than B: "),
        (0.6, 0.1, "A is better in some pushes and worse in others than B: "),
    ],
)
def test_push_recovery_has_one_line(kick, pulse, said):
    scatter = 1e-4 * (noise(1) - 1.0)
    found = differences([pushed(kick + scatter, pulse + scatter)], [pushed(0.3 + scatter, 0.3 + scatter)])
    line = push_verdict(found, "A", "B")
    assert line.startswith(said)
    assert f"a push over 0.15 s of {pulse:g}" in line
    assert all(part in line for part in (" m/s (", "95 % interval"))


def test_the_push_that_the_other_survives_is_named_as_a_factor_if_pushes_were_measured():
    scatter = 1e-4 * (noise(1) - 1.0)
    found = differences([pushed(0.2 + scatter, 0.6 + scatter)], [pushed(0.4 + scatter, 0.3 + scatter)])
    said = "survive 2 times the kick and 0.5 times the push over 0.15 s that the policies of 'A' can survive."
    assert said in push_verdict(found, "A", "the reference")
    assert push_verdict(differences([made(1.0, 1e-3)], [made(1.0, 1e-3)]), "A", "B") == ""


def test_trainings_are_listed_with_mean_and_interval_and_their_scatter_widens_the_interval_of_a_difference():
    first = [made(1.0, h) for h in (1e-3, 2e-3, 3e-3)]
    second = [made(1.0, h) for h in (1.1e-3, 2.1e-3, 3.1e-3)]
    row = by_name(differences(first, second))["stand/height_rmse"]
    assert row.first == pytest.approx(2e-3)
    assert row.interval.low < 0.0 < row.interval.high
    row = by_name(over_seeds(first))["stand/height_rmse"]
    assert row.values == pytest.approx((1e-3, 2e-3, 3e-3))
    assert (row.mean.value, row.mean.low, row.mean.high) == pytest.approx((2e-3, 1e-3, 3e-3))
    assert row.interquartile_mean == pytest.approx(2e-3)


def test_other_scenarios_cannot_be_compared_and_a_metric_without_values_has_no_outcome():
    with pytest.raises(RunDirectoryError, match="different scenarios"):
        differences([made(1.0, 1e-3)], [made(1.0, 1e-3, scenarios="t")])
    with pytest.raises(RunDirectoryError, match="different scenarios"):
        over_seeds([made(1.0, 1e-3), made(1.0, 1e-3, scenarios="t")])
    one = made(1.0, np.nan)
    row = by_name(differences([one], [one]))["stand/height_rmse"]
    assert (row.outcome, row.test) == ("", None)


@pytest.mark.parametrize(
    ("second", "said"),
    [
        (made(1.0, 1.05e-3 * noise(0), 0.01), "confirms mujoco in all 3 metrics of survival, tracking, drift"),
        (made(1.0, 1.2e-3 * noise(0), 0.01), "differs from mujoco in 1 of 3 metrics: stand/height_rmse (1.2 times)."),
        (made(np.arange(N) >= 9, 1e-3 * noise(0), 0.01),
         "differs from mujoco in 1 of 3 metrics: stand/survival (0.859, not 1)."),
    ],
)  # fmt: skip
def test_engines_differ_by_more_than_a_tenth_and_more_than_chance(second, said):
    found = differences([made(1.0, 1e-3 * noise(0), 0.01)], [second])
    assert engine_verdict(found, "mujoco", "physx").startswith(f"physx {said}")
