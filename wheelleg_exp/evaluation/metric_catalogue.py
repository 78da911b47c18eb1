"""Catalogue of metrics: the episodes and columns of each metric, its reduction to one number, and its interval."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import numpy as np
import torch

from wheelleg_exp.evaluation.motion_columns import Columns, Motion
from wheelleg_exp.evaluation.result import Figure
from wheelleg_exp.evaluation.trajectories import rms
from wheelleg_exp.managers.streams import stream_seed
from wheelleg_exp.mdp.root_motion import SIDES

Array = np.ndarray
Reduce = Callable[[Sequence[Array]], Array]
Rows = Callable[[Mapping[str, Array]], Array]
LEVEL = 0.95  # confidence level


# --- functions that reduce the values of all episodes to one number ---


def mean(columns: Sequence[Array]) -> Array:
    """Return the mean of a column over episodes."""
    return np.asarray(columns[0].mean(axis=-1))


def quadratic(columns: Sequence[Array]) -> Array:
    """Return the root mean square of a column over episodes, with equal weight for short and long episodes."""
    return np.asarray(np.sqrt(np.square(columns[0]).mean(axis=-1)))


def worst(columns: Sequence[Array]) -> Array:
    """Return the largest value of a column over all episodes."""
    return np.asarray(columns[0].max(axis=-1))


def median(columns: Sequence[Array]) -> Array:
    """Return the median of a column over episodes."""
    return np.asarray(np.median(columns[0], axis=-1))


def gain(columns: Sequence[Array]) -> Array:
    """Return the least-squares slope of the second column (velocity) over the first column (command)."""
    command, velocity = columns
    centred = command - command.mean(axis=-1, keepdims=True)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray((centred * velocity).sum(axis=-1) / np.square(centred).sum(axis=-1))


def skill(columns: Sequence[Array]) -> Array:
    """Return (score - still) / (1 - still): 0 for standing still, 1 for perfect tracking."""
    score, still = (column.mean(axis=-1) for column in columns)
    return np.asarray((score - still) / (1.0 - still))


def area(columns: Sequence[Array], band: float) -> Array:
    """Return the share of commands for which no robot fell and no mean relative tracking error exceeded ``band``.

    ``columns`` contains each episode's command index and relative errors of speed and yaw rate (inf after a fall).
    """
    cell, *errors = columns
    passed = []
    with np.errstate(invalid="ignore"):
        for value in np.unique(cell):
            mine = cell == value
            count = mine.sum(axis=-1)
            sums = [np.where(mine, error, 0.0).sum(axis=-1) for error in errors]
            good = np.all([total <= band * count for total in sums], axis=0)
            passed.append(np.where(count > 0, good, np.nan))  # A bootstrap resample can lack all episodes of a command.
        return np.asarray(np.nanmean(passed, axis=0))


def _lowest(columns: Sequence[Array], of: Callable[..., Array]) -> Array:
    """Return the lowest mean or median (``of``) of all groups; ``columns`` are groups, then values to multiply."""
    cell, value = columns[0], np.prod(columns[1:], axis=0)
    with warnings.catch_warnings():
        # A bootstrap resample can lack all episodes of a velocity command, and numpy warns about means of empty arrays.
        warnings.simplefilter("ignore", RuntimeWarning)
        return np.asarray(
            np.nanmin([of(np.where(cell == one, value, np.nan), axis=-1) for one in np.unique(cell)], axis=0)
        )


def all_of(columns: Sequence[Array]) -> Array:
    """Return the share of episodes in which all columns are 1."""
    return np.asarray(np.prod(columns, axis=0).mean(axis=-1))


worst_median, worst_mean = partial(_lowest, of=np.nanmedian), partial(_lowest, of=np.nanmean)


def highest(columns: Sequence[Array], share: float) -> Array:
    """Return the number of consecutive levels, from the first, that at least ``share`` of their episodes passed."""
    level, success = columns
    passed, count = np.ones(level.shape[:-1], dtype=bool), np.zeros(level.shape[:-1])
    for one in np.unique(level):
        mine = level == one
        tries = mine.sum(axis=-1)
        passed = passed & (tries > 0) & (np.where(mine, success, 0.0).sum(axis=-1) >= share * tries)
        count = count + passed
    return count


# --- functions that select the episodes that a metric uses ---


def everything(rows: Mapping[str, Array]) -> Array:
    """Return a mask that selects all episodes of a test."""
    return np.ones(len(rows["test"]), dtype=bool)


def moving(rows: Mapping[str, Array]) -> Array:
    """Return the mask of the episodes with a nonzero command."""
    return np.asarray((rows["command_vx"] != 0.0) | (rows["command_wz"] != 0.0))


def still(rows: Mapping[str, Array]) -> Array:
    """Return the mask of the episodes with a zero command."""
    return ~moving(rows)


def surviving(rows: Mapping[str, Array]) -> Array:
    """Return the mask of the episodes with a nonzero command in which the robot never fell."""
    return np.asarray(moving(rows) & (rows["survived"] == 1.0))


def differing(rows: Mapping[str, Array], column: str, value: object) -> Array:
    """Return the mask of the episodes in which ``column`` does not have the given value."""
    return np.asarray(rows[column] != value)


def matching(rows: Mapping[str, Array], **values: object) -> Array:
    """Return the mask of the episodes whose columns, such as ``level``, have the given values."""
    return np.asarray(np.logical_and.reduce([rows[name] == value for name, value in values.items()]))


def in_all(rows: Mapping[str, Array], masks: Sequence[Rows]) -> Array:
    """Return the mask of the episodes that all ``masks`` select."""
    return np.asarray(np.logical_and.reduce([mask(rows) for mask in masks]))


def in_cells(rows: Mapping[str, Array], start: str = "", end: str = "") -> Array:
    """Return the mask of the episodes whose scenario's name has the given prefix and suffix."""
    cells = rows["cell_name"].astype(str)
    return np.char.startswith(cells, start) & np.char.endswith(cells, end)


