"""SVG made fit to stand inside a page: known elements and attributes only, names of its own, nothing fetched."""

from __future__ import annotations

import re
from collections.abc import Iterator
from xml.etree import ElementTree

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
    """Return the drawing without prolog, scripts, links and styles of foreign origin.

    Args:
        svg: a whole SVG document.
        prefix: what its names begin with from now on, so that two drawings of a page share none.
        title: what it shows, for those who do not see it.

    Raises:
        ValueError: it is no SVG.
    """
    try:
        root = ElementTree.fromstring(re.sub(r"<!DOCTYPE[^>\[]*>", "", svg))
    except ElementTree.ParseError as error:
        raise ValueError(f"this is no SVG: {error}") from error
    if _local(root.tag) != "svg":
        raise ValueError("this is no SVG")
    kept = _copy(root, prefix)
    box = (root.get("viewBox") or f"0 0 {_length(root, 'width')} {_length(root, 'height')}").split()
    kept.set("viewBox", " ".join(box))
    kept.set("width", box[2])
    kept.set("height", box[3])
    kept.set("stroke-linejoin", "round")  # what a style sheet of the drawing's own would say of the whole page
    kept.set("role", "img")
    kept.set("aria-label", title)
    return ElementTree.tostring(kept, encoding="unicode")


def _copy(element: ElementTree.Element, prefix: str) -> ElementTree.Element:
    """Return a copy with what is allowed, free of namespaces, which HTML does not need."""
    copy = ElementTree.Element(_local(element.tag), dict(_attributes(element, prefix)))
    copy.text, copy.tail = element.text, element.tail
    for child in element:
        if isinstance(child.tag, str) and _local(child.tag) in _ELEMENTS:
            copy.append(_copy(child, prefix))
    return copy


def _attributes(element: ElementTree.Element, prefix: str) -> Iterator[tuple[str, str]]:
    for name, value in element.attrib.items():
        local = _local(name)
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
