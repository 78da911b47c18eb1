"""Which names of an object stand for one thing: two for the same list, or two tensors in one memory.

What an object was made with is written in place when its state is restored, so that whatever shares it keeps sharing
it. What was bound to another thing since is told from that by a binding, saved beside the values:

- ``{"made": path, ...}``: what was made at another path (or a view of its memory);
- ``{"new": path, ...}``: made since; all that name the same path share it;
- ``{"new": ""}``: made since, and shared with nothing.
"""

from __future__ import annotations

from collections import defaultdict, deque
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from wheelleg_exp.sim.state_values import CONSTANTS, PLAIN, Unsaveable, is_attributes_alone, is_elsewhere, slots_of

_Binding = dict[str, Any]
_CONTAINERS = (list, dict, set, deque)


class Nodes:
    """The things of an object that could be shared, by path. In slots: they are no state themselves.

    Attributes:
        by_path: tensors, arrays, containers and objects.
        key: config key of the object that holds them, for messages.
    """

    __slots__ = ("by_path", "key")

    def __init__(self, value: Any, key: str | None = None) -> None:
        self.key = key
        self.by_path: dict[str, Any] = {}
        for name, item in slots_of(value):
            self.by_path.update(_nodes(item, name, (id(value),)))


def _nodes(item: Any, path: str, above: tuple[int, ...]) -> Iterator[tuple[str, Any]]:
    if type(item) in PLAIN or isinstance(item, (np.generic, *CONSTANTS)) or id(item) in above:
        return
    inside: list[tuple[str, Any]] = []
    if isinstance(item, (list, tuple, deque)):
        inside = [(f"{path}[{i}]", part) for i, part in enumerate(item)]
    elif isinstance(item, dict):
        inside = [(f"{path}[{key!r}]", part) for key, part in item.items()]
    elif is_elsewhere(item):
        return
    elif is_attributes_alone(item):
        inside = [(f"{path}.{name}", part) for name, part in slots_of(item)]
    if not isinstance(item, (tuple, frozenset)):
        yield path, item
    for where, part in inside:
        yield from _nodes(part, where, (*above, id(item)))


# --- memory ---


@dataclass(frozen=True)
class _Memory:
    """Where the elements of a tensor or an array stand, in bytes."""

    kind: type
    dtype: Any
    start: int
    shape: tuple[int, ...]
    strides: tuple[int, ...]
    itemsize: int

    @property
    def first(self) -> int:
        return self.start + sum(min(0, (n - 1) * s) for n, s in zip(self.shape, self.strides, strict=True))

    @property
    def end(self) -> int:
        reach = sum(max(0, (n - 1) * s) for n, s in zip(self.shape, self.strides, strict=True))
        return self.start + reach + self.itemsize

    def elements(self) -> np.ndarray:
        """Return the address of every element."""
        found = np.array([self.start])
        for n, stride in zip(self.shape, self.strides, strict=True):
            if stride:
                found = (found[:, None] + np.arange(n) * stride).ravel()
        return found

    def overlaps(self, other: _Memory) -> bool:
        if self.end <= other.first or other.end <= self.first:
            return False
        if self.itemsize != other.itemsize or (self.start - other.start) % self.itemsize:
            return True
        return bool(np.isin(self.elements(), other.elements()).any())


def _memory(node: Any) -> _Memory | None:
    """Return where a tensor or an array stands; None for what is not one, or has no elements."""
    if isinstance(node, torch.Tensor) and node.numel():
        size = node.element_size()
        strides = tuple(s * size for s in node.stride())
        return _Memory(torch.Tensor, node.dtype, node.data_ptr(), tuple(node.shape), strides, size)
    if isinstance(node, np.ndarray) and node.size:
        start = node.__array_interface__["data"][0]
        return _Memory(np.ndarray, node.dtype, start, node.shape, node.strides, node.itemsize)
    return None