# --- metrics ---


@dataclass(frozen=True)
class Metric:
    """The declaration of one metric.

    ``name`` is ``test/metric``, and ``rows`` selects episodes of the test. ``reduce`` makes one number of the numeric
    ``columns``, without episodes that have NaN in one of them. ``better`` is ``higher``, ``lower``, or empty.
    """

    name: str
    columns: tuple[str, ...]
    reduce: Reduce
    unit: str = ""
    better: str = "lower"
    rows: Rows = everything

    @property
    def test(self) -> str:
        """The test of the metric's episodes, such as ``walk``."""
        return self.name.partition("/")[0]

    def mask(self, episodes: Mapping[str, Array]) -> Array:
        """Return the mask of the episodes that a metric uses, (E,) bool."""
        mine = np.asarray(episodes["test"] == self.test)
        rows = {name: column[mine] for name, column in episodes.items()}
        counted = self.rows(rows)
        for name in self.columns:
            counted = counted & ~np.isnan(rows[name])
        mine[mine] = counted
        return mine

    def values(self, episodes: Mapping[str, Array]) -> list[Array]:
        """Return the values of the episodes that a metric uses, one array (E,) per column."""
        counted = self.mask(episodes)
        return [episodes[name][counted] for name in self.columns]


def resampled(metric: Metric, episodes: Mapping[str, Array], seed: int, resamples: int) -> Array:
    """Return B bootstrap values of a metric. Equal seeds resample equal episodes."""
    columns = metric.values(episodes)
    count = len(columns[0])
    if not count:
        return np.full(resamples, np.nan)
    generator = np.random.default_rng(stream_seed(seed, f"bootstrap.{metric.name}"))
    drawn = generator.integers(count, size=(resamples, count))
    return metric.reduce([column[drawn] for column in columns])


