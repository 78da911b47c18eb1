"""Panels as SVG for the page: one by one, as narrow as a phone, with their titles as text of the page."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import replace
from typing import TYPE_CHECKING

from wheelleg_exp.report.blocks import Plot, Plots
from wheelleg_exp.report.svg import clean

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from wheelleg_exp.inspection.plots.style import Panel

# in; a phone's column is about 345 px, on which letters of 8.5 pt are then as large as they should be.
_WIDTH, _HEIGHT = 3.9, 2.15
_MOST_COLUMNS = 3
_LETTER, _LEGEND_ROW = 0.075, 0.17  # in, of a legend below its panel


def drawn(panels: Iterable[Panel], prefix: str, *, paired: bool = False) -> Plots:
    """Return panels as drawings of the page.

    Args:
        panels: what is drawn.
        prefix: what the names inside the drawings begin with; of one page's calls each needs its own.
        paired: whether they belong together two by two.
    """
    return Plots(tuple(_plot(panel, f"{prefix}-{i}") for i, panel in enumerate(panels)), paired)


def _plot(panel: Panel, prefix: str) -> Plot:
    from wheelleg_exp.inspection.plots.style import figure_svg, styled, tile

    height = max(_HEIGHT, min(0.85 * panel.height, 4.0))
    figure = tile([replace(panel, title="")], size=(_WIDTH, height))
    said = _only_words(figure)
    if said:
        return Plot("", panel.title, said)
    with styled():
        rows = _legends_below(figure)
    figure.set_size_inches(_WIDTH, height + _LEGEND_ROW * rows)
    return Plot(_rounded(clean(figure_svg(figure), prefix, panel.title)), panel.title)


def _only_words(figure: Figure) -> str:
    """Return what a panel says when it draws nothing else."""
    axes = figure.axes[0]
    drawn_ = [*axes.lines, *axes.collections, *axes.patches, *axes.images]
    return "" if drawn_ or axes.axison else " ".join(text.get_text() for text in axes.texts)


def _legends_below(figure: Figure) -> int:
    """Move legends that stand beside the axes below them, where a narrow page has room; return their rows."""
    rows = 0
    for axes in figure.axes:
        legend = axes.get_legend()
        if legend is None or legend.get_bbox_to_anchor().x0 < axes.bbox.x1:
            continue
        labels = [text.get_text() for text in legend.get_texts()]
        longest = max(map(len, labels), default=1) * _LETTER + 0.45
        columns = max(1, min(_MOST_COLUMNS, len(labels), int(_WIDTH / longest)))
        handles = [handle for handle in legend.legend_handles if handle is not None]
        legend.remove()
        figure.legend(handles, labels, loc="outside lower left", ncols=columns)
        rows += -(-len(labels) // columns)
    return rows


def _rounded(svg: str) -> str:
    """Return the drawing with coordinates of a hundredth of a point, which nobody can tell from finer ones."""
    return re.sub(r"(?<=[\s\"(,])-?\d+\.\d{3,}(?=[\s\"),])", lambda match: f"{float(match.group()):.2f}", svg)
