"""What each metric is of the episodes: which rows, which columns, how they become one number, and its interval."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
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
            sums = [np.where(mine, error, 0.0).sum(axis=-1) for error in errors]
            good = np.all([total <= band * count for total in sums], axis=0)
            passed.append(np.where(count > 0, good, np.nan))  # a resample may leave a cell out
        found: Array = np.nanmean(passed, axis=0)
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


def cell_is(rows: Mapping[str, Array], name: str) -> Array:
    """Return the episodes of the cell of a name, or of those whose names begin with one that ends in ``/``."""
    cells = rows["cell_name"].astype(str)
    found: Array = np.char.startswith(cells, name) if name.endswith("/") else cells == name
    return found


def cell_ends(rows: Mapping[str, Array], ending: str) -> Array:
    """Return the episodes of the cells whose name ends so."""
    found: Array = np.char.endswith(rows["cell_name"].astype(str), ending)
    return found


def worst_median(columns: Sequence[Array]) -> Array:
    """Return the least of the cells' medians; columns are cell and value."""
    return _least(columns, np.nanmedian)


def worst_mean(columns: Sequence[Array]) -> Array:
    """Return the least of the cells' means; columns are cell and value."""
    return _least(columns, np.nanmean)


def _least(columns: Sequence[Array], of: Callable[..., Array]) -> Array:
    cell, value = columns
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # a resample may leave a cell without episodes
        each = [of(np.where(cell == one, value, np.nan), axis=-1) for one in np.unique(cell)]
        found: Array = np.nanmin(each, axis=0)
    return found


def highest(columns: Sequence[Array], share: float) -> Array:
    """Return how many levels, from the first on, have at least a share of successes; columns are level and success."""
    level, success = columns
    passed = np.ones(level.shape[:-1], dtype=bool)
    count = np.zeros(level.shape[:-1])
    for one in np.unique(level):
        mine = level == one
        tries = mine.sum(axis=-1)
        passed = passed & (tries > 0) & (np.where(mine, success, 0.0).sum(axis=-1) >= share * tries)
        count = count + passed
    return count


def level_is(rows: Mapping[str, Array], level: float) -> Array:
    """Return the episodes of a level."""
    found: Array = rows["level"] == level
    return found


def world_is(rows: Mapping[str, Array], sweep: str, value: float) -> Array:
    """Return the episodes of one changed world."""
    found: Array = (rows["sweep"] == sweep) & (rows["value"] == value)
    return found


def changed(rows: Mapping[str, Array]) -> Array:
    """Return the episodes of all changed worlds."""
    found: Array = rows["sweep"] != "nominal"
    return found


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
