"""Whether a plain value that was read back has the shape that its readers rely on."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Maybe:
    """A kind of value that may be missing or null."""

    kind: Any


def misfits(value: Any, kind: Any, path: str = "") -> Iterator[str]:
    """Yield the keys at or below ``path`` whose values are not of their kind.

    Args:
        value: a plain value.
        kind: a type; ``[kind]`` for a list; ``{str: kind}`` for a mapping with any keys, else the kinds by key. Keys of
            which nothing is said may hold anything.
        path: the key of the value.
    """
    if isinstance(kind, Maybe):
        if value is not None:
            yield from misfits(value, kind.kind, path)
    elif isinstance(kind, list) and isinstance(value, list):
        for index, item in enumerate(value):
            yield from misfits(item, kind[0], f"{path}[{index}]")
    elif isinstance(kind, dict) and isinstance(value, dict):
        kinds = dict.fromkeys(value, kind[str]) if str in kind else kind
        for key, inner in kinds.items():
            yield from misfits(value.get(key), inner, f"{path}.{key}" if path else str(key))
    elif not isinstance(kind, type) or not _is_a(value, kind):
        yield path


def _is_a(value: Any, kind: type) -> bool:
    return kind is bool if isinstance(value, bool) else isinstance(value, kind)
