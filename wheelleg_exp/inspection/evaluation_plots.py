"""Panels of an evaluation: maps over commands and tiles, limits of pushes, and changed worlds."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap, Normalize
from matplotlib.ticker import PercentFormatter
from numpy.typing import NDArray

from wheelleg_exp.evaluation.result import Evaluation
from wheelleg_exp.files import write_new
from wheelleg_exp.inspection.plot_style import FAINT, INK, MUTED, PROGRESS, Panel, colour, figure_bytes, tile

Array = NDArray[np.float64]
Episodes = Mapping[str, Array]
Reduction = Callable[[Array], float]

# In a map of survival rates, dark red means failure and pale blue means success.
# In a map of tracking errors, a pale colour means a small tracking error.
_SHARES = LinearSegmentedColormap.from_list("shares", ("#9A2A0A", "#E08A4E", "#F6DFC5", "#CFE4F2"))
_DARK = 0.4  # Numbers are white on dark cells: survival below 0.4, or tracking error above 0.4 of the colour scale.
_DEGREES = 180.0 / math.pi


def panels(episodes: Episodes) -> dict[str, list[Panel]]:
    """Return the plot panels of each test of an evaluation, by the test's name such as ``walk``."""
    masks = {test: np.asarray(episodes["test"] == test) for test in _TESTS}
    rows = {
        test: {name: column[mask] for name, column in episodes.items()} for test, mask in masks.items() if mask.any()
    }
    return {test: shown for test, mine in rows.items() if (shown := _TESTS[test](mine))}


def draw(evaluation: Evaluation, folder: Path) -> list[Path]:
    """Write one PNG file for each test of an evaluation, such as ``walk.png``; return the paths of the files."""
    files = []
    for test, shown in panels(evaluation.episodes).items():
        files.append(folder / f"{test}.png")
        write_new(files[-1], figure_bytes(tile(shown), "png"))
    return files


def _of_standing(rows: Episodes) -> list[Panel]:
    end = np.where(rows["survived"] == 1.0, np.inf, rows["time_to_failure_s"])

    def alive(axes: Axes) -> None:
        fell = np.sort(end[np.isfinite(end)])
        x = np.concatenate(([0.0], np.repeat(fell, 2), [float(rows["time_to_failure_s"].max())]))
        axes.plot(x, np.repeat(1.0 - np.arange(len(fell) + 1) / len(end), 2), color=colour(0))
        _share_axis(axes, -0.02)
        axes.set_xlabel("time (s)")

    shown = [("drift_max_m", 1e3, "Largest drift (mm)"), ("pitch_rms_rad", _DEGREES, "Pitch, RMS (°)")]
    return [
        Panel("Episodes that still stand", alive),
        *(_spread(title, rows[name] * factor) for name, factor, title in shown if _some(rows, name)),
    ]


def _spread(title: str, values: Array) -> Panel:
    def draw(axes: Axes) -> None:
        ordered = np.sort(values[np.isfinite(values)])
        axes.plot(ordered, (np.arange(len(ordered)) + 1) / len(ordered), color=colour(0), drawstyle="steps-post")
        _share_axis(axes, 0.0)
        axes.set_ylabel("of the episodes at most")

    return Panel(title, draw)


def _share_axis(axes: Axes, low: float, high: float = 1.02) -> None:
    axes.set_ylim(low, high)
    axes.yaxis.set_major_formatter(PercentFormatter(1.0))


def _of_walking(rows: Episodes) -> list[Panel]:
    def over(name: str, factor: float = 1.0, of: Reduction = np.nanmean) -> Panel | None:
        if not _some(rows, name):
            return None
        # Average tracking errors only over robots that did not fall, because a robot that fell drove for a short time.
        counts = np.where(rows["survived"] == 1.0, factor, np.nan) if name.startswith("error") else factor
        if not np.isfinite(rows[name] * counts).any():
            return None
        return _map(
            titles[name],
            *_grid(rows["command_wz"], rows["command_vx"], rows[name] * counts, of),
            across="yaw rate (rad/s)",
            up="forward speed (m/s)",
            is_share=name in ("survived", "in_band"),
        )

    titles = {
        "survived": "Survived",
        "error_vx": "Error of the speed of survivors, RMS (mm/s)",
        "error_wz": "Error of the yaw rate of survivors, RMS (rad/s)",
        "in_band": "Within the band",
    }
    found = [over("survived"), over("in_band"), over("error_vx", 1e3, _rms), over("error_wz", 1.0, _rms)]
    return [panel for panel in found if panel is not None]


