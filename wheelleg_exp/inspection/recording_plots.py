"""Plots of recordings and robot logs: single plots by name, pages of plots, and overlays of several recordings."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from wheelleg_exp.definitions import curve_title
from wheelleg_exp.errors import RunDirectoryError, WheellegError, nearest_name
from wheelleg_exp.files import require_new, write_new
from wheelleg_exp.inspection import motion_plots as plots_motion
from wheelleg_exp.inspection import training_curves as plots_training
from wheelleg_exp.inspection.plot_data import Source, broken
from wheelleg_exp.inspection.plot_style import BLUE, GREY, VERMILLION, Panel, colour, figure_bytes, page, tile
from wheelleg_exp.inspection.row_selection import Selection
from wheelleg_exp.recording.layout import TRAINING
from wheelleg_exp.recording.reading.recording_reader import Recording

if TYPE_CHECKING:
    from matplotlib.typing import LineStyleType

    from wheelleg_exp.robot_logs.log_comparison import LogReport

KINDS = ("png", "svg", "pdf")
_LOG_S = 3.0  # A plot of a robot's log shows its first 3 s.
_STYLES: tuple[LineStyleType, ...] = ("-", (0, (4, 3)), "-.", ":")


@dataclass(frozen=True)
class Plot:
    """A predefined plot: its name, its title, and a function that returns the plot's panels (none without data).

    With ``is_of_all``, it shows training scalars; with ``is_of_last``, only the last recorded interval of a training.
    """

    name: str
    title: str
    panels: Callable[[Source], list[Panel]]
    is_of_all: bool = False
    is_of_last: bool = False

    def heading(self, source: Source) -> str:
        """Return a plot's title, such as "Tracking, environment 3, last sample, from iteration 50 on"."""
        is_of_all = source.is_training and self.is_of_all
        words = [self.title, *([source.whose] if source.whose and not is_of_all else [])]
        samples = source.samples() if self.is_of_last and source.is_training else []
        return ", ".join([*words, *(f"last sample, from iteration {sample.iteration} on" for sample in samples[-1:])])


def _rewards(source: Source) -> list[Panel]:
    return plots_training.reward_course(source.training()) or plots_motion.rewards(source)


def _endings(source: Source) -> list[Panel]:
    return plots_training.endings(source.training()) + plots_motion.terminations(source)


_PLOTS = (
    Plot("learning_curves", "Learning curves", lambda s: plots_training.learning(s.training()), is_of_all=True),
    Plot("reward_shares", "Reward by term", _rewards, is_of_all=True),
    Plot("terminations", "How episodes ended", _endings, is_of_all=True),
    Plot("tracking", "Motion against what was asked for", plots_motion.tracking),
    Plot("joints", "Joints", plots_motion.joints, is_of_last=True),
    Plot("contact_forces", "Contact forces", plots_motion.contact_forces, is_of_last=True),
)
PLOTS: dict[str, Plot] = {plot.name: plot for plot in _PLOTS}

PAGES: dict[bool, tuple[str, ...]] = {
    True: ("learning_curves", "reward_shares", "terminations", "tracking"),
    False: ("tracking", "reward_shares", "contact_forces", "joints", "terminations"),
}


def make(recording: Recording, name: str, *, selection: Selection | None = None) -> Figure:
    """Return the figure of a predefined plot by name, such as ``tracking``."""
    if name not in PLOTS:
        expected = "one of " + ", ".join(PLOTS)
        raise WheellegError(f"there is no plot named '{name}'", expected=expected, nearest=nearest_name(name, PLOTS))
    plot, source = PLOTS[name], Source(recording, None, selection)
    panels = plot.panels(source)
    if not panels:
        raise RunDirectoryError(f"the recording '{recording.path}' has no data for the plot '{name}'")
    figure = tile(panels, title=plot.heading(source))
    figure.set_label(name)
    return figure


def default_page(recording: Recording, *, selection: Selection | None = None) -> Figure:
    """Return one figure with the default plots for the recording's purpose: training, play, or evaluation."""
    source = Source(recording, selection=selection)
    plots = [PLOTS[name] for name in PAGES[source.is_training]]
    sections = [(plot.heading(source), panels) for plot in plots if (panels := plot.panels(source))]
    if not sections:
        message = f"'{recording.path}' has no data for the default plots"
        raise RunDirectoryError(message, expected="--term with one of its terms")
    return page(sections)


def terms_figure(recording: Recording, terms: Sequence[str], *, selection: Selection | None = None) -> Figure:
    """Return a figure of the recorded numbers ``terms``, such as ``rewards.base_height``, over time."""
    source = Source(recording, selection=selection)
    panels = [panel for term in terms for panel in _term(source, term)]
    of_training = all((source.find(term) or "").startswith(f"{TRAINING}/") for term in terms)
    return tile(panels, title=None if of_training else source.whose.capitalize() or None)


