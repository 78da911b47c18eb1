"""The comments of YAML files: what people wrote beside a key or above it."""

from __future__ import annotations

import re
from functools import lru_cache
from pathlib import Path

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
