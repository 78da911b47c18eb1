"""Panels of a training: curves over iterations, drawn from scalars alone."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator, PercentFormatter
from numpy.typing import ArrayLike

from wheelleg_exp.definitions import EPISODE_REWARD, curve_title, scalar_definition
from wheelleg_exp.inspection.plot_data import Numbers, Points, Scalars, drawable, mean_of
from wheelleg_exp.inspection.plot_style import BLUE, INK, MUTED, VERMILLION, Panel, colour

if TYPE_CHECKING:
    from matplotlib.typing import ColorType, LineStyleType

_SMOOTHED_FROM = 60
_WINDOWS = 40
_LOG_FROM = 50.0  # The axis of a curve is logarithmic if the curve's largest value is over 50 times its smallest value.
_SHOWN_TERMS = 7
# `CURVES` lists the training scalars that are plotted as learning curves, in the order of the plots.
CURVES = (
    "Train/mean_reward",
    "Train/mean_episode_length",
    "Loss/value",
    "Loss/surrogate",
    "Policy/mean_std",
    "Loss/entropy",
    "Loss/learning_rate",
    "Perf/total_fps",
)
# The keys of training scalars for a command's tracking error start with one of the prefixes in `_ERRORS`.
# Plot only the scalars with the first prefix in `_ERRORS` that the training logged.
_ERRORS = ("Metrics_per_step/", "Episode_Metrics/", "Metrics/")


def learning(scalars: Scalars) -> list[Panel]:
    """Return the learning curves: return, episode length, tracking errors, losses, action noise."""
    panels = [_curve(key, scalars[key]) for key in CURVES if key in scalars]
    kinds = ([key for key in scalars if key.startswith(head)] for head in _ERRORS)
    errors: list[str] = next(filter(None, kinds), [])
    return [*panels[:2], *(_curve(key, scalars[key]) for key in errors), *panels[2:]]


def endings(scalars: Scalars) -> list[Panel]:
    """Return plot panels of the share of episodes that each termination term ended, over training iterations."""
    causes = _below(scalars, "Episode_Termination")
    if not causes:
        return []
    order = sorted(causes, key=lambda name: -float(np.nansum(causes[name][1])))
    shown = [name for name in order if np.any(np.asarray(causes[name][1]) != 0)] or order[:1]

    def draw(axes: Axes) -> None:
        # Do not stack the curves of termination terms, because an episode that two terms end counts for both terms.
        for i, name in enumerate(shown):
            draw_curve(axes, *causes[name], colour(i), name)
        over_iterations(axes)
        axes.set_ylim(0, 1.02)
        axes.yaxis.set_major_formatter(PercentFormatter(1.0))
        axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))

    return [Panel("Share of all environments whose last episode each termination ended", draw, wide=True)]


def reward_course(scalars: Scalars) -> list[Panel]:
    """Return panels of each reward term's sum over an episode, divided by the longest episode's duration."""
    terms = _below(scalars, "Episode_Reward")
    if not terms:
        return []
    late = {name: mean_of(v[-max(1, len(v) // 10) :]) for name, (_, v) in terms.items()}
    order = sorted(terms, key=lambda name: -float(np.nansum(np.abs(terms[name][1]))))
    names = [name for name in order if np.any(np.asarray(terms[name][1]) != 0)] or order[:1]

    def draw(axes: Axes) -> None:
        x = np.asarray(terms[names[0]][0])
        most = _SHOWN_TERMS if len(names) > _SHOWN_TERMS + 1 else len(names)
        rows = [(name, _on(x, terms[name]), colour(i)) for i, name in enumerate(names[:most])]
        if rest := names[most:]:
            rows.append((f"{len(rest)} others", np.sum([_on(x, terms[n]) for n in rest], axis=0), "#B8C0CA"))
        stack(axes, x, rows)
        over_iterations(axes)

    by_term = Panel(f"Reward by term: {EPISODE_REWARD}", draw, wide=True, height=2.8)
    return [by_term, shares(late, f"Reward by term in the last tenth: {EPISODE_REWARD}", "")]


def shares(means: Mapping[str, float], title: str, unit: str) -> Panel:
    """Return a bar plot of each reward term's mean weighted value and its share of the sum of all absolute means."""
    order = sorted(means, key=lambda name: abs(means[name]))
    total = sum(abs(v) for v in means.values()) or 1.0

    def draw(axes: Axes) -> None:
        values = [means[name] for name in order]
        axes.barh(order, values, color=[BLUE if v >= 0 else VERMILLION for v in values], height=0.68)
        for row, v in enumerate(values):
            share = abs(v) / total
            text = f"{v:+.3g}  ({f'{share:.0%}' if share >= 0.005 else '<1%'})" if v else "0"
            at = (max(v, 0.0), row)
            axes.annotate(text, at, (5, 0), textcoords="offset points", va="center", fontsize=8, color=INK)
        axes.axvline(0.0, color=MUTED, linewidth=0.8)
        low, high = min(0.0, *values), max(0.0, *values)
        axes.set_xlim(low - 0.02 * (high - low), high + 0.32 * (high - low) or 1.0)
        axes.margins(y=0.02)
        axes.grid(axis="y", visible=False)
        axes.set_xlabel(f"{unit} (share by absolute value)".strip())

    return Panel(title, draw, height=0.75 + 0.24 * max(len(order), 3), wide=True)


