"""Draw matplotlib plots as SVG inside an HTML page.

``drawn`` draws each plot panel as a separate SVG that fits a phone screen; the panel's title becomes HTML text.
``clean`` makes an SVG safe inside a page: only known elements and attributes stay, ids get a prefix, and no reference
leaves the page.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from dataclasses import replace
from xml.etree import ElementTree

from matplotlib.figure import Figure

from wheelleg_exp.inspection.plot_style import Panel, figure_svg, styled, tile
from wheelleg_exp.report.page_blocks import Plot, Plots

_SVG, _XLINK = "http://www.w3.org/2000/svg", "http://www.w3.org/1999/xlink"
_SHAPES = """
    svg g defs clipPath path rect circle ellipse line polyline polygon text tspan title desc use marker symbol
    linearGradient radialGradient stop mask pattern
"""
_SETTINGS = """
    id x y x1 y1 x2 y2 cx cy r rx ry d dx dy points width height viewBox transform style class fill stroke opacity
    stroke-width stroke-linecap stroke-linejoin stroke-dasharray stroke-dashoffset stroke-opacity stroke-miterlimit
    fill-opacity fill-rule clip-path clip-rule mask font-family font-size font-weight font-style text-anchor
    dominant-baseline offset stop-color stop-opacity gradientUnits gradientTransform patternUnits refX refY
    markerWidth markerHeight orient marker-start marker-end preserveAspectRatio overflow textLength lengthAdjust
    letter-spacing
"""
_ELEMENTS, _ATTRIBUTES = frozenset(_SHAPES.split()), frozenset(_SETTINGS.split())
_LOCAL = re.compile(r"url\(\s*['\"]?#([^)'\"\s]+)['\"]?\s*\)")
_FOREIGN = re.compile(r"url\(\s*['\"]?(?!#)|@import|expression\(|javascript:|\\", re.IGNORECASE)


def clean(svg: str, prefix: str, title: str) -> str:
    """Remove prolog, scripts, links, and foreign styles from an SVG text; raise ValueError if it is not SVG.

    ``prefix`` is prepended to the ids in the SVG, so that two drawings on a page have different ids. ``title``
    describes the drawing for screen readers.
    """
    try:
        root = ElementTree.fromstring(re.sub(r"<!DOCTYPE[^>\[]*>", "", svg))
    except ElementTree.ParseError as error:
        raise ValueError(f"the text is not SVG: {error}") from error
    if _local(root.tag) != "svg":
        raise ValueError("the text is not SVG")
    kept = _copy(root, prefix)
    box = (root.get("viewBox") or f"0 0 {_length(root, 'width')} {_length(root, 'height')}").split()
    kept.set("viewBox", " ".join(box))
    kept.set("width", box[2])
    kept.set("height", box[3])
    # matplotlib sets ``stroke-linejoin`` in a style sheet, which would apply to the whole HTML page.
    kept.set("stroke-linejoin", "round")
    kept.set("role", "img")
    kept.set("aria-label", title)
    return ElementTree.tostring(kept, encoding="unicode")


def _copy(element: ElementTree.Element, prefix: str) -> ElementTree.Element:
    """Return a copy of an SVG element without namespaces and without child elements that are not allowed."""
    copy = ElementTree.Element(_local(element.tag), dict(_attributes(element, prefix)))
    copy.text, copy.tail = element.text, element.tail
    for child in element:
        if isinstance(child.tag, str) and _local(child.tag) in _ELEMENTS:
            copy.append(_copy(child, prefix))
    return copy


def _attributes(element: ElementTree.Element, prefix: str) -> Iterator[tuple[str, str]]:
    for name, value in element.attrib.items():
        local = _local(name)
        # Add a prefix to SVG ids and to references to these ids; remove references to files outside of the SVG.
        if local == "href" and value.startswith("#"):
            yield "href", f"#{prefix}-{value[1:]}"
        elif local == "id":
            yield "id", f"{prefix}-{value}"
        elif local in _ATTRIBUTES and not name.startswith("{") and not _FOREIGN.search(value):
            yield local, _LOCAL.sub(rf"url(#{prefix}-\1)", value)


def _local(tag: str) -> str:
    return re.sub(rf"^\{{(?:{re.escape(_SVG)}|{re.escape(_XLINK)})\}}", "", tag)


def _length(root: ElementTree.Element, name: str) -> str:
    return re.sub(r"[^\d.]", "", root.get(name, "")) or "100"


# In a plot of 3.9 x 2.15 inches, letters of 8.5 pt are readable on a phone screen 345 pixels wide.
_WIDTH, _HEIGHT = 3.9, 2.15
_MOST_COLUMNS = 3
_LETTER, _LEGEND_ROW = 0.075, 0.17  # In a legend, a letter is 0.075 inches wide, and a row is 0.17 inches high.


def drawn(panels: Iterable[Panel], prefix: str, *, paired: bool = False) -> Plots:
    """Draw plot panels as SVG; ``paired`` limits a row to two panels, and ``prefix`` makes the SVG ids unique."""
    return Plots(tuple(_plot(panel, f"{prefix}-{i}") for i, panel in enumerate(panels)), paired)


def _plot(panel: Panel, prefix: str) -> Plot:
    height = max(_HEIGHT, min(0.85 * panel.height, 4.0))
    figure = tile([replace(panel, title="")], size=(_WIDTH, height))
    axes = figure.axes[0]
    if not axes.axison and not [*axes.lines, *axes.collections, *axes.patches, *axes.images]:
        # Show a plot panel that contains only text as a caption, without an SVG.
        return Plot("", panel.title, " ".join(text.get_text() for text in axes.texts))
    with styled():
        rows = _legends_below(figure)
    figure.set_size_inches(_WIDTH, height + _LEGEND_ROW * rows)
    svg = clean(figure_svg(figure), prefix, panel.title)
    # To save space, coordinates in the SVG are rounded to a hundredth of a point, which is invisible.
    number = r"(?<=[\s\"(,])-?\d+\.\d{3,}(?=[\s\"),])"
    return Plot(re.sub(number, lambda match: f"{float(match.group()):.2f}", svg), panel.title)


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
