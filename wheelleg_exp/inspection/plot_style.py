"""Style of plots: fonts, colours for colour-blind readers, panels in a grid, and reproducible files."""

from __future__ import annotations

import io
import math
import re
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure, SubFigure
from matplotlib.text import Text

from wheelleg_exp.errors import printable

if TYPE_CHECKING:
    from matplotlib.typing import ColorType, RcKeyType

BLUE, VERMILLION, GREEN, PURPLE = "#0072B2", "#D55E00", "#009E73", "#A65698"
ORANGE, SKY, BROWN, GREY = "#E69F00", "#56B4E9", "#7A5C3E", "#6B7280"
PALETTE = (BLUE, VERMILLION, GREEN, PURPLE, ORANGE, SKY, BROWN, GREY)
INK, MUTED, FAINT = "#1F2933", "#52606D", "#E4E7EB"
FAILED = "#C2410C"

# The colour map `PROGRESS` goes from pale to dark, so that plots are readable on white paper and in grey print.
PROGRESS = LinearSegmentedColormap.from_list("progress", ("#9CC9E8", "#3D8FC4", "#0B4F7D", "#062B45"))

PAGE_WIDTH, PANEL_HEIGHT = 9.6, 2.35
_DPI = 150
_COLUMNS = 2  # A figure has two plots (panels) per row; a wide panel fills a row.
_MOST_PANELS = 200
_NUMBER = re.compile(r"-?\d+\.\d{3,}")
_WEB_FONTS = "system-ui, -apple-system, 'Segoe UI', Roboto, 'Helvetica Neue', Arial, 'DejaVu Sans', sans-serif"

STYLE: Mapping[RcKeyType, object] = {
    "font.family": ["sans-serif"],
    "font.sans-serif": ["DejaVu Sans"],
    "font.size": 9.0,
    "text.color": INK,
    "axes.titlesize": 9.5,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.titlepad": 6.0,
    "axes.labelsize": 8.5,
    "axes.labelcolor": MUTED,
    "axes.edgecolor": "#9AA5B1",
    "axes.linewidth": 0.8,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.xmargin": 0.01,
    "axes.formatter.limits": (-3, 4),
    "grid.color": FAINT,
    "grid.linewidth": 0.8,
    "xtick.color": MUTED,
    "ytick.color": MUTED,
    "xtick.labelsize": 8.5,
    "ytick.labelsize": 8.5,
    "xtick.major.size": 3.0,
    "ytick.major.size": 0.0,
    "lines.linewidth": 1.5,
    "lines.solid_capstyle": "round",
    "legend.fontsize": 8.0,
    "legend.frameon": True,
    "legend.framealpha": 0.8,
    "legend.edgecolor": "none",
    "legend.borderpad": 0.2,
    "legend.handlelength": 1.6,
    "legend.labelspacing": 0.25,
    "figure.facecolor": "white",
    "figure.dpi": 100.0,
    "figure.constrained_layout.use": True,
    "figure.constrained_layout.h_pad": 0.06,
    "figure.constrained_layout.w_pad": 0.06,
    "svg.fonttype": "none",
    "svg.hashsalt": "wheelleg",
    "pdf.fonttype": 42,
    "path.simplify": True,
    "text.parse_math": False,  # Disable matplotlib's math text, because plotted names can contain '$'.
}


@dataclass(frozen=True)
class Panel:
    """One plot of a figure: its title with the unit, a function that draws into axes, and its height in inches.

    A ``wide`` panel occupies a whole row. In a figure of fixed size, only the ratios of the heights matter.
    """

    title: str
    draw: Callable[[Axes], None]
    height: float = PANEL_HEIGHT
    wide: bool = False


@contextmanager
def styled() -> Iterator[None]:
    """Apply wheelleg_exp's plot style inside a ``with`` block, and restore matplotlib's settings after the block."""
    with mpl.rc_context(rc={**mpl.rcParamsDefault, "backend": mpl.rcParams["backend"], **STYLE}):
        yield


@contextmanager
def _saved(figure: Figure) -> Iterator[None]:
    """Prepare a figure for saving: replace characters that XML forbids, and silence warnings on missing glyphs."""
    for text in figure.findobj(Text):
        text.set_text(printable(text.get_text()))
    with styled(), warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # Suppress matplotlib's warnings about glyphs and long titles.
        yield


def colour(index: int) -> str:
    """Return the colour of curve ``index`` in a plot of curves without an order, such as one curve per joint."""
    return PALETTE[index % len(PALETTE)]


