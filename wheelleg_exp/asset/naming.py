"""Short names for prims: the leaf of the path, with parents in front only where two would clash."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable

RESERVED = frozenset({"world"})  # MuJoCo's own body
DEEPEST = 8  # parts of a path that a name may have, before equal names are numbered
LONGEST_FILE = 100  # characters; file systems take 255 bytes


def unique_names(paths: Iterable[str], shown: dict[str, str] | None = None) -> dict[str, str]:
    """Return a name for each path: as few of its last parts, joined by ``_``, as tell all of them apart.

    Args:
        paths: prim paths, each once.
        shown: names to prefer over the leaf, where the leaf is an encoded form of them.
    """
    shown = shown or {}
    parts = {path: _last_parts(path) for path in paths}
    names = {path: shown.get(path, own[-1]) for path, own in parts.items()}
    for depth in range(2, DEEPEST + 1):
        count = Counter(names.values())
        clashing = [path for path, name in names.items() if count[name] > 1 or name in RESERVED]
        growable = [path for path in clashing if depth <= len(parts[path])]
        if not growable:
            break
        for path in growable:
            own = parts[path]
            names[path] = "_".join([*own[-depth:-1], shown.get(path, own[-1])])
    return numbered(names)


def _last_parts(path: str) -> list[str]:
    return path.strip("/").rsplit("/", DEEPEST)[-DEEPEST:]


def numbered(names: dict[str, str]) -> dict[str, str]:
    """Return the names with ``_2``, ``_3``, ... behind those that were taken before."""
    counter = Numbered(RESERVED)
    return {path: counter.take(name) for path, name in names.items()}


class Numbered:
    """Names given so far; one that is taken gets a number."""

    def __init__(self, taken: Iterable[str] = ()) -> None:
        self._taken = set(taken)
        self._next: dict[str, int] = {}

    def take(self, name: str) -> str:
        """Return ``name``, or ``name_2`` and so on where that is taken."""
        candidate, number = name, self._next.get(name, 2)
        while candidate in self._taken:
            candidate, number = f"{name}_{number}", number + 1
        self._next[name] = number
        self._taken.add(candidate)
        return candidate


def file_stem(name: str) -> str:
    """Return a name that any file system takes, and takes as one name whatever its case: short, without folders."""
    return re.sub(r"[^\w-]", "_", name, flags=re.ASCII)[:LONGEST_FILE].strip("_") or "mesh"
