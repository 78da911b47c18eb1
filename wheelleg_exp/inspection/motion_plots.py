"""Panels of motion: the recorded motion of the robot over time, with its commands."""

from __future__ import annotations

import textwrap
from functools import partial

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from wheelleg_exp.inspection.plot_data import Series, Source, broken, mean_of
from wheelleg_exp.inspection.plot_style import BLUE, FAILED, GREEN, MUTED, ORANGE, VERMILLION, Panel, shades
from wheelleg_exp.inspection.training_curves import shares
from wheelleg_exp.recording.layout import unit

_VELOCITIES = (("v_x", "Forward velocity", "m/s"), ("v_y", "Sideways velocity", "m/s"), ("w_z", "Yaw rate", "rad/s"))
_ANGLES = ("pitch", "roll")
TITLES = {
    "base/height": "Height of the base (m)",
    "base/pitch": "Pitch of the base (rad)",
    "base/v_x": "Forward velocity (m/s)",
    "base/w_z": "Yaw rate (rad/s)",
    "rewards/total": "Reward (1/s)",
}
_SHORT = 1.75


def tracking(source: Source) -> list[Panel]:
    """Return plot panels of the base's velocities with their commands, and of the base's height, roll, and pitch."""
    commands = [name for name in source.below("commands") if source.maybe("commands", name, "v_x") is not None]
    wanted = {name: source.maybe("commands", commands[0], name) if commands else None for name, _, _ in _VELOCITIES}
    panels = [_over_time(source, ("base", n), title, unit, wanted=wanted[n]) for n, title, unit in _VELOCITIES]
    height = _over_time(source, ("base", "height"), "Height of the base", "m", target=source.target_height())
    pitch, roll = (_over_time(source, ("base", n), f"{n.title()} of the base", "rad", target=0.0) for n in _ANGLES)
    return [panel for panel in (height, *panels, pitch, roll) if panel is not None]


def joints(source: Source) -> list[Panel]:
    """Return panels of each joint's motion and effort; for a training, of the last recorded interval only."""
    panels: list[Panel] = []
    for joint in source.below("joints"):
        kind, unit = ("velocity", "rad/s") if is_driven(source, joint) else ("position", "rad")
        found = [source.maybe("joints", joint, part) for part in (kind, f"{kind}_target", "effort")]
        if all(series is not None for series in found):
            actual, target, effort = (source.path("joints", joint, part) for part in (kind, f"{kind}_target", "effort"))
            draw = partial(_pair, source, actual, target)
            panels.append(Panel(f"{joint}: {kind} and target ({unit})", draw, height=_SHORT))
            draw = partial(_effort, source, effort, source.drive(joint, "effort_limit"))
            panels.append(Panel(f"{joint}: effort (N·m)", draw, height=_SHORT))
    return panels


