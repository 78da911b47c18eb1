"""Short names for prims: the leaf of the path, with parents in front only where two would clash."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable

RESERVED = frozenset({"world"})  # MuJoCo's own body


def unique_names(paths: Iterable[str], shown: dict[str, str] | None = None) -> dict[str, str]:
    """Return a name for each path: as few of its last parts, joined by ``_``, as tell all of them apart.

    Args:
        paths: prim paths, each once.
        shown: names to prefer over the leaf, where the leaf is an encoded form of them.
    """
    shown = shown or {}
    depth = {path: 1 for path in paths}
    while True:
        names = {path: _name(path, n, shown) for path, n in depth.items()}
        count = Counter(names.values())
        clashing = [path for path, name in names.items() if name in RESERVED or count[name] > 1]
        growable = [p for p in clashing if depth[p] < len(_parts(p))]
        if not growable:
            return _numbered(names)
        for path in growable:
            depth[path] += 1


def _parts(path: str) -> list[str]:
    return path.strip("/").split("/")


def _name(path: str, depth: int, shown: dict[str, str]) -> str:
    parts = _parts(path)
    return "_".join([*parts[-depth:-1], shown.get(path, parts[-1])])


def _numbered(names: dict[str, str]) -> dict[str, str]:
    taken: set[str] = set(RESERVED)
    out = {}
    for path, name in names.items():
        candidate, number = name, 2
        while candidate in taken:
            candidate, number = f"{name}_{number}", number + 1
        taken.add(candidate)
        out[path] = candidate
    return out
