"""Raise ConfigError if manager terms hold state that checkpoints cannot restore.

``Outside`` finds changes that a term makes outside its own attributes: attributes and default arguments of functions
and classes, attributes of objects of the user's classes, and values that the term writes to the scene, the managers, or
the config. Changes of other global variables and of closure variables are not detected. The class ``Memory`` finds
tensors that share memory. A checkpoint saves each attribute separately, so memory that two tensors share would become
separate after a resume.
"""

from __future__ import annotations

import enum
import inspect
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from types import CodeType
from typing import Any

import numpy as np
import torch

from wheelleg_exp.errors import ConfigError
from wheelleg_exp.state.object_graph import PACKAGE, PLAIN, walk
from wheelleg_exp.state.saved_values import NOTHING, Kept, Unsaveable, same, snapshot
from wheelleg_exp.state.stateful import Stateful, attributes


class Outside:
    """Detects that a manager term changes values outside its own attributes.

    ``code`` maps the config key of each manager term to the function or class that implements the term. ``config`` is
    the terms' config. Terms may read but not write the objects in ``owners``: they must not add attributes to them or
    to this package's objects below them, and must not change their public numbers and texts. An iterator as a class
    attribute or default argument raises ConfigError, because its position cannot be saved.
    """

    def __init__(self, code: Mapping[str, Callable[..., Any]], owners: Mapping[str, Any], config: Any) -> None:
        self._code, self._config, self._own = code, config, frozenset(owners)
        self._parts = dict(walk(owners.items(), _public_parts))
        self._before = dict(self._seen())

    def require_unchanged(self) -> None:
        """Raise ConfigError if a term has changed a value outside its own attributes; the error names this value."""
        now = dict(self._seen())
        for place in {**self._before, **now}:
            was, item = self._before.get(place, NOTHING), now.get(place, NOTHING)
            if was is not item and not same(was, item):
                key, name = place
                message = f"a term has changed {name}, but no checkpoint saves this place"
                raise ConfigError(message, key=key, expected="a class term that stores it on self")

    def _seen(self) -> Iterator[tuple[tuple[str, str], Any]]:
        for key, code in self._code.items():
            for name, item in (found for _, node in walk([("", code)], _named_parts) for found in _code_values(node)):
                if hasattr(item, "__next__"):
                    message = f"{name} is a {type(item).__name__}, whose state cannot be saved"
                    raise ConfigError(message, key=key, expected="a class term with a number on self, set in __init__")
                yield (key, name), _contents(item, name)
        for key, value in self._parts.items():
            own = key in self._own
            for name, item in vars(value).items():
                if own and isinstance(item, PLAIN) and not name.startswith("_"):
                    yield (key, f"the attribute '{name}'"), item
                elif not _is_default(value, name):
                    mark = (isinstance(item, torch.Tensor) and {**vars(item)}) or "there"
                    yield (key, f"the attribute '{name}'"), mark
        yield from _leaves(self._config, "env")


def _public_parts(name: str, owner: Any) -> Iterator[tuple[str, Any]]:
    """Yield the public attributes of ``owner`` that are objects of this package, except ``Stateful`` objects."""
    for attribute, item in vars(owner).items():
        is_ours = type(item).__module__.partition(".")[0] == PACKAGE and hasattr(item, "__dict__")
        is_public = not attribute.startswith("_") and not _is_default(owner, attribute)
        if is_ours and is_public and not isinstance(item, Stateful):
            yield f"{name}.{attribute}", item


def _is_default(value: Any, name: str) -> bool:
    """Return whether the class of ``value`` gives the attribute ``name`` a number or string as default."""
    return isinstance(getattr(type(value), name, NOTHING), PLAIN)


def _named_parts(_: str, node: Any) -> Iterator[tuple[str, Any]]:
    """Yield the functions, classes, and objects of a user-defined package that its function or class names globally."""
    package = str(getattr(node, "__module__", "")).partition(".")[0]
    members = [part for owner in node.__mro__ for part in vars(owner).values()] if inspect.isclass(node) else [node]
    for function in (inspect.unwrap(getattr(member, "__func__", member)) for member in members):
        code = [function.__code__, *function.__code__.co_consts] if inspect.isfunction(function) else []
        names = {name for part in code if isinstance(part, CodeType) for name in part.co_names}
        for name in sorted(names) if package != PACKAGE else ():
            item = function.__globals__.get(name)
            kind = item if inspect.isfunction(item) or inspect.isclass(item) else type(item)
            if str(kind.__module__).partition(".")[0] == package and not isinstance(kind, enum.EnumMeta):
                yield name, item


def _code_values(code: Any) -> Iterator[tuple[str, Any]]:
    if not inspect.isclass(code):
        function: Any = code
        while function is not None:
            owner = getattr(function, "__qualname__", type(function).__qualname__)
            parts = getattr(function, "__dict__", {})
            yield from ((f"the attribute '{name}' of '{owner}'", item) for name, item in parts.items())
            yield from _defaults(function)
            function = getattr(function, "__wrapped__", None)
        return
    for owner in code.__mro__:
        for name, item in list(vars(owner).items()):
            if hasattr(item, "__get__"):
                if name != "__init__":  # ``__init__`` copies its default arguments to attributes, which are saved.
                    yield from _defaults(getattr(item, "__func__", item))
            elif not name.startswith(("__", "_abc_")) and not isinstance(item, Kept):
                yield f"the attribute '{name}' of '{owner.__qualname__}'", item