def _of_pushing(rows: Episodes) -> list[Panel]:
    names = list(dict.fromkeys(rows["cell_name"].tolist()))
    kinds = list(dict.fromkeys(name.partition(" over ")[2] for name in names))

    def draw(axes: Axes) -> None:
        largest = 0.0
        for i, kind in enumerate(kinds):
            mine = [name for name in names if name.endswith(f" over {kind}")]
            angles = np.radians([float(name.partition("°")[0]) for name in mine])
            limits = np.array([np.nanmedian(rows["limit_m_s"][rows["cell_name"] == name]) for name in mine])
            angles, limits = np.append(angles, angles[0]), np.append(limits, limits[0])
            # In a plot of push limits, the robot's forward direction is up, and the robot's left side is on the left.
            axes.plot(-limits * np.sin(angles), limits * np.cos(angles), color=colour(i), marker="o", ms=3, label=kind)
            largest = max(largest, float(np.nanmax(limits)))
        largest = largest or 1.0
        step = 10.0 ** math.floor(math.log10(largest))
        step, turn = step if largest / step > 2 else step / 2, np.linspace(0.0, 2 * math.pi, 121)
        for radius in np.arange(step, largest + step, step):
            axes.plot(radius * np.cos(turn), radius * np.sin(turn), color=FAINT, linewidth=0.8, zorder=0)
            axes.annotate(f"{radius:.2g}", (0.0, radius), color=MUTED, fontsize=8, ha="center", va="bottom")
        axes.set_aspect("equal")
        axes.grid(visible=False)
        axes.set_axis_off()
        axes.legend(loc="lower left", title="kick (0 s) or pulse")

    return [Panel("Push that half survive, change of speed (m/s): forwards is up", draw, height=4.2, wide=True)]


def _of_terrain(rows: Episodes) -> list[Panel]:
    kinds = [name.rpartition("/")[0] for name in rows["cell_name"].tolist()]
    order = list(dict.fromkeys(kinds))
    place = np.array([order.index(kind) for kind in kinds], dtype=float)

    def shown(title: str, name: str) -> Panel:
        values, across, up = _grid(rows["level"], place, rows[name], np.nanmean)
        words = [order[int(index)].replace("_", " ") for index in up]
        return _map(title, values, across, words, across="level", up="", is_share=True, height=0.5 + 0.36 * len(order))

    names = [("success", "Success"), ("distance_ratio", "Share of the commanded way")]
    return [shown(title, name) for name, title in names if _some(rows, name)]


def _of_worlds(rows: Episodes) -> list[Panel]:
    plain = rows["sweep"] == "nominal"

    def over(sweep: str) -> Panel:
        mine = rows["sweep"] == sweep
        values = np.unique(rows["value"][mine])
        shares = [float(np.mean(rows["survived"][mine & (rows["value"] == value)])) for value in values]

        def draw(axes: Axes) -> None:
            if plain.any():
                axes.axhline(float(np.mean(rows["survived"][plain])), color=MUTED, linewidth=1.0, linestyle=":")
            axes.plot(values, shares, color=colour(0), marker="o", ms=3.5)
            _share_axis(axes, -0.04, 1.04)

        return Panel(f"Survived, by {sweep.replace('_', ' ')}", draw, height=1.9)

    return [over(sweep) for sweep in dict.fromkeys(rows["sweep"].tolist()) if sweep != "nominal"]


_TESTS: Mapping[str, Callable[[Episodes], list[Panel]]] = {
    "stand": _of_standing,
    "walk": _of_walking,
    "push": _of_pushing,
    "terrain": _of_terrain,
    "bump": _of_terrain,
    "robust": _of_worlds,
}


def _some(rows: Episodes, name: str) -> bool:
    return name in rows and bool(np.isfinite(rows[name]).any())


def _rms(values: Array) -> float:
    finite = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(np.square(finite)))) if len(finite) else math.nan


def _grid(across: Array, up: Array, values: Array, of: Reduction) -> tuple[Array, list[float], list[float]]:
    columns, lines = np.unique(across), np.unique(up)
    found = np.full((len(lines), len(columns)), np.nan)
    for i, line in enumerate(lines):
        for j, column in enumerate(columns):
            mine = values[(across == column) & (up == line)]
            if np.isfinite(mine).any():
                found[i, j] = of(mine)
    return found, columns.tolist(), lines.tolist()


def _map(
    title: str,
    values: Array,
    columns: Sequence[float],
    lines: Sequence[float | str],
    *,
    across: str,
    up: str,
    is_share: bool,
    height: float = 2.6,
) -> Panel:

    def draw(axes: Axes) -> None:
        top = 1.0 if is_share else max(float(np.nanmax(values)) if np.isfinite(values).any() else 1.0, 1e-9)
        norm, shades = Normalize(0.0, top), _SHARES if is_share else PROGRESS
        axes.imshow(values, origin="lower", aspect="auto", cmap=shades, norm=norm)
        for i, j in np.ndindex(values.shape):
            if np.isfinite(values[i, j]):
                share = norm(values[i, j])
                dark = share < _DARK if is_share else share > _DARK
                value = 100.0 * float(values[i, j]) if is_share else float(values[i, j])
                # Format numbers of at least 10 with `.0f`, because `.2g` would write 100 as 1e+02.
                text = f"{value:.0f}" if is_share or abs(value) >= 10.0 else f"{value:.2g}"
                axes.text(j, i, text, ha="center", va="center", fontsize=8, color="white" if dark else INK)
        axes.set_xticks(range(len(columns)), [f"{column:g}" for column in columns])
        axes.set_yticks(range(len(lines)), [line if isinstance(line, str) else f"{line:g}" for line in lines])
        axes.grid(visible=False)
        axes.set_xlabel(across)
        axes.set_ylabel(up)

    return Panel(f"{title} (%)" if is_share else title, draw, height=height)
