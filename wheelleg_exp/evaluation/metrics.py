"""What each metric is of the episodes: which rows, which columns, how they become one number, and its interval."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from wheelleg_exp.evaluation.result import Figure
from wheelleg_exp.evaluation.statistics import percentiles
from wheelleg_exp.managers.streams import stream_seed

Array = np.ndarray[Any, Any]
Reduce = Callable[[Sequence[Array]], Array]  # columns (..., E) -> (...)
Rows = Callable[[Mapping[str, Array]], Array]


def mean(columns: Sequence[Array]) -> Array:
    """Return the mean over episodes."""
    found: Array = columns[0].mean(axis=-1)
    return found


def quadratic(columns: Sequence[Array]) -> Array:
    """Return the root of the mean square over episodes: of RMS values, that of all their steps, episodes alike."""
    found: Array = np.sqrt(np.square(columns[0]).mean(axis=-1))
    return found


def worst(columns: Sequence[Array]) -> Array:
    """Return the largest."""
    found: Array = columns[0].max(axis=-1)
    return found


def median(columns: Sequence[Array]) -> Array:
    """Return the median."""
    found: Array = np.median(columns[0], axis=-1)
    return found


def gain(columns: Sequence[Array]) -> Array:
    """Return the least-squares slope of the second column (velocity) on the first (command)."""
    command, velocity = columns
    centred = command - command.mean(axis=-1, keepdims=True)
    with np.errstate(invalid="ignore", divide="ignore"):
        found: Array = (centred * velocity).sum(axis=-1) / np.square(centred).sum(axis=-1)
    return found


def skill(columns: Sequence[Array]) -> Array:
    """Return (score - still) / (1 - still): 0 stands still, 1 tracks perfectly, below 0 is worse than standing."""
    score, still = (column.mean(axis=-1) for column in columns)
    found: Array = (score - still) / (1.0 - still)
    return found


def area(columns: Sequence[Array], band: float) -> Array:
    """Return the share of cells in which nobody fell and the mean errors are within the band.

    Args:
        columns: cell; errors of both axes as shares of the command, infinite where an episode fell.
        band: the largest share.
    """
    cell, *errors = columns
    passed = []
    with np.errstate(invalid="ignore"):
        for value in np.unique(cell):
            mine = cell == value
            count = mine.sum(axis=-1)
            good = count > 0
            for error in errors:
                good = good & (np.where(mine, error, 0.0).sum(axis=-1) <= band * count)
            passed.append(good)
    found: Array = np.mean(passed, axis=0)
    return found


def everything(rows: Mapping[str, Array]) -> Array:
    """Return every episode of the test."""
    return np.ones(len(rows["test"]), dtype=bool)


def moving(rows: Mapping[str, Array]) -> Array:
    """Return the episodes that are told to move."""
    return (rows["command_vx"] != 0.0) | (rows["command_wz"] != 0.0)


def still(rows: Mapping[str, Array]) -> Array:
    """Return the episodes that are told to stand."""
    return ~moving(rows)


def surviving(rows: Mapping[str, Array]) -> Array:
    """Return the episodes that are told to move and lived to the end."""
    return moving(rows) & (rows["survived"] == 1.0)


def commanded(rows: Mapping[str, Array], axis: str) -> Array:
    """Return the episodes that are told to move along one axis."""
    return rows[f"command_{axis}"] != 0.0


@dataclass(frozen=True)
class Metric:
    """What one metric is.

    Attributes:
        name: ``group/metric``.
        test: of the episodes that it is of.
        columns: of the episodes, numbers; rows in which one is NaN are left out.
        reduce: makes one number of the columns.
        unit: of the number.
        better: ``higher``, ``lower``, or empty.
        rows: which of the test's episodes.
    """

    name: str
    test: str
    columns: tuple[str, ...]
    reduce: Reduce
    unit: str = ""
    better: str = "lower"
    rows: Rows = everything

    def kept(self, episodes: Mapping[str, Array]) -> Array:
        """Return which of all the episodes the metric is of, (E,) bool."""
        mine = np.asarray(episodes["test"] == self.test)
        rows = {name: column[mine] for name, column in episodes.items()}
        kept = self.rows(rows)
        for name in self.columns:
            kept = kept & ~np.isnan(rows[name])
        mine[mine] = kept
        return mine

    def values(self, episodes: Mapping[str, Array]) -> list[Array]:
        """Return the columns over the episodes that the metric is of, (E,) each."""
        kept = self.kept(episodes)
        return [episodes[name][kept] for name in self.columns]


def resampled(metric: Metric, episodes: Mapping[str, Array], seed: int, resamples: int) -> Array:
    """Return a metric of its episodes drawn with replacement again and again, (B,); of equal seeds the same draws.

    Args:
        metric: the metric.
        episodes: the columns.
        seed: of the resampling, whose stream has the metric's name.
        resamples: how often is drawn, B.
    """
    columns = metric.values(episodes)
    count = len(columns[0])
    if not count:
        return np.full(resamples, np.nan)
    generator = np.random.default_rng(stream_seed(seed, f"bootstrap.{metric.name}"))
    drawn = generator.integers(count, size=(resamples, count))
    return metric.reduce([column[drawn] for column in columns])


def figure(metric: Metric, episodes: Mapping[str, Array], seed: int, resamples: int) -> Figure:
    """Return a metric of the episodes, with its 95 % percentile bootstrap interval over episodes.

    Args:
        metric: the metric.
        episodes: the columns.
        seed: of the resampling.
        resamples: how often is drawn.
    """
    columns = metric.values(episodes)
    if not len(columns[0]):
        return Figure(float("nan"), float("nan"), float("nan"), 0, metric.unit, metric.better)
    found = resampled(metric, episodes, seed, resamples)
    found = found[np.isfinite(found)]
    low, high = percentiles(found) if len(found) else (float("nan"), float("nan"))
    return Figure(float(metric.reduce(columns)), low, high, len(columns[0]), metric.unit, metric.better)


def metrics_of(test: str, columns: Sequence[str], band: float = 0.1) -> list[Metric]:
    """Return the metrics of a test whose episodes have these columns.

    Args:
        test: the test.
        columns: names of the episodes' columns.
        band: of the commandable area.
    """
    if test == "walk":
        found = _of_walking(columns, band)
    else:
        found = _of_standing(columns) if test == "stand" else _of_steps(columns)
    return [metric for metric in found if set(metric.columns) <= set(columns)]


def _survival(test: str, columns: Sequence[str]) -> Iterator[Metric]:
    for name in columns:
        if name.startswith("survived"):
            yield Metric(f"{test}/{name.replace('survived', 'survival')}", test, (name,), mean, better="higher")
    yield Metric(f"{test}/time_to_failure", test, ("time_to_failure_s",), mean, "s", "higher")


# Column, unit, how it is reduced: of every test, over the episodes that it is asked for.
_ALIKE: tuple[tuple[str, str, Reduce, str], ...] = (
    ("height_rmse_m", "m", quadratic, "lower"),
    ("height_mean_m", "m", mean, ""),
    ("pitch_rms_rad", "rad", quadratic, "lower"),
    ("roll_rms_rad", "rad", quadratic, "lower"),
    ("pitch_rate_rms_rad_s", "rad/s", quadratic, "lower"),
    ("lean_rad", "rad", mean, ""),
    ("wheels_down_share", "", mean, "higher"),
    ("leg_symmetry_rms_rad", "rad", quadratic, "lower"),
    ("wheel_sign_changes_per_s", "1/s", mean, "lower"),
    ("wheel_speed_rms_rad_s", "rad/s", quadratic, ""),
    ("power_gross_w", "W", mean, "lower"),
    ("power_net_w", "W", mean, "lower"),
    ("positive_work_j", "J", mean, "lower"),
    ("peak_power_w", "W", mean, "lower"),
    ("cost_of_transport_gross", "", median, "lower"),
    ("cost_of_transport_net", "", median, "lower"),
    ("action_rate_per_s", "1/s", mean, "lower"),
    ("action_acceleration_per_s2", "1/s²", mean, "lower"),
    ("torque_difference_rms_nm", "N·m", quadratic, "lower"),
    ("fast_power_share", "", mean, "lower"),
)
_ENDINGS = ("_rad_s", "_per_s2", "_per_s", "_rad", "_m_s", "_nm", "_m", "_w", "_j")


def _alike(test: str, columns: Sequence[str], rows: Rows) -> Iterator[Metric]:
    for name in columns:
        if name.startswith(("torque_rms_", "torque_share_")):
            unit = "N·m" if name.startswith("torque_rms_") else ""
            yield Metric(f"{test}/{_short(name)}", test, (name,), quadratic, unit, rows=rows)
        elif name.startswith("saturation_"):
            yield Metric(f"{test}/{name}", test, (name,), mean, rows=rows)
    for name, unit, reduce, better in _ALIKE:
        yield Metric(f"{test}/{_short(name)}", test, (name,), reduce, unit, better, rows)


def _drift(name: str, test: str, rows: Rows) -> Iterator[Metric]:
    yield Metric(f"{name}drift", test, ("drift_max_m",), mean, "m", rows=rows)
    yield Metric(f"{name}drift_worst", test, ("drift_max_m",), worst, "m", rows=rows)
    yield Metric(f"{name}drift_speed", test, ("drift_speed_m_s",), mean, "m/s", rows=rows)
    yield Metric(f"{name}yaw_drift", test, ("yaw_drift_rad",), mean, "rad", rows=rows)
    yield Metric(f"{name}yaw_drift_speed", test, ("yaw_drift_rad_s",), mean, "rad/s", rows=rows)


def _short(name: str) -> str:
    return next((name.removesuffix(ending) for ending in _ENDINGS if name.endswith(ending)), name)


def _of_standing(columns: Sequence[str]) -> Iterator[Metric]:
    yield from _survival("stand", columns)
    yield from _drift("stand/", "stand", everything)
    yield from _alike("stand", columns, everything)


def _of_walking(columns: Sequence[str], band: float) -> Iterator[Metric]:
    test = "walk"
    yield from _survival(test, columns)
    for axis, unit in (("vx", "m/s"), ("wz", "rad/s")):
        rows = partial(commanded, axis=axis)
        yield Metric(f"walk/error_{axis}", test, (f"error_{axis}",), quadratic, unit, rows=surviving)
        yield Metric(f"walk/error_{axis}_with_falls", test, (f"error_{axis}_with_falls",), quadratic, unit, rows=moving)
        yield Metric(f"walk/gain_{axis}", test, (f"command_{axis}", f"velocity_{axis}"), gain, better="")
        yield Metric(f"walk/sign_{axis}", test, (f"sign_{axis}",), mean, better="higher", rows=rows)
        yield Metric(f"walk/skill_{axis}", test, (f"score_{axis}", f"still_{axis}"), skill, better="higher", rows=rows)
    errors = ("cell", "off_vx", "off_wz")
    yield Metric("walk/commandable_area", test, errors, partial(area, band=band), better="higher")
    yield Metric("walk/in_band", test, ("in_band",), mean, better="higher")
    yield from _drift("walk/zero_", test, still)
    yield from _alike(test, columns, moving)


def _of_steps(columns: Sequence[str]) -> Iterator[Metric]:
    test = "steps"
    yield from _survival(test, columns)
    for axis, unit in (("vx", "m"), ("wz", "rad")):
        for name in ("settle", "reversal", "stop"):
            yield Metric(f"steps/{name}_{axis}", test, (f"{name}_s_{axis}",), mean, "s")
            yield Metric(f"steps/{name}_share_{axis}", test, (f"{name}_did_{axis}",), mean, better="higher")
        yield Metric(f"steps/overshoot_{axis}", test, (f"overshoot_{axis}",), mean)
        yield Metric(f"steps/stop_distance_{axis}", test, (f"stop_distance_{axis}",), mean, unit)
