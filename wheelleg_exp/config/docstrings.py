"""What docstrings say: a target's first line, its parameters' lines, and the units in them."""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable
from typing import Any

_SECTION = re.compile(r"^(Args|Arguments|Attributes|Parameters):$")
_ENTRY = re.compile(r"^(\s*)(\*{0,2}\w+)(?: \([^)]*\))?:\s*(.*)$")

_ATOM = r"(?:rad|deg|kg|mm|m|ms|s|N|Hz|MB|GiB)"
_POWER = r"(?:[²³]|\^-?\d)?"
_PRODUCT = rf"(?:1(?=/)|{_ATOM}{_POWER}|\({_ATOM}(?:[·*/]{_ATOM})*\){_POWER})(?:[·*/]{_ATOM}{_POWER})*"
_WORDS = r"control steps?|physics steps?|iterations?|seconds|radians|megabytes"
_UNIT = rf"(?:per )?(?:{_PRODUCT}|{_WORDS})(?: per (?:{_PRODUCT}|unit of action))?"
_LIST = rf"{_UNIT}(?:, {_UNIT})*"
# What may follow a unit at the beginning of a line; "N environments" names no newtons.
_AFTER = r"of|on|between|from|above|below|beyond|at|in|to|each|that|before|after|a|per|by|in"
_FIRST = re.compile(rf"^({_LIST})(?=$|[;,.:]| (?:{_AFTER})\b)")
_LATER = re.compile(rf"(?:, |\(|: )({_UNIT})(?=$|[;,.:)])")


def unit_in(text: str) -> str | None:
    """Return the unit that a comment or a docstring line names: at its beginning, or after a comma."""
    for pattern in (_FIRST, _LATER):
        match = pattern.search(text)
        if match:
            return match.group(1)
    return None


def summary(target: Any) -> str:
    """Return the first paragraph of a docstring on one line, or nothing."""
    text = inspect.getdoc(target) or ""
    return " ".join(text.strip().split("\n\n")[0].split())


def headline(target: Any) -> str:
    """Return the first line of a docstring, or nothing."""
    text = (inspect.getdoc(target) or "").strip()
    return text.splitlines()[0] if text else ""


def parameter_lines(target: Callable[..., Any]) -> dict[str, str]:
    """Return what a docstring says of each parameter; of a class, what it and the classes above it say."""
    if not inspect.isclass(target):
        return parameters_in(inspect.getdoc(target) or "")
    found: dict[str, str] = {}
    for kind in reversed(target.__mro__[:-1]):
        for text in (kind.__dict__.get("__doc__"), getattr(kind.__dict__.get("__init__"), "__doc__", None)):
            found |= parameters_in(inspect.cleandoc(text or ""))
    return found


def parameters_in(text: str) -> dict[str, str]:
    """Return the entries of the parameter sections of a Google-style docstring."""
    found: dict[str, str] = {}
    name, inside, indent = "", False, -1
    for line in text.splitlines():
        if not line.startswith(" "):
            inside, name, indent = bool(_SECTION.match(line)) or (inside and not line.strip()), "", -1
            continue
        entry = _ENTRY.match(line)
        depth = len(line) - len(line.lstrip())
        if inside and entry and (indent < 0 or depth == indent):
            name, indent = entry.group(2).lstrip("*"), depth
            found[name] = entry.group(3)
        elif inside and name:
            found[name] = f"{found[name]} {line.strip()}".strip()
    return found
