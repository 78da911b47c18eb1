"""Values as state: looked at, compared, and made again.

A looked-at value is a tree of tensors, numbers, lists and tagged dictionaries that a checkpoint takes; what cannot be
written but cannot change in place either stands in it as a ``Constant``.
"""

from __future__ import annotations

import enum
import random
import re
import struct
import types
from collections import OrderedDict, defaultdict, deque
from collections.abc import Iterator, Mapping
from functools import partial
from pathlib import PurePath
from typing import Any

import numpy as np
import torch

BASE = "_state_when_made"
TAG = "__kind__"
_NUMBERS = (bool, int, float, str, type(None))
# Never changed in place: what is bound to the name is all there is.
CONSTANTS = (
    bytes,
    complex,
    range,
    slice,
    type,
    enum.Enum,
    re.Pattern,
    PurePath,
    partial,
    torch.dtype,
    torch.device,
    torch.Size,
    np.dtype,
    types.FunctionType,
    types.BuiltinFunctionType,
    types.MethodType,
    types.ModuleType,
)
_FOREIGN = ("mujoco", "omegaconf", "hydra")  # packages whose objects belong to the simulation or the config
_in_progress: set[int] = set()  # objects that point at each other in a ring are saved once
NOTHING = object()


class Kept:
    """Marks objects whose state somebody saves: what only points to one does not save it again."""


class NamedStream(Kept, torch.Generator):
    """A random stream that the environment's streams save."""


class Unsaveable(Exception):
    """Something whose state cannot be saved."""

    def __init__(self, path: str, value: Any) -> None:
        super().__init__(f"keeps a {type(value).__module__}.{type(value).__name__} in '{path}'")


class Constant:
    """A value that cannot be written, but that does not change in place either."""

    def __init__(self, value: Any) -> None:
        self.value = value


class Inside(dict[str, Any]):
    """The attributes of a helper object, by name."""


class MadeLater:
    """Stands for an object that was not there when its owner was made, so that nobody could make it again."""


# --- looking ---


def attributes(value: Any) -> Inside:
    """Return what an object holds, looked at, by name."""
    _in_progress.add(id(value))
    try:
        return Inside({name: look(item, name) for name, item in slots_of(value)})
    finally:
        _in_progress.discard(id(value))


def slots_of(value: Any) -> Iterator[tuple[str, Any]]:
    """Yield an object's attributes, those in slots included."""
    for name, item in getattr(value, "__dict__", {}).items():
        if name != BASE:
            yield name, item
    for kind in type(value).__mro__:
        names = vars(kind).get("__slots__", ())
        for name in (names,) if isinstance(names, str) else names:
            if name not in ("__dict__", "__weakref__") and hasattr(value, name):
                yield name, getattr(value, name)


def look(value: Any, path: str) -> Any:
    """Return a copy of a value in tensors, numbers and tagged dictionaries."""
    if type(value) in _NUMBERS:
        return value
    if isinstance(value, torch.Tensor):
        return value.detach().clone()
    if isinstance(value, (np.ndarray, np.generic)):
        return _array(value, path)
    if isinstance(value, (list, tuple, set, frozenset, deque)):
        return _sequence(value, path)
    if isinstance(value, Mapping) and isinstance(value, dict):
        return _mapping(value, path)
    if isinstance(value, CONSTANTS):
        return Constant(value)
    return _object(value, path)


def _array(value: np.ndarray | np.generic, path: str) -> dict[str, Any]:
    try:
        tensor = torch.from_numpy(np.array(value))
    except TypeError:
        raise Unsaveable(path, value) from None
    return {TAG: "array" if isinstance(value, np.ndarray) else "scalar", "data": tensor}


def _sequence(value: Any, path: str) -> dict[str, Any]:
    items = list(value)
    if isinstance(value, (set, frozenset)):
        items = sorted(items, key=repr)  # their own order depends on the process
    looked = [look(item, f"{path}[{i}]") for i, item in enumerate(items)]
    kinds: tuple[type, ...] = (deque, frozenset, set, tuple, list)
    kind = next(k for k in kinds if isinstance(value, k))
    tagged: dict[str, Any] = {TAG: kind.__name__, "items": looked}
    return {**tagged, "maxlen": value.maxlen} if isinstance(value, deque) else tagged


def _mapping(value: dict[Any, Any], path: str) -> dict[str, Any]:
    keys = [look(key, f"{path} (a key)") for key in value]
    return {TAG: "dict", "keys": keys, "items": [look(item, f"{path}[{key!r}]") for key, item in value.items()]}


