"""The log of iterations as a resume needs it: read as far as it is whole, and cut behind a checkpoint."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from wheelleg_exp.run.files import for_people


@dataclass(frozen=True)
class LogLine:
    """One line of ``iterations.jsonl``: its content, and the position in the file at which it ends."""

    content: Mapping[str, Any]
    end: int


def whole_lines(path: Path) -> list[LogLine]:
    """Return the lines up to the first that is cut off, damaged or out of order; the i-th tells of iteration i.

    Raises:
        RunDirectoryError: the file cannot be read.
    """
    if not path.exists():
        return []
    with for_people(path, "read"):
        data = path.read_bytes()
    lines: list[LogLine] = []
    end = 0
    for raw in data.splitlines(keepends=True):
        content = _parsed(raw)
        if content is None or content["iteration"] != len(lines):
            break
        end += len(raw)
        lines.append(LogLine(content, end))
    return lines


def _parsed(raw: bytes) -> dict[str, Any] | None:
    """Return a whole line's content; a line without its end was cut off while it was written."""
    if not raw.endswith(b"\n"):
        return None
    try:
        content = json.loads(raw)
    except ValueError:
        return None
    known = isinstance(content, dict) and {"iteration", "digests", "scalars"} <= content.keys()
    return content if known else None


def cut(path: Path, size: int) -> None:
    """Drop what stands in a file past ``size`` bytes, on the disk as well."""
    if not path.exists():
        return
    with for_people(path):
        os.truncate(path, size)
    sync(path)


def sync(path: Path) -> None:
    """Bring a file's content to the disk, so that it outlives a power cut."""
    if not path.exists():
        return
    with for_people(path):
        descriptor = os.open(path, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
