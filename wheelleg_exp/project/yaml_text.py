"""Small pieces of YAML: numbers with few digits, names that are safe as expressions, lists that fit a line."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping, Sequence

WIDTH = 110
_PLAIN = re.compile(r"[A-Za-z_][\w./-]*")
_WORDS = {"null", "true", "false", "yes", "no", "on", "off", "y", "n"}


def number(value: float, digits: int = 4) -> str:
    """Return a number with few significant digits, always readable as a float."""
    if not math.isfinite(value):
        raise ValueError(f"{value} is no number for a config")
    text = repr(float(f"{value:.{digits}g}"))
    return text if "." in text else text.replace("e", ".0e")


def expression(name: str) -> str:
    """Return the expression that matches a name and no other."""
    return name if re.fullmatch(r"[\w /:-]*", name) else re.escape(name)


def word(name: str) -> str:
    """Return text as a YAML scalar, quoted where it needs to be."""
    plain = _PLAIN.fullmatch(name) and name.lower() not in _WORDS
    return name if plain else json.dumps(name, ensure_ascii=False)


def names(values: Sequence[str], indent: int, used: int = 0) -> str:
    """Return expressions of names as a flow list; a long one stands on lines of its own.

    Args:
        values: the names.
        indent: of the lines that follow.
        used: characters that stand before the list.
    """
    items = [word(expression(value)) for value in values]
    line = "[" + ", ".join(items) + "]"
    if used + len(line) <= WIDTH:
        return line
    lines, current = [], ""
    for item in items:
        if current and indent + len(current) + len(item) + 3 > WIDTH:
            lines.append(current)
            current = ""
        current += ("" if not current else " ") + item + ","
    lines.append(current.rstrip(","))
    space = "\n" + " " * indent
    return "[" + space + space.join(lines) + "]"


def by_joint(values: Mapping[str, float], indent: int) -> str:
    """Return what follows a key's colon: a number when all joints share it, else one joint a line."""
    if len({number(value) for value in values.values()}) <= 1:
        return f" {number(next(iter(values.values()), 0.0))}"
    return mapping(values, indent)


def mapping(values: Mapping[str, float], indent: int) -> str:
    """Return what follows a key's colon: values by name on lines of their own, or an empty mapping."""
    if not values:
        return " {}"
    space = "\n" + " " * indent
    return "".join(f"{space}{word(expression(name))}: {number(value)}" for name, value in values.items())
