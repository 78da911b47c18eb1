"""A small XML tree that prints the same bytes for the same content."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from xml.sax.saxutils import quoteattr

Value = str | int | float | bool | Iterable[float] | None


@dataclass
class Element:
    """A tag, its attributes (None is left away) and its children; ``comment`` stands in front of it."""

    tag: str
    attributes: dict[str, Value] = field(default_factory=dict)
    children: list[Element] = field(default_factory=list)
    comment: str = ""

    def add(self, tag: str, given: Mapping[str, Value] | None = None, **attributes: Value) -> Element:
        """Append a child and return it; a trailing underscore of a keyword is dropped, ``given`` stands last."""
        named = {key.rstrip("_"): value for key, value in attributes.items()}
        child = Element(tag, {**named, **(given or {})})
        self.children.append(child)
        return child

    def text(self) -> str:
        """Return the element as indented lines. Depth has no limit here."""
        lines: list[str] = []
        stack: list[tuple[Element | str, int]] = [(self, 0)]
        while stack:
            item, depth = stack.pop()
            pad = "  " * depth
            if isinstance(item, str):
                lines.append(f"{pad}</{item}>")
                continue
            if item.comment:
                lines.append(_comment(item.comment, pad))
            lines.append(f"{pad}<{item.tag}{item._head()}{'>' if item.children else '/>'}")
            if item.children:
                stack.append((item.tag, depth))
                stack.extend((child, depth + 1) for child in reversed(item.children))
        return "\n".join(lines)

    def depth(self) -> int:
        """Return how many elements are nested, this one included."""
        deepest, level = 0, [self]
        while level:
            deepest += 1
            level = [child for element in level for child in element.children]
        return deepest

    def _head(self) -> str:
        return "".join(f" {key}={quoteattr(value_text(v))}" for key, v in self.attributes.items() if v is not None)


def _comment(text: str, pad: str) -> str:
    safe = re.sub("-(?=-)|-$", "- ", text)  # XML has no double hyphen within a comment, and none at its end
    lines = safe.splitlines()
    if len(lines) == 1:
        return f"{pad}<!-- {safe} -->"
    return "\n".join([f"{pad}<!--", *(f"{pad}  {line}".rstrip() for line in lines), f"{pad}-->"])


def value_text(value: Value) -> str:
    """Return an attribute's text: floats shortest without loss, sequences with blanks between."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, float):
        return number(value)
    if isinstance(value, (str, int)) or value is None:
        return str(value)
    return " ".join(number(float(v)) for v in value)


def number(value: float) -> str:
    """Return the shortest text that reads back as the same number."""
    if math.isfinite(value) and abs(value) < 1e15 and value == int(value):
        return str(int(value))
    return repr(value)