def _defaults(function: Any) -> Iterator[tuple[str, Any]]:
    if not inspect.isfunction(function):
        return
    count, given = function.__code__.co_argcount, function.__defaults__ or ()
    names = function.__code__.co_varnames[count - len(given) : count]
    for name, item in (*zip(names, given, strict=True), *(function.__kwdefaults__ or {}).items()):
        if not isinstance(item, PLAIN):
            yield f"the default argument '{name}' of '{function.__qualname__}'", item


def _contents(item: Any, name: str) -> Any:
    try:
        return snapshot(item, name)
    except (Unsaveable, RecursionError):
        parts, seen = getattr(item, "__dict__", {}), (*PLAIN, *_MUTABLE, torch.Tensor, np.ndarray)
        return {n: _contents(part, n) if isinstance(part, seen) else "there" for n, part in parts.items()}


def _leaves(tree: Any, path: str) -> Iterator[tuple[tuple[str, str], Any]]:
    if isinstance(tree, Mapping):
        for name, item in tree.items():
            yield from _leaves(item, f"{path}.{name}")
    elif isinstance(tree, (list, tuple)):
        for index, item in enumerate(tree):
            yield from _leaves(item, f"{path}[{index}]")
    else:
        yield (path, "the config"), tree


_MUTABLE = (list, dict, set, deque)
# If ``np.shares_memory`` exceeds this work limit, tensors with overlapping address ranges count as shared memory.
_MOST_WORK = 10_000


@dataclass(frozen=True)
class _Place:
    owner: str
    name: str
    node: Any
    first: int
    end: int


class Memory:
    """Raises ConfigError if two tensors start to share memory during a run.

    Two tensors of one object must never share memory. Two tensors of different objects must share memory either during
    the whole run or never.
    """

    def __init__(self, owners: Mapping[str, Any], others: Callable[[], Mapping[str, torch.Tensor]]) -> None:
        self._owners, self._others = dict(owners), others
        self._shared = self._sharing()

    def require_apart(self) -> None:
        """Raise ConfigError if two tensors started or stopped sharing memory after the start of the run."""
        now = self._sharing()
        for owner, name, other in sorted(now ^ self._shared):
            verb = "has come to share" if (owner, name, other) in now else "no longer shares"
            raise _refusal(owner, f"'{name}' {verb} its memory with {other}")

    def _sharing(self) -> set[tuple[str, str, str]]:
        """Return all pairs that share memory: an owner, the name of its attribute, and the name of the other.

        Tensors are sorted by their first address, so that only tensors with overlapping address ranges are compared.
        """
        places = [p for owner, value in self._owners.items() for p in _places(attributes(value), owner)]
        places += [_place("", name, tensor) for name, tensor in self._others().items() if tensor.numel()]
        found, near = set(), list[_Place]()
        for place in sorted(places, key=lambda p: p.first):
            near = [other for other in near if other.end > place.first]
            for other in near:
                if (place.owner or other.owner) and _share(place.node, other.node):
                    found.add(self._pair(place, other))
            near.append(place)
        return found

    def _pair(self, a: _Place, b: _Place) -> tuple[str, str, str]:
        if a.owner == b.owner:
            raise _refusal(a.owner, f"'{a.name}' and '{b.name}' are one thing, or share memory")
        a, b = sorted((a, b), key=lambda p: (not p.owner, p.owner))
        return a.owner, a.name, f"{b.owner}.{b.name}" if b.owner else b.name


def _refusal(owner: str, message: str) -> ConfigError:
    expected = "a clone() of what belongs to others, and one name for each tensor and list"
    return ConfigError(f"{message}, which a resumed run could not make again", key=owner, expected=expected)


def _places(items: Mapping[str, Any], owner: str) -> Iterator[_Place]:
    waiting = list(items.items())
    while waiting:
        name, item = waiting.pop()
        if isinstance(item, (torch.Tensor, np.ndarray)):
            if item.size if isinstance(item, np.ndarray) else item.numel():
                yield _place(owner, name, item)
        elif type(item) in _MUTABLE:
            yield _Place(owner, name, item, id(item), id(item) + 1)
        if isinstance(item, dict):
            waiting += [(f"{name}[{key!r}]", part) for key, part in item.items()]
        elif isinstance(item, (list, tuple, deque)):
            waiting += [(f"{name}[{i}]", part) for i, part in enumerate(item)]


def _place(owner: str, name: str, node: torch.Tensor | np.ndarray) -> _Place:
    if isinstance(node, np.ndarray):
        return _Place(owner, name, node, *np.lib.array_utils.byte_bounds(node))
    reach = sum((n - 1) * stride for n, stride in zip(node.shape, node.stride(), strict=True)) + 1
    return _Place(owner, name, node, node.data_ptr(), node.data_ptr() + reach * node.element_size())


def _share(a: Any, b: Any) -> bool:
    if not isinstance(a, (torch.Tensor, np.ndarray)) or not isinstance(b, (torch.Tensor, np.ndarray)):
        return a is b
    try:
        return np.shares_memory(_array(a), _array(b), max_work=_MOST_WORK)  # type: ignore[arg-type]
    except (TypeError, RuntimeError):  # The exact check failed.
        return True


def _array(node: torch.Tensor | np.ndarray) -> np.ndarray:
    """Return a NumPy array at a tensor's memory addresses; never read the array, because the tensor can be on a GPU."""
    return node if isinstance(node, np.ndarray) else np.asarray(_Addresses(node))


class _Addresses:
    def __init__(self, node: torch.Tensor) -> None:
        size = node.element_size()
        self.__array_interface__ = {
            "version": 3,
            "typestr": f"|V{size}",
            "shape": tuple(node.shape),
            "strides": tuple(stride * size for stride in node.stride()),
            "data": (node.data_ptr(), True),
        }