def figure(metric: Metric, episodes: Mapping[str, Array], seed: int, resamples: int) -> Figure:
    """Return a metric's value over episodes with its 95 % percentile bootstrap interval."""
    columns = metric.values(episodes)
    if not len(columns[0]):
        return Figure(math.nan, math.nan, math.nan, 0, metric.unit, metric.better)
    found = resampled(metric, episodes, seed, resamples)
    found = found[np.isfinite(found)]
    low, high = percentiles(found) if len(found) else (math.nan, math.nan)
    return Figure(float(metric.reduce(columns)), low, high, len(columns[0]), metric.unit, metric.better)


def percentiles(drawn: Array) -> tuple[float, float]:
    """Return the lower and the upper end of the 95 % percentile interval of B bootstrap values, (B,)."""
    tail = 100 * (1 - LEVEL) / 2
    low, high = np.percentile(drawn, (tail, 100 - tail))
    return float(low), float(high)


def metrics_of(test: str, columns: Mapping[str, Array], protocol: Mapping[str, object]) -> list[Metric]:
    """Return the metrics of a test, such as ``walk``, whose columns all exist; ``protocol`` sets tolerance bands."""
    options = protocol.get(test)
    settings = options if isinstance(options, Mapping) else {}
    if test == "walk":
        found = _of_walking(columns, float(settings.get("band", 0.1)))
    elif test in ("terrain", "bump"):
        found = _of_terrain(test, columns, float(settings.get("pass_share", 0.9)))
    else:
        found = _WITHOUT_OPTIONS[test](columns)
    return [metric for metric in found if set(metric.columns) <= set(columns)]


def _survival(test: str, columns: Mapping[str, Array]) -> Iterator[Metric]:
    for name in columns:
        if name.startswith("survived"):
            yield Metric(f"{test}/{name.replace('survived', 'survival')}", (name,), mean, better="higher")
    yield Metric(f"{test}/time_to_failure", ("time_to_failure_s",), mean, "s", "higher")


class Measure(NamedTuple):
    """A metric whose formula returns one value per episode, (N,), or None if the metric does not apply to the robot."""

    column: str
    unit: str
    reduce: Reduce
    better: str
    formula: Callable[[Motion], torch.Tensor | None]


POSTURE = (
    Measure(
        *("height_rmse_m", "m", quadratic, "lower"),
        lambda m: None if m.target is None else m.rms(m.made.height - m.target),
    ),
    Measure("height_mean_m", "m", mean, "", lambda m: m.mean(m.made.height)),
    Measure("pitch_rms_rad", "rad", quadratic, "lower", lambda m: m.rms(m.made.pitch)),
    Measure("pitch_std_rad", "rad", quadratic, "lower", lambda m: m.rms(m.made.pitch.double() - m.mean(m.made.pitch))),
    Measure("roll_rms_rad", "rad", quadratic, "lower", lambda m: m.rms(m.made.roll)),
    Measure("pitch_rate_rms_rad_s", "rad/s", quadratic, "lower", lambda m: m.rms(m.made.ang[..., 1])),
    Measure("lean_rad", "rad", mean, "", lambda m: m.mean(m.made.pitch)),
)
# The array `work` contains gross work, net work, positive work, and the peak of the positive power, in this order.
MOTION = (
    Measure("wheels_down_share", "", mean, "higher", lambda m: m.mean(m.made.down.all(dim=-1)) if m.wheels else None),
    Measure("leg_symmetry_rms_rad", "rad", quadratic, "lower", lambda m: m.leg_asymmetry()),
    Measure(
        *("wheel_sign_changes_per_s", "1/s", mean, "lower"),
        lambda m: m.mean(m.made.sign_changes) / m.made.dt if m.wheels else None,
    ),
    Measure(
        *("wheel_speed_rms_rad_s", "rad/s", quadratic, ""),
        lambda m: m.rms(m.made.joint_vel[..., m.parts.wheels]) if m.wheels else None,
    ),
    Measure("power_gross_w", "W", mean, "lower", lambda m: m.total(m.made.work[..., 0]) / m.duration),
    Measure("power_net_w", "W", mean, "lower", lambda m: m.total(m.made.work[..., 1]) / m.duration),
    Measure("positive_work_j", "J", mean, "lower", lambda m: m.total(m.made.work[..., 2])),
    Measure("peak_power_w", "W", mean, "lower", lambda m: m.largest(m.made.work[..., 3])),
    Measure("cost_of_transport_gross", "", median, "lower", lambda m: m.total(m.made.work[..., 0]) / m.weight_distance),
    Measure("cost_of_transport_net", "", median, "lower", lambda m: m.total(m.made.work[..., 1]) / m.weight_distance),
    Measure("action_rate_per_s", "1/s", mean, "lower", lambda m: m.action_change(1)),
    Measure("action_acceleration_per_s2", "1/s²", mean, "lower", lambda m: m.action_change(2)),
    Measure(
        *("torque_difference_rms_nm", "N·m", quadratic, "lower"),
        lambda m: rms(m.driven_torque.diff(dim=0), m.counted[1:] & m.counted[:-1]),
    ),
    Measure("fast_power_share", "", mean, "lower", lambda m: m.fast_power_share()),
)