def overlay(
    recordings: Mapping[str, Recording], terms: str | Sequence[str], *, selection: Selection | None = None
) -> Figure:
    """Return a figure with one panel per recorded number, and one line per recording in each panel.

    Without ``terms``, the figure shows training curves if every recording is of a training, otherwise motions.
    RunDirectoryError means that the recordings contain no number to plot.
    """
    named = {label: Source(r, selection=selection) for label, r in recordings.items()}
    sources = {f"{label}, {s.whose}" if s.whose and not s.is_training else label: s for label, s in named.items()}
    if terms:
        words = [terms] if isinstance(terms, str) else list(terms)
        return tile([panel for term in words for panel in _overlaid(sources, term)])
    common: Sequence[str] = list(plots_motion.TITLES)
    if all(source.is_training for source in sources.values()):
        common = [f"{TRAINING}/{key}" for key in plots_training.CURVES if not key.startswith("Perf/")]
    panels = [panel for term in common for panel in _overlaid(sources, term, small=True)]
    if not panels:
        raise RunDirectoryError("the recordings contain neither training curves nor motions to plot")
    return tile(panels)


def log_figure(report: LogReport) -> Figure:
    """Return a figure of the columns that the findings name, or of all columns, in the first seconds of the log."""
    named = [column for finding in report.findings for column in finding.columns if column in report.columns]
    time = report.time - report.time[:1].sum()
    rows = time <= _LOG_S

    def draw(column: str, axes: Axes) -> None:
        for values, shade, label in (
            (report.logged, GREY, "logged"),
            (report.simulated, VERMILLION, "simulated from the log"),
            (report.corrected, BLUE, "simulated without the faults"),
        ):
            drawn = np.asarray(values)[rows, report.columns.index(column)]
            axes.plot(time[rows], drawn, color=shade, label=label, marker=".", linestyle="none")
        axes.set_xlabel("time (s)")
        axes.legend(loc="best")

    columns = list(dict.fromkeys(named)) or report.columns
    return tile([Panel(column, partial(draw, column)) for column in columns], title="Log and simulation")


def save(figure: Figure, path: Path) -> None:
    """Write a figure atomically to a PNG, SVG, or PDF file. The file's suffix selects the format."""
    write_new(Path(path), figure_bytes(figure, require_path(Path(path))))


def require_path(path: Path) -> str:
    """Return the image format of a new picture; raise WheellegError if ``path`` exists or has an unknown suffix."""
    kind = path.suffix.removeprefix(".").lower()
    if kind not in KINDS:
        raise WheellegError(f"'{path}' is not an image file name", expected="a name that ends with .png, .svg or .pdf")
    require_new(path)
    return kind


def _term(source: Source, term: str) -> list[Panel]:
    entity = source.find(term)
    if entity is None:
        source.series(source.path(*term.split(".")))  # No recorded number is named `term`, so raise an error.
        return []
    if entity.startswith(f"{TRAINING}/"):
        series = source.series(entity)

        def draw(axes: Axes) -> None:
            x = series.iteration if series.iteration is not None else series.step
            plots_training.draw_curve(axes, x, series.first, colour(0))
            plots_training.over_iterations(axes)

        return [Panel(term, draw, height=3.0, wide=True)]
    return plots_motion.series_panel(source, entity, term)


def _overlaid(sources: Mapping[str, Source], term: str, *, small: bool = False) -> list[Panel]:
    found = {label: entity for label, s in sources.items() if (entity := s.find(term)) is not None}
    if not found:
        if small:
            return []
        next(iter(sources.values())).series(term)  # No recorded number is named `term`, so raise an error.
    series = {label: sources[label].series(entity) for label, entity in found.items()}
    names = max(series.values(), key=lambda s: s.values.shape[1]).names
    word = term.removeprefix(f"{TRAINING}/")
    named = {key: curve_title(key) for key in plots_training.CURVES} | plots_motion.TITLES
    shown = named.get(word, plots_motion.with_unit(word, word.replace(".", "/")))
    in_training = all(source.is_training for source in sources.values()) and term.replace(".", "/").startswith(TRAINING)

    def draw(column: int, axes: Axes) -> None:
        for i, (label, one) in enumerate(series.items()):
            style = _STYLES[i % len(_STYLES)]
            if column >= one.values.shape[1]:
                continue
            if in_training and one.iteration is not None:
                plots_training.draw_curve(axes, one.iteration, one.values[:, column], colour(i), label, style)
            else:
                time, values = broken(one, sources[label].ends(), column)
                axes.plot(time, values, color=colour(i), linestyle=style, label=label)
        (plots_training.over_iterations if in_training else plots_motion.over_time)(axes)
        axes.legend(loc="best")

    titles = [f"{shown}: {name}" for name in names] if len(names) > 1 else [shown]
    return [Panel(t, partial(draw, i), height=2.35 if small else 3.0) for i, t in enumerate(titles)]