def shades(count: int) -> list[ColorType]:
    """Return plot colours from pale (early) to dark (late) for curves that are ordered in time."""
    return [BLUE] if count == 1 else [PROGRESS(i / (count - 1)) for i in range(count)]


def tile(panels: Sequence[Panel], *, title: str | None = None, size: tuple[float, float] | None = None) -> Figure:
    """Return a figure of panels in a grid with a title; ``size`` is in inches, by default that of its panels."""
    return page([(title, panels)], size)


@styled()
def page(sections: Sequence[tuple[str | None, Sequence[Panel]]], size: tuple[float, float] | None = None) -> Figure:
    """Return a matplotlib figure with groups of panels, each with an optional title, from top to bottom."""
    rows = [_rows(panels) for _, panels in sections]
    heights = [sum(max(p.height for p in row) for row in section) for section in rows]
    heights = [height + (0.35 if title else 0.0) for height, (title, _) in zip(heights, sections, strict=True)]
    width = PAGE_WIDTH if max(map(len, (p for s in rows for p in s))) > 1 else PAGE_WIDTH / 1.6
    figure = Figure(figsize=size or (width, sum(heights)))
    parts: list[Figure | SubFigure] = [figure]
    if len(sections) > 1:
        parts = list(figure.subfigures(len(sections), 1, squeeze=False, height_ratios=heights)[:, 0])
    for part, (title, _), section in zip(parts, sections, rows, strict=True):
        if title:
            part.suptitle(title, x=0.012, ha="left", fontsize=12, fontweight="bold", color=INK)
        _fill(part, section)
    return figure


def figure_svg(figure: Figure) -> str:
    """Convert a figure to an SVG document with a ``viewBox`` and without a date: equal figures give equal documents."""
    with _saved(figure):
        buffer = io.StringIO()
        write: Callable[..., None] = FigureCanvasSVG(figure).print_svg
        write(buffer, metadata=dict.fromkeys(("Date", "Creator", "Format", "Type")))
    text = buffer.getvalue()
    text = text[text.index("<svg") :]  # Remove the SVG's XML declaration, which an HTML page cannot contain.
    text = re.sub(r"font: ((?:[a-z0-9]+ )*[\d.]+px) [^;\"]+", rf"font: \1 {_WEB_FONTS}", text)
    text = re.sub(r"<!--.*?-->\s*", "", text, flags=re.DOTALL)
    shorten = partial(_NUMBER.sub, lambda number: f"{float(number[0]):.2f}".rstrip("0").rstrip("."))
    return re.sub(r' d="[^"]+"', lambda path: shorten(path[0]), text)


def figure_bytes(figure: Figure, kind: str) -> bytes:
    """Convert a matplotlib figure to the content of a png, svg, or pdf file, without a date."""
    if kind == "svg":
        return f'<?xml version="1.0" encoding="utf-8" standalone="no"?>\n{figure_svg(figure)}'.encode()
    buffer = io.BytesIO()
    with _saved(figure):
        FigureCanvasAgg(figure)
        metadata = {"CreationDate" if kind == "pdf" else "Software": None}
        figure.savefig(buffer, format=kind, dpi=_DPI, metadata=metadata)
    return buffer.getvalue()


def _rows(panels: Sequence[Panel]) -> list[list[Panel]]:
    rows: list[list[Panel]] = []
    for panel in panels[:_MOST_PANELS]:
        if rows and len(rows[-1]) < _COLUMNS and not panel.wide and not rows[-1][-1].wide:
            rows[-1].append(panel)
        else:
            rows.append([panel])
    if len(panels) > _MOST_PANELS:
        beyond = f"… and {len(panels) - _MOST_PANELS} more, which --term draws one by one"
        rows.append([Panel(beyond, lambda axes: axes.set_axis_off(), height=0.4, wide=True)])
    return rows


def _fill(part: Figure | SubFigure, rows: Sequence[Sequence[Panel]]) -> None:
    # A wide panel spans all columns of the grid.
    lcm = math.lcm(*(1 if row[0].wide else max(len(r) for r in rows) for row in rows))
    grid = part.add_gridspec(len(rows), lcm, height_ratios=[max(p.height for p in row) for row in rows])
    for i, row in enumerate(rows):
        span = lcm if row[0].wide else lcm // max(len(r) for r in rows)
        for j, panel in enumerate(row):
            axes = part.add_subplot(grid[i, j * span : (j + 1) * span])
            axes.set_title(panel.title)
            panel.draw(axes)
