"""Copy, compare, and convert tensors and plain values: what a checkpoint can contain."""

from __future__ import annotations

import itertools
import random
import struct
from collections import deque
from collections.abc import Mapping
from typing import Any, Protocol, TypeGuard, TypeVar, cast, runtime_checkable

import numpy as np
import torch

PLAIN = (bool, int, float, str, type(None))
T = TypeVar("T")
Array = np.ndarray[Any, np.dtype[Any]]


class NamedStream(torch.Generator):
    """A random generator whose state ``Streams`` saves, so that the terms that draw from it do not save it."""


@runtime_checkable
class Saving(Protocol):
    """An object that saves and restores its own state, such as a network, an optimiser, or a ``Stateful``."""

    def state_dict(self) -> Mapping[str, object]:
        """Return the state as tensors, plain values, and containers of these."""

    def load_state_dict(self, saved: Mapping[str, object], /) -> object:
        """Restore what ``state_dict`` returned."""


class Unsaveable(Exception):
    """A value that a checkpoint cannot contain, such as a function or an open file."""

    def __init__(self, value: object) -> None:
        kind = type(value)
        name = kind.__name__ if kind.__module__ == "builtins" else f"{kind.__module__}.{kind.__name__}"
        super().__init__(f"a value of the type {name}")


Generator = torch.Generator | random.Random | np.random.Generator


def is_saving(value: object) -> TypeGuard[Saving]:
    """Return whether a value is an object with ``state_dict`` and ``load_state_dict``."""
    return isinstance(value, Saving) and not isinstance(value, type)


def encoded(value: object) -> object:
    """Return a copy of a value that a checkpoint can contain; raise Unsaveable for other values.

    A generator becomes its state, an object with ``state_dict`` becomes this dictionary, an array becomes a tensor, and
    a set or deque becomes a list.
    """
    if type(value) in PLAIN:
        return value
    if isinstance(value, torch.Tensor) and value.layout == torch.strided:
        return value.detach().clone()
    if isinstance(value, np.generic):
        return encoded(value.item())
    if isinstance(value, np.ndarray):
        return torch.from_numpy(value.copy())
    if isinstance(value, Generator) and not isinstance(value, NamedStream):
        if isinstance(value, torch.Generator):
            return value.get_state()
        return value.getstate() if isinstance(value, random.Random) else dict(value.bit_generator.state)
    if isinstance(value, dict):
        return {encoded(key): encoded(item) for key, item in value.items()}
    if isinstance(value, (set, frozenset)):
        return [encoded(item) for item in sorted(value, key=repr)]  # The order of a set differs between processes.
    if type(value) in (list, tuple, deque):
        items = [encoded(item) for item in cast("list[object]", value)]
        return tuple(items) if isinstance(value, tuple) else items
    if is_saving(value):
        return encoded(dict(value.state_dict()))
    raise Unsaveable(value)


def snapshot(value: object) -> object:
    """Return ``encoded(value)``, or the value itself if a checkpoint cannot contain it."""
    try:
        return encoded(value)
    except Unsaveable:
        return value


def restored(saved: Any, present: object) -> Any:
    """Return the value from which ``encoded`` made ``saved``; write it into the object ``present`` if it fits there."""
    if isinstance(present, torch.Generator):
        present.set_state(saved.cpu())
    elif isinstance(present, random.Random):
        present.setstate(saved)
    elif isinstance(present, np.random.Generator):
        present.bit_generator.state = saved
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
        return _into_tensor(saved, present)
    elif isinstance(saved, dict):
        own = present if isinstance(present, dict) else {}
        items = {key: restored(item, own.get(key)) for key, item in saved.items()}
        own.clear()
        own.update(items)
        return own
    elif isinstance(saved, (list, tuple)):
        old = list(present) if isinstance(present, (list, tuple, deque)) else []
        values = [restored(item, own) for item, own in itertools.zip_longest(saved, old[: len(saved)])]
        if isinstance(present, (list, deque)):
            present.clear()
            present.extend(values)
            return present
        return type(present)(values) if isinstance(present, (set, frozenset)) else type(saved)(values)
    else:
        return saved
    return present


def _into_tensor(saved: torch.Tensor, present: object) -> torch.Tensor:
    alike = isinstance(present, torch.Tensor) and (present.shape, present.dtype) == (saved.shape, saved.dtype)
    if not isinstance(present, torch.Tensor) or not alike or (0 in present.stride() and present.numel() > 1):
        return saved.clone()  # torch cannot write to expanded tensors.
    with torch.inference_mode() if present.is_inference() else torch.no_grad():
        return present.copy_(saved)


def same(a: object, b: object) -> bool:
    """Return whether two encoded values are bit-identical: a NaN equals its copy, and 0.0 differs from -0.0."""
    if type(a) is not type(b):
        return False
    if isinstance(a, torch.Tensor) and isinstance(b, torch.Tensor):
        alike = (a.dtype, a.shape, a.device) == (b.dtype, b.shape, b.device)
        return alike and torch.equal(bytes_of(a), bytes_of(b))
    if isinstance(a, dict) and isinstance(b, dict):
        return a.keys() == b.keys() and all(same(a[key], b[key]) for key in a)
    if isinstance(a, (list, tuple)) and isinstance(b, (list, tuple)):
        return len(a) == len(b) and all(same(x, y) for x, y in zip(a, b, strict=True))
    if isinstance(a, float):
        return struct.pack("d", a) == struct.pack("d", b)
    return bool(a == b)


def bytes_of(value: torch.Tensor) -> torch.Tensor:
    """Return the bytes of a tensor's elements in order; a contiguous tensor is not copied."""
    flat = value.detach().resolve_conj().resolve_neg().contiguous().reshape(-1)
    if flat.stride(0) != 1:  # ``contiguous`` leaves the stride of a one-element tensor unchanged.
        flat = flat.clone(memory_format=torch.contiguous_format)
    return flat.view(torch.uint8)


def cloned(tree: T, device: torch.device | None = None) -> T:
    """Copy nested mappings, lists, and tuples, including all tensors in them, and move the tensors to a device."""
    found: object = tree
    if isinstance(tree, torch.Tensor):
        found = tree.detach().clone() if device is None else tree.detach().to(device)
    elif isinstance(tree, Mapping):
        found = {key: cloned(value, device) for key, value in tree.items()}
    elif isinstance(tree, (list, tuple)):
        found = type(tree)(cloned(value, device) for value in tree)
    return cast(T, found)


def host_copy(tensor: torch.Tensor) -> Array:
    """Return a copy of a tensor in host memory, which later simulation steps do not change."""
    return cast(Array, tensor.detach().cpu().numpy().copy())
