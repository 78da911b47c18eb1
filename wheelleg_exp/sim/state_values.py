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
from collections import OrderedDict, deque
from collections.abc import Iterator, Mapping
from functools import cache, partial
from pathlib import PurePath
from typing import Any

import numpy as np
import torch

BASE = "_state_when_made"
NODES = "_bound_when_made"
BOUND = "__bound__"
TAG = "__kind__"
PLAIN = (bool, int, float, str, type(None))
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

    def __init__(self, path: str, value: Any, why: str = "") -> None:
        kind = type(value).__name__ if type(value).__module__ == "builtins" else _full_name(type(value))
        super().__init__(f"keeps a {kind} in '{path}'" + (f" ({why})" if why else ""))


def _full_name(kind: type) -> str:
    return f"{kind.__module__}.{kind.__name__}"


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
        if name not in (BASE, NODES):
            yield name, item
    for kind in type(value).__mro__:
        for name in _slot_names(kind):
            if hasattr(value, name):
                yield name, getattr(value, name)


@cache
def _slot_names(kind: type) -> list[str]:
    """Return the names of a class's own slots, as its objects have them."""
    slots = vars(kind).get("__slots__", ())
    names = [
        name for name in ((slots,) if isinstance(slots, str) else slots) if name not in ("__dict__", "__weakref__")
    ]
    private = [name.startswith("__") and not name.endswith("__") for name in names]
    owner = kind.__name__.lstrip("_")
    return [f"_{owner}{name}" if mangled else name for name, mangled in zip(names, private, strict=True)]


def look(value: Any, path: str) -> Any:
    """Return a copy of a value in tensors, numbers and tagged dictionaries."""
    if type(value) in PLAIN:
        return value
    if isinstance(value, torch.Tensor):
        return value.detach().clone()
    if isinstance(value, (np.ndarray, np.generic)):
        return _array(value, path)
    if isinstance(value, (list, tuple, set, frozenset, deque, dict)):
        _require_no_attributes(value, path)
    if isinstance(value, (list, tuple, set, frozenset, deque)):
        return _sequence(value, path)
    if isinstance(value, Mapping) and isinstance(value, dict):
        return _mapping(value, path)
    if isinstance(value, partial):
        look([value.args, value.keywords], path)  # raises for what nobody could see
    if isinstance(value, CONSTANTS):
        return Constant(value)
    return _object(value, path)


def _require_no_attributes(value: Any, path: str) -> None:
    """Refuse attributes of a container of its own class, which are not among its items."""
    for name, _ in slots_of(value) if type(value) is not OrderedDict else ():  # torch notes versions on these
        raise Unsaveable(path, value, f"with an attribute '{name}' beside its items")


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
    if is_elsewhere(value) or id(value) in _in_progress:
        return Constant(value)
    if isinstance(value, torch.Generator):
        return {TAG: "generator", "data": value.get_state()}
    if isinstance(value, random.Random):
        return {TAG: "python random", "data": look(value.getstate(), path)}
    if isinstance(value, np.random.Generator):
        return {TAG: "numpy random", "data": look(value.bit_generator.state, path)}
    if _saves_itself(value):
        _in_progress.add(id(value))
        try:
            return {TAG: "stateful", "data": look(value.state_dict(), path)}
        finally:
            _in_progress.discard(id(value))
    if is_attributes_alone(value):
        try:
            return attributes(value)
        except Unsaveable as error:
            raise Unsaveable(path, value) from error
    raise Unsaveable(path, value)


def is_elsewhere(value: Any) -> bool:
    """Return whether somebody else saves an object, or it belongs to the simulation or the config."""
    return isinstance(value, Kept) or type(value).__module__.split(".")[0] in _FOREIGN


def is_attributes_alone(value: Any) -> bool:
    """Return whether an object is nothing but its attributes: one that is larger by a word holds something of C's."""
    kind = type(value)
    word = struct.calcsize("P")
    slots = sum(len(_slot_names(k)) for k in kind.__mro__)
    # An offset above zero: room for the dictionary, or for weak references, within the object.
    slots += (kind.__dictoffset__ > 0) + (kind.__weakrefoffset__ > 0)
    known = isinstance(value, (torch.Generator, random.Random, np.random.Generator)) or _saves_itself(value)
    return not known and kind.__itemsize__ == 0 and kind.__basicsize__ == object.__basicsize__ + slots * word


def _saves_itself(value: Any) -> bool:
    return hasattr(value, "state_dict") and hasattr(value, "load_state_dict")


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
    if isinstance(a, float):
        return struct.pack("d", a) == struct.pack("d", b)
    return bool(a == b)


def _equal_bytes(a: torch.Tensor, b: torch.Tensor) -> bool:
    """NaN is equal to itself alone, and 0.0 is not -0.0."""
    return a.device == b.device and torch.equal(_bytes_of(a), _bytes_of(b))


def _bytes_of(value: torch.Tensor) -> torch.Tensor:
    return value.detach().resolve_conj().resolve_neg().contiguous().reshape(-1).view(torch.uint8)


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