def smooth(values: Numbers) -> Numbers:
    """Return a centred moving mean; its window contains 1/40 of all values, but fewer at the ends of the curve."""
    half = max(1, len(values) // _WINDOWS // 2)
    known, window = np.isfinite(values), np.ones(2 * half + 1)
    sums = np.convolve(np.where(known, values, 0.0), window, "same")
    counts = np.convolve(known, window, "same")
    return np.where(counts > 0, sums / np.maximum(counts, 1), np.nan)


def draw_curve(
    axes: Axes, x: ArrayLike, y: ArrayLike, shade: ColorType, label: str | None = None, style: LineStyleType = "-"
) -> None:
    """Draw a curve over training iterations; draw a long curve in a pale colour, and its moving mean on top."""
    values = drawable(y)
    if len(values) >= _SMOOTHED_FROM:
        axes.plot(x, values, color=shade, linewidth=0.8, alpha=0.3)
        axes.plot(x, smooth(values), color=shade, label=label, linestyle=style, gid="smooth")
    else:
        axes.plot(x, values, color=shade, label=label, linestyle=style, marker="." if len(values) < 15 else None)


def over_iterations(axes: Axes, label: str = "") -> None:
    """Label the axes of a plot panel that shows numbers over training iterations."""
    axes.set_xlabel("iteration")
    axes.set_ylabel(label)
    axes.xaxis.set_major_locator(MaxNLocator(integer=True, nbins=6))
    if axes.get_yscale() == "linear":
        axes.yaxis.set_major_locator(MaxNLocator(nbins=5, steps=[1, 2, 2.5, 5, 10]))


def _curve(key: str, points: Points) -> Panel:
    known = scalar_definition(key)

    def draw(axes: Axes) -> None:
        draw_curve(axes, *points, BLUE)
        values = drawable(points[1])
        values = values[np.isfinite(values)]
        if len(values) and values.min() > 0 and values.max() > _LOG_FROM * values.min():
            axes.set_yscale("log")
        over_iterations(axes, "" if known is None else known.unit)

    return Panel(curve_title(key), draw)


def _below(scalars: Scalars, group: str) -> dict[str, Points]:
    head = f"{group}/"
    return {key.removeprefix(head): points for key, points in scalars.items() if key.startswith(head)}


def stack(axes: Axes, x: Numbers, rows: Sequence[tuple[str, Numbers, ColorType]]) -> None:
    """Stack named rows over ``x``: positive numbers up, negative numbers down."""
    for sign in (1.0, -1.0):
        parts = [(shade, np.clip(sign * np.nan_to_num(v), 0, None) * sign) for _, v, shade in rows]
        if any(np.any(part) for _, part in parts):
            colours, values = zip(*parts, strict=True)
            axes.stackplot(x, *values, colors=colours, alpha=0.85, linewidth=0.4, edgecolor="white")
    handles = [axes.fill_between([], [], color=shade, alpha=0.85, label=name) for name, _, shade in rows]
    axes.axhline(0.0, color=MUTED, linewidth=0.8)
    axes.margins(x=0)
    axes.legend(handles=handles, loc="center left", bbox_to_anchor=(1.0, 0.5))


def _on(x: Numbers, points: Points) -> Numbers:
    found = dict(zip(np.asarray(points[0]).tolist(), drawable(points[1]).tolist(), strict=True))
    values: Numbers = np.nan_to_num(np.array([found.get(i, 0.0) for i in x.tolist()]))
    return values