def measured(motion: Motion, measures: Sequence[Measure] = (*POSTURE, *MOTION)) -> Columns:
    """Return the columns that the formulas of the metric catalogue compute from the motion of N episodes, (N,) each."""
    return {measure.column: column for measure in measures if (column := measure.formula(motion)) is not None}


_ENDINGS = ("_rad_s", "_per_s2", "_per_s", "_rad", "_m_s", "_nm", "_m", "_w", "_j")


def _shared_metrics(test: str, columns: Mapping[str, Array], rows: Rows) -> Iterator[Metric]:
    for name in columns:
        if name.startswith(("torque_rms_", "torque_share_")):
            unit = "N·m" if name.startswith("torque_rms_") else ""
            yield Metric(f"{test}/{_short(name)}", (name,), quadratic, unit, rows=rows)
        elif name.startswith("saturation_"):
            yield Metric(f"{test}/{name}", (name,), mean, rows=rows)
    for name, unit, reduce, better, _ in (*POSTURE, *MOTION):
        yield Metric(f"{test}/{_short(name)}", (name,), reduce, unit, better, rows)


def _drift(name: str, rows: Rows) -> Iterator[Metric]:
    yield Metric(f"{name}drift", ("drift_max_m",), mean, "m", rows=rows)
    yield Metric(f"{name}drift_worst", ("drift_max_m",), worst, "m", rows=rows)
    yield Metric(f"{name}drift_speed", ("drift_speed_m_s",), mean, "m/s", rows=rows)
    yield Metric(f"{name}yaw_drift", ("yaw_drift_rad",), mean, "rad", rows=rows)
    yield Metric(f"{name}yaw_drift_speed", ("yaw_drift_rad_s",), mean, "rad/s", rows=rows)


def _short(name: str) -> str:
    return next((name.removesuffix(ending) for ending in _ENDINGS if name.endswith(ending)), name)


def _of_standing(columns: Mapping[str, Array]) -> Iterator[Metric]:
    yield from _survival("stand", columns)
    yield from _drift("stand/", everything)
    yield from _shared_metrics("stand", columns, everything)


def _of_walking(columns: Mapping[str, Array], band: float) -> Iterator[Metric]:
    yield from _survival("walk", columns)
    for axis, unit in (("vx", "m/s"), ("wz", "rad/s")):
        rows = partial(differing, column=f"command_{axis}", value=0.0)
        for column in (f"error_{axis}", f"error_{axis}_steady", f"error_{axis}_transient"):
            yield Metric(f"walk/{column}", (column,), quadratic, unit, rows=surviving)
        yield Metric(f"walk/error_{axis}_with_falls", (f"error_{axis}_with_falls",), quadratic, unit, rows=moving)
        yield Metric(f"walk/gain_{axis}", (f"command_{axis}", f"velocity_{axis}"), gain, better="")
        yield Metric(f"walk/sign_{axis}", (f"sign_{axis}",), mean, better="higher", rows=rows)
        yield Metric(f"walk/skill_{axis}", (f"score_{axis}", f"still_{axis}"), skill, better="higher", rows=rows)
    yield Metric("walk/error_wheels", ("error_wheels_m_s",), quadratic, "m/s", "", surviving)
    errors = ("cell", "off_vx", "off_wz")
    yield Metric("walk/commandable_area", errors, partial(area, band=band), better="higher")
    yield Metric("walk/in_band", ("in_band",), mean, better="higher")
    yield from _drift("walk/zero_", still)
    yield from _shared_metrics("walk", columns, moving)


