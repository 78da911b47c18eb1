"""A small XML tree that prints the same bytes for the same content."""

from __future__ import annotations

from collections.abc import Iterable
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

    def add(self, tag: str, **attributes: Value) -> Element:
        """Append a child and return it; a trailing underscore of an attribute's name is dropped."""
        child = Element(tag, {key.rstrip("_"): value for key, value in attributes.items()})
        self.children.append(child)
        return child

    def text(self, depth: int = 0) -> str:
        """Return the element as indented lines."""
        pad = "  " * depth
        head = "".join(f" {key}={quoteattr(value_text(v))}" for key, v in self.attributes.items() if v is not None)
        lines = [_comment(self.comment, pad)] if self.comment else []
        if not self.children:
            return "\n".join([*lines, f"{pad}<{self.tag}{head}/>"])
        inner = [child.text(depth + 1) for child in self.children]
        return "\n".join([*lines, f"{pad}<{self.tag}{head}>", *inner, f"{pad}</{self.tag}>"])


def _comment(text: str, pad: str) -> str:
    safe = text.replace("--", "- -")
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
    if value == int(value) and abs(value) < 1e15:
        return str(int(value))
    return repr(value)