def contact_forces(source: Source) -> list[Panel]:
    """Return panels of the force on each touched body; for a training, of the last recorded interval only."""
    panels = []
    for sensor in source.below("contacts"):
        series = source.maybe("contacts", sensor)
        if series is None:
            continue
        shown, peak = _last(source, series), source.maybe("contacts", sensor, "peak")
        # Plot the peak contact forces only if they were recorded at the same control steps as the other contact forces.
        if peak is None or peak.values.shape != series.values.shape or not np.array_equal(peak.step, series.step):
            peak = None
        else:
            peak = _last(source, peak)
        most = shown.values if peak is None else np.fmax(shown.values, peak.values)
        touched = [i for i in range(len(series.names)) if np.nanmax(most[:, i], initial=0.0) > 0]
        top = float(np.nanmax(most, initial=0.0))
        draws = {series.names[i]: partial(_force, source, shown, peak, i, top) for i in touched}
        panels += [Panel(f"{name}: contact force (N)", draw, height=_SHORT) for name, draw in draws.items()]
        if len(touched) < len(series.names):
            never = ", ".join(name for i, name in enumerate(series.names) if i not in touched)
            height, draw = 0.45 + 0.15 * (len(never) // 110), partial(_write, never)
            panels.append(Panel(f"Never touched ({sensor})", draw, height=height, wide=True))
    return panels


def terminations(source: Source) -> list[Panel]:
    """Return a plot panel with the times at which each termination term ended an episode."""
    fired = source.fired()
    if not fired:
        return []

    def draw(axes: Axes) -> None:
        labels = []
        for row, (name, series) in enumerate(fired.items()):
            hits = series.first > 0
            x = series.iteration if source.is_training and series.iteration is not None else series.time
            axes.plot(x[hits], np.full(int(hits.sum()), row), "|", color=FAILED, markersize=14, markeredgewidth=1.6)
            labels.append(f"{name}  {int(hits.sum())}×")
            axes.set_xlim(*_padded(float(x[0]), float(x[-1])))
        axes.set_yticks(range(len(labels)), labels)
        axes.set_ylim(len(labels) - 0.4, -0.6)
        axes.grid(axis="x", visible=False)
        axes.set_xlabel("iteration" if source.is_training else "simulated time (s)")

    title = "When terminations fired, and how often" + (f", {source.whose}" if source.whose else "")
    return [Panel(title, draw, height=0.8 + 0.26 * len(fired), wide=True)]


def rewards(source: Source) -> list[Panel]:
    """Return plot panels of each reward term: the mean of its weighted value, and its weighted value over time."""
    terms = source.weighted()
    if not terms:
        return []
    means = {name: mean_of(series.first) for name, series in terms.items()}
    courses = [
        Panel(f"{name} (1/s)", partial(_line, source, series), height=_SHORT)
        for name, series in terms.items()
        if np.any(np.nan_to_num(series.first) != 0)
    ]
    steps = len(next(iter(terms.values())).step)
    return [shares(means, f"Mean reward by term over {steps} recorded steps", "1/s"), *courses]


def series_panel(source: Source, entity: str, title: str) -> list[Panel]:
    """Return a plot panel over time for each number that was recorded in a Rerun entity such as ``base/height``."""
    series = source.series(entity)
    many = series.values.shape[1] > 1

    def panel(i: int, name: str) -> Panel:
        def draw(axes: Axes) -> None:
            axes.plot(*broken(series, source.ends(), i), color=BLUE)
            over_time(axes)

        shown = with_unit(f"{title}: {name}" if many else title, entity)
        return Panel(shown, draw, height=_SHORT if many else 3.0, wide=not many)

    return [panel(i, name) for i, name in enumerate(series.names)]


def with_unit(title: str, entity: str) -> str:
    """Return a panel title with the unit of a recorded entity, if the entity has a unit."""
    found = unit(entity)
    return f"{title} ({found})" if found else title


def over_time(axes: Axes, label: str = "", *, relative: bool = False) -> None:
    """Label the axes of a plot panel that shows numbers over time."""
    axes.set_xlabel("time in the sample (s)" if relative else "simulated time (s)")
    axes.set_ylabel(label)
    axes.yaxis.set_major_locator(MaxNLocator(nbins=5, steps=[1, 2, 2.5, 5, 10]))


def is_driven(source: Source, joint: str) -> bool:
    """Return whether a joint's actuator tracks a velocity target instead of a position target."""
    stiffness = source.drive(joint, "stiffness")
    if stiffness is not None:
        return stiffness == 0.0
    held, driven = (source.maybe("joints", joint, f"{k}_target") for k in ("position", "velocity"))
    return held is not None and driven is not None and bool(np.ptp(held.first) == 0.0 < np.ptp(driven.first))


def _over_time(
    source: Source,
    parts: tuple[str, ...],
    title: str,
    unit: str,
    *,
    target: float | None = None,
    wanted: Series | None = None,
) -> Panel | None:
    # For a training, draw one line per recorded time interval: early intervals are pale, late intervals are dark.
    series = source.maybe(*parts)
    if series is None:
        return None

    def draw(axes: Axes) -> None:
        samples, ends = source.shown_samples() if source.is_training else [], source.ends()
        for sample, shade in zip(samples, shades(len(samples)), strict=True):
            part = sample.of(series)
            if len(part.step):
                (time, values), start = broken(part, ends), part.time[0]
                name = f"step {sample.first}" if sample.iteration is None else f"iteration {sample.iteration}"
                axes.plot(time - start, values, color=shade, label=name)
                if wanted is not None:
                    asked = sample.of(wanted)
                    axes.plot(asked.time - start, asked.first, color=shade, linewidth=1.0, linestyle=(0, (4, 2)))
        if not source.is_training:
            clock = source.clock()
            for moment in () if clock is None else clock.time[np.isin(clock.step, ends)]:
                axes.axvline(moment, color=FAILED, linewidth=0.8, alpha=0.5, gid="end")
            axes.plot(*broken(series, ends), color=BLUE, label="actual")
            if wanted is not None:
                axes.plot(wanted.time, wanted.first, color=VERMILLION, linestyle=(0, (4, 2)), label="command")
        if target is not None:
            label = None if target == 0.0 else f"target {target:g}"
            axes.axhline(target, color=GREEN, linewidth=1.2, linestyle=(0, (4, 2)), label=label)
        over_time(axes, unit, relative=source.is_training)
        if wanted is not None or target or source.is_training:
            axes.legend(loc="best")

    return Panel(f"{title} ({unit})", draw)


def _last(source: Source, series: Series) -> Series:
    samples = source.samples() if source.is_training else []
    return samples[-1].of(series) if samples else series


def _pair(source: Source, actual: str, target: str, axes: Axes) -> None:
    for entity, shade, width, label in ((target, ORANGE, 0.9, "target"), (actual, BLUE, 1.4, "actual")):
        series = _last(source, source.series(entity))
        axes.plot(*broken(series, source.ends()), color=shade, linewidth=width, label=label)
    over_time(axes)
    axes.legend(loc="upper right", ncols=2)


def _effort(source: Source, entity: str, limit: float | None, axes: Axes) -> None:
    axes.plot(*broken(_last(source, source.series(entity)), source.ends()), color=BLUE, linewidth=1.0)
    over_time(axes)
    if limit is not None and np.isfinite(limit):
        axes.set_ylim(*_padded(-limit, limit, 0.12))
        for bound in (-limit, limit):
            axes.axhline(bound, color=FAILED, linewidth=1.0, linestyle=(0, (4, 2)))
        axes.annotate(
            f"limit ±{limit:g}", (1, limit), (0, -2), xycoords=("axes fraction", "data"), textcoords="offset points",
            ha="right", va="top", fontsize=8, color=FAILED,
        )  # fmt: skip


def _force(source: Source, series: Series, peak: Series | None, column: int, top: float, axes: Axes) -> None:
    time, values = broken(series, source.ends(), column)
    axes.fill_between(time, values, color=BLUE, alpha=0.18, linewidth=0)
    axes.plot(time, values, color=BLUE, linewidth=1.1, label="end of the step")
    if peak is not None:
        axes.plot(*broken(peak, source.ends(), column), color=ORANGE, linewidth=0.8, label="largest in the history")
        axes.legend(loc="upper right", ncols=2)
    over_time(axes)
    axes.set_ylim(0, (1.08 if peak is None else 1.3) * top)


def _line(source: Source, series: Series, axes: Axes) -> None:
    axes.plot(*broken(_last(source, series), source.ends()), color=BLUE, linewidth=1.2)
    axes.axhline(0.0, color=MUTED, linewidth=0.8, zorder=1)
    over_time(axes)


def _write(text: str, axes: Axes) -> None:
    axes.axis("off")
    axes.text(0, 0.95, textwrap.fill(text, 110), va="top", transform=axes.transAxes, color=MUTED, fontsize=9)


def _padded(low: float, high: float, part: float = 0.01) -> tuple[float, float]:
    room = part * (high - low) or 0.5
    return low - room, high + room