def writable(node: torch.Tensor | np.ndarray) -> Any:
    """Return the part of a tensor or an array that holds each of its elements once: one row of what was expanded."""
    strides = node.stride() if isinstance(node, torch.Tensor) else node.strides
    return node[tuple(slice(0, 1) if s == 0 else slice(None) for s in strides)]


def require_writable(nodes: Nodes) -> None:
    """Raise Unsaveable for a tensor whose elements overlap otherwise than by ``expand``."""
    for path, node in nodes.by_path.items():
        if isinstance(node, torch.Tensor) and node.layout != torch.strided:
            raise Unsaveable(path, node)
        memory = _memory(node)
        if memory is not None and _tangled(memory):
            raise Unsaveable(path, node, "whose elements overlap")


def _tangled(memory: _Memory) -> bool:
    sides = [(abs(s), n) for n, s in zip(memory.shape, memory.strides, strict=True) if s and n > 1]
    reach = 0
    for stride, n in sorted(sides):
        if stride <= reach:  # a sufficient test for being apart failed: count
            found = memory.elements()
            return len(np.unique(found)) != len(found)
        reach += stride * (n - 1)
    return False


# --- saving ---


def bindings(now: Nodes, made: Nodes) -> tuple[dict[str, _Binding], set[str]]:
    """Return how each path that is not bound as it was made is bound, and the paths whose binding must be saved.

    Raises:
        Unsaveable: a shared thing could not be made again so that it is shared.
    """
    strayed = {p: node for p, node in now.by_path.items() if not _as_made(node, made.by_path.get(p))}
    if not strayed:
        return {}, set()
    found: dict[str, _Binding] = {}
    arrays = {p: m for p, node in strayed.items() if (m := _memory(node)) is not None}
    shared = _shared(made)
    _bind_things({p: node for p, node in strayed.items() if p not in arrays}, now, made, shared, found)
    _bind_memory(arrays, made, found)
    forced = {p for p, b in found.items() if b != {"new": ""} or p in shared}
    return {p: b for p, b in found.items() if b != {"new": ""} or p in made.by_path}, forced


def _as_made(node: Any, made: Any) -> bool:
    return node is made or ((memory := _memory(node)) is not None and memory == _memory(made))


def _shared(made: Nodes) -> set[str]:
    """Return the paths whose thing (or memory) another path has as well."""
    paths: dict[int, list[str]] = defaultdict(list)
    for path, node in made.by_path.items():
        paths[id(node)].append(path)
    found = {p for group in paths.values() if len(group) > 1 for p in group}
    return found | {p for p, others in _touching(_memories(made)).items() if others}


def _memories(nodes: Nodes) -> dict[Any, _Memory]:
    return {p: memory for p, node in nodes.by_path.items() if (memory := _memory(node)) is not None}


def _touching(memories: dict[Any, _Memory]) -> dict[Any, list[Any]]:
    """Return, for each memory, those that it overlaps."""
    found: dict[Any, list[Any]] = {key: [] for key in memories}
    near: list[tuple[Any, _Memory]] = []
    for key, memory in sorted(memories.items(), key=lambda pair: pair[1].first):
        near = [(k, other) for k, other in near if other.end > memory.first]
        for other_key, other in near:
            if other.overlaps(memory):
                found[key].append(other_key)
                found[other_key].append(key)
        near.append((key, memory))
    return found


def _bind_things(
    strayed: dict[str, Any], now: Nodes, made: Nodes, shared: set[str], found: dict[str, _Binding]
) -> None:
    first_made = {id(node): p for p, node in reversed(made.by_path.items())}
    paths: dict[int, list[str]] = defaultdict(list)
    for p, node in now.by_path.items():
        paths[id(node)].append(p)
    for p, node in strayed.items():
        before, others = made.by_path.get(p), paths[id(node)]
        alone = id(node) not in first_made and len(others) == 1 and p not in shared
        if type(node) not in (*_CONTAINERS, torch.Tensor, np.ndarray):
            # It can be written over what was made in its place, and nowhere else.
            if not alone or type(node) is not type(before):
                raise Unsaveable(p, node, "made or moved after its owner")
        elif id(node) in first_made:
            found[p] = {"made": first_made[id(node)]}
        else:
            found[p] = {"new": others[0] if len(others) > 1 else ""}


