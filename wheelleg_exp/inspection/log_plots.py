"""Plots of a robot's log: the logged readings, and the readings that the simulation predicts from the log."""

from __future__ import annotations

from functools import partial

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from wheelleg_exp.inspection.plot_style import BLUE, GREY, VERMILLION, Panel, tile
from wheelleg_exp.robot_logs.log_comparison import LogReport

_SHOWN_S = 3.0


def log_figure(report: LogReport) -> Figure:
    """Return a figure of the columns that the findings name, or of all columns, in the first seconds of the log."""
    named = [column for finding in report.findings for column in finding.columns if column in report.columns]
    columns = list(dict.fromkeys(named)) or report.columns
    return tile([Panel(column, partial(_draw, report, column)) for column in columns], title="Log and simulation")


def _draw(report: LogReport, column: str, axes: Axes) -> None:
    index, time = report.columns.index(column), report.time - report.time[:1].sum()
    rows = time <= _SHOWN_S
    for values, colour, label in (
        (report.logged, GREY, "logged"),
        (report.simulated, VERMILLION, "simulated from the log"),
        (report.corrected, BLUE, "simulated without the faults"),
    ):
        axes.plot(time[rows], np.asarray(values)[rows, index], color=colour, label=label, marker=".", linestyle="none")
    axes.set_xlabel("time (s)")
    axes.legend(loc="best")