def _of_steps(columns: Mapping[str, Array]) -> Iterator[Metric]:
    yield from _survival("steps", columns)
    for axis, unit in (("vx", "m"), ("wz", "rad")):
        for name in ("settle", "reversal", "stop"):
            yield Metric(f"steps/{name}_{axis}", (f"{name}_s_{axis}",), mean, "s")
            yield Metric(f"steps/{name}_share_{axis}", (f"{name}_did_{axis}",), mean, better="higher")
        yield Metric(f"steps/overshoot_{axis}", (f"overshoot_{axis}",), mean)
        yield Metric(f"steps/stop_distance_{axis}", (f"stop_distance_{axis}",), mean, unit)


def _of_pushing(columns: Mapping[str, Array]) -> Iterator[Metric]:
    better = "higher"
    cells = dict.fromkeys(columns["cell_name"].tolist())
    for kind in dict.fromkeys(cell.rpartition(" over ")[2] for cell in cells):
        mine, pulse = partial(in_cells, end=f" over {kind}"), kind.replace(" ", "")
        yield Metric(f"push/limit_{pulse}", ("limit_m_s",), median, "m/s", better, mine)
        yield Metric(f"push/limit_worst_{pulse}", ("cell", "limit_m_s"), worst_median, "m/s", better, mine)
        yield Metric(f"push/limit_normalised_{pulse}", ("limit_normalised",), median, "", better, mine)
    for cell in cells:
        name = f"push/limit_{cell.replace(' over ', '_').replace(' ', '')}"
        yield Metric(name, ("limit_m_s",), median, "m/s", better, partial(matching, cell_name=cell))
    yield Metric("push/recovered", ("recovered",), mean, better=better)
    yield Metric("push/recovery", ("recovery_s",), mean, "s")
    yield Metric("push/tilt", ("tilt_max_rad",), mean, "rad")


def _of_heights(columns: Mapping[str, Array]) -> Iterator[Metric]:
    yield from _survival("height", columns)
    yield Metric("height/error_vx", ("error_vx",), quadratic, "m/s", rows=surviving)
    yield Metric("height/height_rmse_worst", ("height_rmse_m",), worst, "m", rows=surviving)
    yield from _shared_metrics("height", columns, surviving)
    for cell in dict.fromkeys(columns["cell_name"].tolist()):
        rows = partial(matching, cell_name=cell)
        yield Metric(f"height/height_rmse/{cell.replace(' ', '_')}", ("height_rmse_m",), quadratic, "m", rows=rows)
    for height in dict.fromkeys(cell.split()[0] for cell in columns["cell_name"].tolist()):
        rows, column = partial(in_cells, start=f"{height} "), ("lean_rad",)
        yield Metric(f"height/lean/{height}", column, mean, "rad", "", rows)
        yield Metric(f"height/lean_worst/{height}", column, lambda leans: worst([np.abs(leans[0])]), "rad", rows=rows)


_IN_EACH_WORLD = ("jump/success", "jump/survival", "jump/turn_share", "jump/quiet")


def _of_jumps(columns: Mapping[str, Array]) -> Iterator[Metric]:
    nominal = {metric.name: metric for metric in _of_nominal_jumps(columns)}
    # Older evaluations of jumps have one world.
    for name, rows in _worlds("jump", columns) if "sweep" in columns else [("jump/nominal", everything)]:
        for metric in nominal.values() if name == "jump/nominal" else map(nominal.__getitem__, _IN_EACH_WORLD):
            found = metric.name.replace("jump", name.removesuffix("/nominal"), 1)
            yield replace(metric, name=found, rows=partial(in_all, masks=(metric.rows, rows)))


