"""Copy, compare, and convert tensors and plain values: what a checkpoint can contain."""

from __future__ import annotations

import itertools
import random
from collections import deque, namedtuple
from numbers import Number
from typing import Any, TypeGuard, TypeVar, cast

import numpy as np
import torch
from torch.utils._pytree import tree_map_only

PLAIN = (bool, int, float, str, type(None))
SCALARS = (*PLAIN, Number, np.generic)
T = TypeVar("T")
Array = np.ndarray[Any, np.dtype[Any]]
# The type and the content of a value that a checkpoint cannot contain.
Seen = namedtuple("Seen", ("kind", "content"))


class NamedStream(torch.Generator):
    """A random generator whose state ``Streams`` saves, so that the terms that draw from it do not save it."""


class Unsaveable(Exception):
    """A value that a checkpoint cannot contain, such as a function or an open file."""

    def __init__(self, value: object) -> None:
        kind = value.kind if isinstance(value, Seen) else type(value)
        super().__init__(f"a value of the type {kind.__module__}.{kind.__name__}".replace("builtins.", ""))


def is_saving(value: object) -> TypeGuard[Any]:
    """Return whether an object has ``state_dict`` and ``load_state_dict``, such as a network or a ``Stateful``."""
    return hasattr(type(value), "state_dict") and hasattr(type(value), "load_state_dict")


def is_own(kind: object) -> bool:
    """Return whether a class or function is defined in this package, and not by the user."""
    return str(getattr(kind, "__module__", "")).partition(".")[0] == __name__.partition(".")[0]


def encoded(value: object) -> object:
    """Return a copy of a value that a checkpoint can contain; raise Unsaveable for other values.

    A generator becomes its state, an object with ``state_dict`` becomes this dictionary, an array becomes a tensor, and
    a deque becomes a list.
    """
    if type(value) in PLAIN:
        return value
    if isinstance(value, torch.Tensor) and value.layout == torch.strided:
        return value.detach().clone()
    if isinstance(value, np.generic):
        return encoded(value.item())
    if isinstance(value, np.ndarray) and value.dtype.kind in "biufc":
        return torch.from_numpy(value.copy())
    if isinstance(value, torch.Generator) and not isinstance(value, NamedStream):
        return value.get_state()
    if isinstance(value, dict) and all(type(key) in PLAIN or isinstance(key, (tuple, np.generic)) for key in value):
        return {encoded(key): encoded(item) for key, item in value.items()}
    if type(value) in (list, tuple, deque):
        items = [encoded(item) for item in cast("list[object]", value)]
        return tuple(items) if isinstance(value, tuple) else items
    if is_saving(value):
        return encoded(dict(value.state_dict()))
    raise Unsaveable(value)


def snapshot(value: object) -> object:
    """Return a copy that shows later changes of a value; functions and most other objects are returned uncopied."""
    try:
        return encoded(value)
    except Unsaveable:
        if isinstance(value, dict):
            return {key: snapshot(item) for key, item in value.items()}
        if isinstance(value, (list, tuple, deque)):
            return [*map(snapshot, value)]
        if isinstance(value, (set, frozenset)):
            return Seen(type(value), frozenset(value))
        if isinstance(value, np.random.Generator):
            return Seen(type(value), snapshot(value.bit_generator.state))
        if isinstance(value, np.ndarray):
            return Seen(type(value), value.tolist())
        return Seen(type(value), value.getstate()) if type(value) is random.Random else value


def restored(saved: Any, present: Any) -> Any:
    """Return the value from which ``encoded`` made ``saved``; write it into the object ``present`` if it fits there."""
    if isinstance(saved, Seen):
        raise Unsaveable(saved)
    if isinstance(present, torch.Generator):
        present.set_state(saved.cpu())
    elif is_saving(present):
        present.load_state_dict(saved)
    elif isinstance(present, np.ndarray) and isinstance(saved, torch.Tensor):
        array = saved.cpu().numpy()
        if (present.shape, present.dtype) != (array.shape, array.dtype) or not present.flags.writeable:
            return array.copy()
        np.copyto(present, array)
    elif isinstance(present, np.generic) and type(saved) in PLAIN:
        return type(present)(saved)
    elif isinstance(saved, torch.Tensor):
        alike = isinstance(present, torch.Tensor) and (present.shape, present.dtype) == (saved.shape, saved.dtype)
        if not alike or (0 in present.stride() and present.numel() > 1):
            return saved.clone()  # torch cannot write to expanded tensors.
        with torch.inference_mode() if present.is_inference() else torch.no_grad():
            present.copy_(saved)
    elif isinstance(saved, dict):
        own = present if isinstance(present, dict) else {}
        items = {key: restored(item, own.get(key)) for key, item in saved.items()}
        own.clear()
        own.update(items)
        return own
    elif isinstance(saved, (list, tuple)):
        old = list(present)[: len(saved)] if isinstance(present, (list, tuple, deque)) else []
        values = [restored(item, own) for item, own in itertools.zip_longest(saved, old)]
        if not isinstance(present, (list, deque)):
            return type(saved)(values)
        present.clear()
        present.extend(values)
    else:
        return saved
    return present


def same(a: object, b: object) -> bool:
    """Return whether two encoded values are equal: a NaN equals its copy, and 0.0 differs from -0.0."""
    if a is b or type(a) is not type(b):
        return a is b
    if isinstance(a, torch.Tensor) and isinstance(b, torch.Tensor):
        alike = (a.dtype, a.shape, a.device, a.layout) == (b.dtype, b.shape, b.device, torch.strided)
        return alike and torch.equal(bytes_of(a), bytes_of(b))
    if isinstance(a, dict) and isinstance(b, dict):
        return a.keys() == b.keys() and all(same(a[key], b[key]) for key in a)
    if isinstance(a, (list, tuple)) and isinstance(b, (list, tuple)):
        return len(a) == len(b) and all(same(x, y) for x, y in zip(a, b, strict=True))
    if isinstance(a, float):
        return a.hex() == cast(float, b).hex()
    return bool(a == b)


def bytes_of(value: torch.Tensor) -> torch.Tensor:
    """Return the bytes of a tensor's elements in order; a contiguous tensor is not copied."""
    flat = value.detach().resolve_conj().resolve_neg().contiguous().reshape(-1)
    if flat.stride(0) != 1:  # ``contiguous`` leaves the stride of a one-element tensor unchanged.
        flat = flat.clone(memory_format=torch.contiguous_format)
    return flat.view(torch.uint8)


def cloned(tree: T, device: torch.device | None = None) -> T:
    """Copy nested containers of Python's own types, and all tensors in them, and move the tensors to a device."""
    copied = torch.Tensor.clone if device is None else lambda tensor: tensor.to(device)
    return cast(T, tree_map_only(torch.Tensor, lambda tensor: copied(tensor.detach()), tree))


def host_copy(tensor: torch.Tensor) -> Array:
    """Return a copy of a tensor in host memory, which later simulation steps do not change."""
    return cast(Array, tensor.detach().cpu().numpy().copy())
