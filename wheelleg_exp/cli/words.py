"""Values and their places, as text and as JSON."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from wheelleg_exp.config.provenance import Source


def shown(value: Any) -> str:
    """Return a value as YAML would have it, on one line."""
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(shown(item) for item in value) + "]"
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{key}: {shown(item)}" for key, item in value.items()) + "}"
    return str(value)


def source_document(source: Source) -> dict[str, Any]:
    """Return one writer of a leaf as JSON has it."""
    return {
        "path": source.path,
        "value": source.value,
        "where": source.where,
        "file": None if source.file is None else str(source.file),
        "line": source.line,
        "override": source.override,
    }
