"""What docstrings say: a target's first line, its parameters' lines, and the units in them."""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from types import ModuleType
from typing import Any

from wheelleg_exp.config.tree import yaml_node

_PACKAGE = re.compile(r"\s*#+\s*@package\b")


def comment_at(file: Path, line: int) -> str:
    """Return the comment on a line, else the one right above it at the same indentation, else nothing.

    The comment on top of a file describes the whole file: it is a key's own only where the file has no other.

    Args:
        file: the YAML file.
        line: the key's line, from 1.
    """
    lines = _lines(file, file.stat().st_mtime_ns)
    if not 1 <= line <= len(lines):
        return ""
    own = _split(lines[line - 1])[1]
    return own or _above(file, lines, line - 1)


def file_comment(file: Path) -> str:
    """Return the comment on top of a file that has a package line and so describes one section, else nothing."""
    lines = _lines(file, file.stat().st_mtime_ns)
    if not lines or not _PACKAGE.match(lines[0]):
        return ""
    found = []
    for line in lines[1:]:
        if not _is_comment(line):
            break
        found.append(_split(line)[1])
    return " ".join(text for text in found if text)


@lru_cache(maxsize=256)
def _lines(file: Path, _stamp: int) -> list[str]:
    return file.read_text(encoding="utf-8").splitlines()


def _split(text: str) -> tuple[str, str]:
    """Split a line into what YAML reads and its comment."""
    quote = ""
    for index, letter in enumerate(text):
        if quote:
            quote = "" if letter == quote else quote
        elif letter in "'\"":
            quote = letter
        elif letter == "#" and (index == 0 or text[index - 1].isspace()):
            return text[:index], text[index + 1 :].strip()
    return text, ""


def _above(file: Path, lines: list[str], index: int) -> str:
    indent = _indent(lines[index])
    found: list[str] = []
    top = index
    while top > 0 and _is_comment(lines[top - 1]) and _indent(lines[top - 1]) == indent:
        top -= 1
        found.insert(0, _split(lines[top])[1])
    if found and (top == 0) and not _single(file):
        return ""
    return " ".join(text for text in found if text and not text.startswith("@"))


def _single(file: Path) -> bool:
    root = yaml_node(file)
    return root is not None and len(root.value) == 1


def _is_comment(text: str) -> bool:
    return text.lstrip().startswith("#")


def _indent(text: str) -> int:
    return len(text) - len(text.lstrip())


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


def is_own(module: ModuleType, found: Any) -> bool:
    """Return whether something is defined in a module, or in a module of that package, and not only imported."""
    return f"{getattr(found, '__module__', None)}.".startswith(f"{module.__name__}.")