def _bind_memory(strayed: dict[str, _Memory], made: Nodes, found: dict[str, _Binding]) -> None:
    new = {("new", p): memory for p, memory in strayed.items()}
    memories = {**{("made", p): memory for p, memory in _memories(made).items()}, **new}
    touching = _touching(memories)
    for word, p in new:
        group = {key: memories[key] for key in _connected(("new", p), touching)}
        owner = next((q for kind, q in group if kind == "made"), None)
        if len(group) == 1:
            found[p] = {"new": ""}
        elif owner is not None:
            found[p] = _view(p, strayed[p], ("made", owner), memories["made", owner].start, group)
        else:
            first, end = min(m.first for m in group.values()), max(m.end for m in group.values())
            found[p] = _view(p, strayed[p], (word, min(q for _, q in group)), first, group)
            if "shape" in found[p]:
                found[p]["length"] = (end - first) // strayed[p].itemsize


def _connected(key: Any, touching: dict[Any, list[Any]]) -> list[Any]:
    """Return all that share memory with one, or with what does."""
    found, waiting = [key], [key]
    while waiting:
        for other in touching[waiting.pop()]:
            if other not in found:
                found.append(other)
                waiting.append(other)
    return found


def _view(p: str, memory: _Memory, owner: tuple[str, str], start: int, group: dict[Any, _Memory]) -> _Binding:
    """Bind a path to a view of its owner's memory, or to the whole."""
    word, name = owner
    if all(m == memory for m in group.values()):
        return {word: name}
    if memory.kind is np.ndarray or any((m.kind, m.dtype) != (memory.kind, memory.dtype) for m in group.values()):
        names = ", ".join(dict.fromkeys(f"'{q}'" for _, q in group if q != p))
        raise Unsaveable(
            p, np.empty(0) if memory.kind is np.ndarray else torch.empty(0), f"sharing memory with {names}"
        )
    size = memory.itemsize
    geometry = {"shape": list(memory.shape), "strides": [s // size for s in memory.strides]}
    return {word: name, "offset": (memory.start - start) // size, **geometry}


# --- restoring ---


class Binder:
    """Finds what a restored value is written to: what was made, or what another path has brought."""

    def __init__(self, made: Nodes | None = None, saved: dict[str, _Binding] | None = None) -> None:
        self.made = {} if made is None else made.by_path
        self._saved = saved or {}
        self._new: dict[str, Any] = {}
        self._views: dict[str, Any] = {}

    def present(self, path: str) -> Any:
        """Return what to write a path's value to; None when it is to be made anew."""
        binding = self._saved.get(path)
        if binding is None:
            return self.made.get(path)
        if "shape" in binding:
            return self._view(binding)
        return self.made[binding["made"]] if "made" in binding else self._new.get(binding["new"])

    def bring(self, path: str, value: Any) -> Any:
        """Take what was made anew for a path, for those that share it."""
        token = self._saved.get(path, {}).get("new")
        if token:
            self._new[token] = value
        return value

    def dtype(self, path: str, dtype: torch.dtype) -> None:
        """Make the memory that new views share, once the type of its elements is known."""
        binding = self._saved.get(path, {})
        if "length" in binding and binding["new"] not in self._new:
            self._new[binding["new"]] = torch.zeros(binding["length"], dtype=dtype)

    def _view(self, binding: _Binding) -> torch.Tensor:
        owner = self.made[binding["made"]] if "made" in binding else self._new[binding["new"]]
        offset = owner.storage_offset() + binding["offset"]
        key = repr(binding)
        if key not in self._views:
            self._views[key] = owner.as_strided(binding["shape"], binding["strides"], offset)
        return self._views[key]