def _object(value: Any, path: str) -> Any:
    if isinstance(value, Kept) or id(value) in _in_progress or type(value).__module__.split(".")[0] in _FOREIGN:
        return Constant(value)
    if isinstance(value, torch.Generator):
        return {TAG: "generator", "data": value.get_state()}
    if isinstance(value, random.Random):
        return {TAG: "python random", "data": look(value.getstate(), path)}
    if isinstance(value, np.random.Generator):
        return {TAG: "numpy random", "data": look(value.bit_generator.state, path)}
    if hasattr(value, "state_dict") and hasattr(value, "load_state_dict"):
        _in_progress.add(id(value))
        try:
            return {TAG: "stateful", "data": look(value.state_dict(), path)}
        finally:
            _in_progress.discard(id(value))
    if _is_its_attributes(value):
        try:
            return attributes(value)
        except Unsaveable as error:
            raise Unsaveable(path, value) from error
    raise Unsaveable(path, value)


def _is_its_attributes(value: Any) -> bool:
    """Return whether an object is nothing but its attributes: one that is larger holds something of C's."""
    kind = type(value)
    slots = sum(len([s] if isinstance(s, str) else s) for s in (vars(k).get("__slots__", ()) for k in kind.__mro__))
    word = struct.calcsize("P")
    return kind.__basicsize__ <= object.__basicsize__ + (2 + slots) * word and kind.__itemsize__ == 0


# --- comparing ---


def same(a: Any, b: Any) -> bool:
    """Return whether two trees are equal to the bit, NaN included."""
    if type(a) is not type(b):
        return False
    if isinstance(a, torch.Tensor):
        return a.dtype == b.dtype and a.shape == b.shape and _equal_bytes(a, b)
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(same(a[key], b[key]) for key in a)
    if isinstance(a, (list, tuple)):
        return len(a) == len(b) and all(same(x, y) for x, y in zip(a, b, strict=True))
    if isinstance(a, Constant):
        # A bound method is a new object each time, and equal.
        return a.value is b.value or (isinstance(a.value, CONSTANTS) and a.value == b.value)
    return a == b or (a != a and b != b)


def _equal_bytes(a: torch.Tensor, b: torch.Tensor) -> bool:
    return torch.equal(a, b) or (a.is_floating_point() and torch.equal(a.nan_to_num(), b.nan_to_num()))


def require_plain(item: Any, path: str) -> None:
    """Raise Unsaveable unless a looked-at value can be written."""
    if isinstance(item, Constant):
        raise Unsaveable(path, item.value)
    if isinstance(item, Inside):
        raise Unsaveable(path, MadeLater())
    if isinstance(item, dict):
        for value in item.values():
            require_plain(value, path)
    elif isinstance(item, list):
        for value in item:
            require_plain(value, path)


# --- making again ---


def made_again(item: Any, present: Any) -> Any:
    """Return the value that a looked-at item stands for, in place of ``present`` where that can be written."""
    if isinstance(item, torch.Tensor):
        return _tensor(item, present)
    if isinstance(item, Constant):
        return item.value
    if not isinstance(item, dict):
        return item
    kind = item[TAG]
    if kind in ("array", "scalar"):
        array = item["data"].numpy()
        return array.copy() if kind == "array" else array[()]
    if kind in ("generator", "python random", "numpy random", "stateful"):
        _load_into(present, kind, item["data"])
        return present
    items = [made_again(value, None) for value in item["items"]]
    if kind == "dict":
        pairs = dict(zip([made_again(key, None) for key in item["keys"]], items, strict=True))
        return _filled(present, pairs) if isinstance(present, (dict, OrderedDict, defaultdict)) else pairs
    return _container(kind, items, present, item.get("maxlen"))


def _tensor(item: torch.Tensor, present: Any) -> torch.Tensor:
    fits = isinstance(present, torch.Tensor) and (present.shape, present.dtype) == (item.shape, item.dtype)
    if not fits or (present.is_inference() and not torch.is_inference_mode_enabled()):
        return item.clone()
    with torch.no_grad():
        present.copy_(item)
    return present


def _load_into(present: Any, kind: str, data: Any) -> None:
    if kind == "generator":
        present.set_state(data)
    elif kind == "python random":
        present.setstate(made_again(data, None))
    elif kind == "numpy random":
        present.bit_generator.state = made_again(data, None)
    else:
        present.load_state_dict(made_again(data, None))


def _filled(present: dict[Any, Any], pairs: dict[Any, Any]) -> dict[Any, Any]:
    present.clear()
    present.update(pairs)
    return present


def _container(kind: str, items: list[Any], present: Any, maxlen: int | None) -> Any:
    if kind == "tuple":
        make = getattr(type(present), "_make", tuple)  # a named tuple's own
        return make(items)
    if kind == "frozenset":
        return frozenset(items)
    if kind == "deque":
        return deque(items, maxlen)
    if kind == "set":
        return set(items)
    if isinstance(present, list):
        present[:] = items
        return present
    return items
