"""Copy, compare, and convert tensors and plain values: what a checkpoint can contain."""

from __future__ import annotations

import random
import struct
from collections import deque
from collections.abc import Callable, Mapping
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


_Generator = torch.Generator | random.Random | np.random.Generator


def is_saving(value: object) -> TypeGuard[Saving]:
    """Return whether a value is an object with ``state_dict`` and ``load_state_dict``."""
    return isinstance(value, Saving) and not isinstance(value, type)


def writes_into(value: object) -> bool:
    """Return whether ``restored`` needs the object itself: a generator, or an object that saves its own state."""
    return is_saving(value) or isinstance(value, _Generator)


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
    if isinstance(value, _Generator) and not isinstance(value, NamedStream):
        return _generator_state(value)
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


def restored(saved: Any, present: object) -> Any:
    """Return the value from which ``encoded`` made ``saved``; write it into the object ``present`` if it fits there."""
    if isinstance(present, _Generator):
        _set_generator_state(present, saved)
    elif is_saving(present):
        present.load_state_dict(saved)
    elif isinstance(present, np.ndarray) and isinstance(saved, torch.Tensor):
        return _into_array(saved.cpu().numpy(), present)
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
        return _into_sequence(saved, present)
    else:
        return saved
    return present


def _into_tensor(saved: torch.Tensor, present: object) -> torch.Tensor:
    alike = isinstance(present, torch.Tensor) and (present.shape, present.dtype) == (saved.shape, saved.dtype)
    if not isinstance(present, torch.Tensor) or not alike or (0 in present.stride() and present.numel() > 1):
        return saved.clone()  # torch cannot write to expanded tensors.
    with torch.inference_mode() if present.is_inference() else torch.no_grad():
        return present.copy_(saved)


def _into_array(saved: Array, present: Array) -> Array:
    if (present.shape, present.dtype) != (saved.shape, saved.dtype) or not present.flags.writeable:
        return saved.copy()
    np.copyto(present, saved)
    return present


def _into_sequence(saved: list[object] | tuple[object, ...], present: object) -> object:
    old = list(present) if isinstance(present, (list, tuple, deque)) else []
    old += [None] * (len(saved) - len(old))
    items = [restored(item, own) for item, own in zip(saved, old, strict=False)]
    if isinstance(present, (list, deque)):
        present.clear()
        present.extend(items)
        return present
    return type(present)(items) if isinstance(present, (set, frozenset)) else type(saved)(items)


def _generator_state(generator: _Generator) -> object:
    if isinstance(generator, torch.Generator):
        return generator.get_state()
    return generator.getstate() if isinstance(generator, random.Random) else dict(generator.bit_generator.state)


def _set_generator_state(generator: _Generator, state: Any) -> None:
    if isinstance(generator, torch.Generator):
        generator.set_state(state.cpu())
    elif isinstance(generator, random.Random):
        generator.setstate(state)
    else:
        generator.bit_generator.state = state


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


def on_device(tree: T, device: torch.device) -> T:
    """Copy nested mappings, lists, and tuples, and move all tensors in them to a device."""
    return cast(T, _converted(tree, lambda tensor: tensor.to(device)))


def cloned(tree: T) -> T:
    """Copy nested mappings, lists, and tuples, including all tensors in them."""
    return cast(T, _converted(tree, lambda tensor: tensor.detach().clone()))


def _converted(tree: object, convert: Callable[[torch.Tensor], torch.Tensor]) -> object:
    if isinstance(tree, torch.Tensor):
        return convert(tree)
    if isinstance(tree, Mapping):
        return {key: _converted(value, convert) for key, value in tree.items()}
    if isinstance(tree, (list, tuple)):
        return type(tree)(_converted(value, convert) for value in tree)
    return tree


def merged(before: object, after: object, rows: torch.Tensor) -> Any:
    """Merge two state dicts of one object: environments ``rows`` (N,) bool from ``after``, the others from ``before``.

    All values without one row per environment, such as plain numbers, come from the state dict ``after``.
    """
    if isinstance(after, Mapping) and isinstance(before, Mapping):
        return {name: merged(before.get(name), item, rows) for name, item in after.items()}
    if isinstance(after, (list, tuple)) and isinstance(before, (list, tuple)) and len(before) == len(after):
        return type(after)(merged(old, new, rows) for old, new in zip(before, after, strict=True))
    if not isinstance(after, torch.Tensor) or not isinstance(before, torch.Tensor):
        return after
    if before.shape != after.shape or after.shape[:1] != rows.shape:
        return after
    return torch.where(rows.view(-1, *[1] * (after.ndim - 1)), after, before)


def host_copy(tensor: torch.Tensor) -> Array:
    """Return a copy of a tensor in host memory, which later simulation steps do not change."""
    return cast(Array, tensor.detach().cpu().numpy().copy())