def _of_nominal_jumps(columns: Mapping[str, Array]) -> Iterator[Metric]:
    # Older evaluations command no turns.
    better, parts = "higher", tuple(name for name in ("drove", "turned", "jumped", "recovered") if name in columns)
    yield from _survival("jump", columns)
    yield Metric("jump/success", parts, all_of, better=better)
    yield Metric("jump/worst_success", ("cell", *parts), worst_mean, better=better)
    for name, unit in (("clearance_m", "m"), ("air_s", "s"), ("span_m", "m")):
        yield Metric(f"jump/{name.rpartition('_')[0]}", (name,), mean, unit, better)
    yield Metric("jump/height_error", ("height_error_m",), mean, "m")
    yield Metric("jump/turn_share", ("turn_share",), mean, better=better)
    yield Metric("jump/quiet", ("quiet",), mean, better=better, rows=still)
    for name, unit in (("quiet_drift_m", "m"), ("quiet_yaw_rad", "rad"), ("quiet_chatter_per_s2", "1/s²")):
        yield Metric(f"jump/{_short(name)}", (name,), mean, unit, rows=still)
    for name in dict.fromkeys(columns["cell_name"].tolist()):
        rows, cell = partial(matching, cell_name=name), name.replace(" ", "_")
        yield Metric(f"jump/success/{cell}", parts, all_of, better=better, rows=rows)
        yield Metric(f"jump/clearance/{cell}", ("clearance_m",), mean, "m", better, rows)
        yield Metric(f"jump/span/{cell}", ("span_m",), mean, "m", better, rows)
        yield Metric(f"jump/speed_error/{cell}", ("off_speed_m_s",), mean, "m/s", rows=rows)
        yield Metric(f"jump/yaw_rate_error/{cell}", ("off_yaw_rate_rad_s",), mean, "rad/s", rows=rows)
        if "wz=" in cell:
            yield Metric(f"jump/turn_share/{cell}", ("turn_share",), mean, better=better, rows=rows)
    yield Metric("jump/recovery", ("recovery_s",), mean, "s")
    yield from _landing("jump")
    yield from _shared_metrics("jump", columns, everything)


def _of_getting_up(columns: Mapping[str, Array]) -> Iterator[Metric]:
    better = "higher"
    yield Metric("get_up/success", ("recovered",), mean, better=better)
    yield Metric("get_up/worst_success", ("side", "recovered"), worst_mean, better=better)
    for number, side in enumerate(SIDES):
        rows = partial(matching, side=float(number))
        yield Metric(f"get_up/success/{side}", ("recovered",), mean, better=better, rows=rows)
        yield Metric(f"get_up/time/{side}", ("recovery_s",), mean, "s", rows=rows)
    yield Metric("get_up/time", ("recovery_s",), mean, "s")
    yield from _landing("get_up")
    yield from _shared_metrics("get_up", columns, everything)


def _landing(test: str) -> Iterator[Metric]:
    yield Metric(f"{test}/tilt", ("tilt_max_rad",), mean, "rad")
    yield Metric(f"{test}/impact", ("impact_m_s",), mean, "m/s")
    yield Metric(f"{test}/impact_worst", ("impact_m_s",), worst, "m/s")
    yield Metric(f"{test}/torque_peak_share", ("torque_peak_share",), worst)


