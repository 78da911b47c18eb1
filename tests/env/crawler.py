"""Walk all objects that an object refers to, and list their numbers by path, without calling ``state_dict``."""

from __future__ import annotations

import random
import types
from collections import deque
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import torch

_ENDS = (type, types.FunctionType, types.BuiltinFunctionType, types.MethodType, types.ModuleType, np.dtype, torch.dtype)


class Crawl:
    def __init__(self, root: Any, skip: frozenset[str] = frozenset()) -> None:
        self.classes: set[type] = set()
        self._seen: set[int] = set()
        self._alive: list[Any] = []
        self._skip = skip
        self.leaves = dict(self._walk(root, ""))

    def _walk(self, value: Any, path: str) -> Iterator[tuple[str, Any]]:
        if value is None or isinstance(value, (bool, int, float, str, bytes, complex)):
            yield path, value
            return
        if id(value) in self._seen or isinstance(value, _ENDS) or type(value).__module__.startswith("mujoco"):
            return
        if not isinstance(value, tuple):  # Python may or may not merge equal tuples into one object.
            self._seen.add(id(value))
            self._alive.append(value)  # A new object with the id of a freed object would be skipped.
        if isinstance(value, torch.Tensor):
            yield path, value.detach().clone()
        elif isinstance(value, np.ndarray):
            yield path, torch.from_numpy(value.copy())
        elif isinstance(value, torch.Generator):
            yield path, value.get_state()
            yield from self._parts(getattr(value, "__dict__", {}), path)
        elif isinstance(value, random.Random):
            yield path, value.getstate()
        else:
            yield from self._parts(self._inside(value), path)

    def _inside(self, value: Any) -> Mapping[str, Any]:
        if isinstance(value, Mapping):
            return {f"[{key!r}]": item for key, item in value.items()}
        if isinstance(value, (list, tuple, deque)):
            return {f"[{i}]": item for i, item in enumerate(value)}
        if isinstance(value, (set, frozenset)):
            return {f"[{i}]": item for i, item in enumerate(sorted(value, key=repr))}
        self.classes.add(type(value))
        return {f".{key}": item for key, item in getattr(value, "__dict__", {}).items()}

    def _parts(self, parts: Mapping[str, Any], path: str) -> Iterator[tuple[str, Any]]:
        for name, item in parts.items():
            if not (path + name).endswith(tuple(self._skip)):
                yield from self._walk(item, path + name)


def differing(a: Crawl, b: Crawl) -> list[str]:
    """Return the paths at which the values of two walks differ."""
    paths = dict.fromkeys([*a.leaves, *b.leaves])
    return [path.lstrip(".") for path in paths if not _same(a.leaves.get(path, _NONE), b.leaves.get(path, _NONE))]


_NONE = object()


def _same(a: Any, b: Any) -> bool:
    if isinstance(a, torch.Tensor) and isinstance(b, torch.Tensor):
        return a.dtype == b.dtype and a.shape == b.shape and a.numpy().tobytes() == b.numpy().tobytes()
    return type(a) is type(b) and (a == b or a != a)
