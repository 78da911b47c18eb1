"""Draw matplotlib plots as SVG images of an HTML page.

Each panel is an image that fits a phone screen: an ``<img>`` with a data URI, which runs no scripts and loads no files.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from urllib.parse import quote

from matplotlib.figure import Figure

from wheelleg_exp.inspection.plot_style import Panel, figure_svg, styled, tile
from wheelleg_exp.report.page_blocks import Picture, Plot, Plots

# In a plot of 3.9 x 2.15 inches, letters of 8.5 pt are readable on a phone screen 345 pixels wide.
_WIDTH, _HEIGHT = 3.9, 2.15
_MOST_COLUMNS = 3
_LETTER, _LEGEND_ROW = 0.075, 0.17  # In a legend, a letter is 0.075 inches wide, and a row is 0.17 inches high.


def drawn(panels: Iterable[Panel], *, paired: bool = False) -> Plots:
    """Draw plot panels as SVG images; ``paired`` limits a row to two panels."""
    return Plots(tuple(map(_plot, panels)), paired)


def _plot(panel: Panel) -> Plot:
    height = max(_HEIGHT, min(0.85 * panel.height, 4.0))
    figure = tile([replace(panel, title="")], size=(_WIDTH, height))
    axes = figure.axes[0]
    if not axes.axison and not [*axes.lines, *axes.collections, *axes.patches, *axes.images]:
        # Show a plot panel that contains only text as a caption, without an image.
        return Plot(None, panel.title, " ".join(text.get_text() for text in axes.texts))
    with styled():
        rows = _legends_below(figure)
    height += _LEGEND_ROW * rows
    figure.set_size_inches(_WIDTH, height)
    uri = "data:image/svg+xml," + quote(figure_svg(figure), safe=" /;=,")
    return Plot(Picture(uri, round(72 * _WIDTH), round(72 * height), alt=panel.title), panel.title)


def _legends_below(figure: Figure) -> int:
    """Move the legends of a plot below the axes, because a page can be narrow; return the number of legend rows."""
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