def _of_terrain(test: str, columns: Mapping[str, Array], pass_share: float) -> Iterator[Metric]:
    better = "higher"
    yield from _survival(test, columns)
    yield Metric(f"{test}/success", ("success",), mean, better=better)
    hardest = int(columns["level"].max())
    for name, level in (("middle", hardest // 2), ("hardest", hardest)):
        rows = partial(matching, level=float(level))
        yield Metric(f"{test}/worst_success_{name}", ("cell", "success"), worst_mean, better=better, rows=rows)
    cells = dict.fromkeys(columns["cell_name"].tolist())
    for kind in dict.fromkeys(cell.rpartition("/")[0] for cell in cells):
        rows, passed = partial(in_cells, start=f"{kind}/"), partial(highest, share=pass_share)
        yield Metric(f"{test}/levels_passed/{kind}", ("level", "success"), passed, "", better, rows)
    for cell in cells:
        rows = partial(matching, cell_name=cell)
        yield Metric(f"{test}/success/{cell}", ("success",), mean, better=better, rows=rows)
        yield Metric(f"{test}/distance_ratio/{cell}", ("distance_ratio",), mean, better=better, rows=rows)
    yield Metric(f"{test}/error_vx", ("error_vx",), quadratic, "m/s", rows=surviving)
    yield from _shared_metrics(test, columns, everything)


def _of_strips(columns: Mapping[str, Array]) -> Iterator[Metric]:
    better = "higher"
    yield from _survival("strip", columns)
    yield Metric("strip/success", ("success",), mean, better=better)
    yield Metric("strip/recovered", ("recovered",), mean, better=better)
    for cell in dict.fromkeys(columns["cell_name"].tolist()):
        rows = partial(matching, cell_name=cell)
        for name in ("success", "distance_ratio", "recovered"):
            yield Metric(f"strip/{name}/{cell}", (name,), mean, better=better, rows=rows)
        yield Metric(f"strip/recovery/{cell}", ("recovery_s",), mean, "s", rows=rows)
        for name, column, unit in (("error_vx", "error_vx", "m/s"), ("swing", "swing_rad", "rad")):
            for where in ("before", "on", "behind"):
                yield Metric(f"strip/{name}_{where}/{cell}", (f"{column}_{where}",), quadratic, unit, rows=rows)


_MARGIN_UNITS = {"delay_s": "s", "reading_delay_s": "s", "imu_tilt": "rad", "gyro_bias": "rad/s"}
_MARGIN_UNITS |= {"encoder_offset": "rad", "slope": "rad", "kick": "m/s", "com": "m"}
_MARGIN_UNITS |= {"payload": "kg", "platform": "m/s²"}


def _worlds(test: str, columns: Mapping[str, Array]) -> Iterator[tuple[str, Rows]]:
    """Yield the prefix of the metrics of each world, such as ``robust/mass/1.2``, and the mask of its episodes."""
    for sweep, value in dict.fromkeys(zip(columns["sweep"].tolist(), columns["value"].tolist(), strict=True)):
        name = f"{test}/{sweep}" if sweep in ("nominal", "errors") else f"{test}/{sweep}/{value:g}"
        yield name, partial(matching, sweep=sweep, value=value)


def _of_worlds(columns: Mapping[str, Array]) -> Iterator[Metric]:
    changed = partial(differing, column="sweep", value="nominal")
    yield Metric("robust/survival", ("survived",), mean, "", "higher", changed)
    yield Metric("robust/worst_survival", ("world", "survived"), worst_mean, "", "higher", changed)
    nominal = partial(matching, sweep="nominal")
    for column in (name for name in columns if name.startswith("margin_")):
        name = column.removeprefix("margin_")
        unit = _MARGIN_UNITS.get(name, "")
        yield Metric(f"robust/margin/{name.removesuffix('_s')}", (column,), mean, unit, "higher", nominal)
    for name, rows in _worlds("robust", columns):
        yield Metric(f"{name}/survival", ("survived",), mean, "", "higher", rows)
        yield Metric(f"{name}/error_vx", ("error_vx",), quadratic, "m/s", rows=rows)
        yield Metric(f"{name}/height_rmse", ("height_rmse_m",), quadratic, "m", rows=rows)


_WITHOUT_OPTIONS: dict[str, Callable[[Mapping[str, Array]], Iterator[Metric]]] = {
    "stand": _of_standing,
    "steps": _of_steps,
    "height": _of_heights,
    "push": _of_pushing,
    "jump": _of_jumps,
    "get_up": _of_getting_up,
    "strip": _of_strips,
    "robust": _of_worlds,
}
