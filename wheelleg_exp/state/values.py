"""What an object may keep between steps: looked at, and compared.

State are tensors, arrays, numbers, text, random generators, plain containers of these, and objects with ``state_dict``
and ``load_state_dict`` of their own. References are functions, classes and other things that never change in place,
dataclasses as long as they do not change, and what somebody else saves (``Kept``). Anything else is ``Unsaveable``.

A looked-at value is a tree of tensors, numbers, lists and tagged dictionaries that a checkpoint takes; a reference
stands in it as a ``Reference``.
"""

from __future__ import annotations

import dataclasses
import enum
import random
import re
import struct
import types
import weakref
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import PurePath
from typing import Any

import numpy as np
import torch

TAG = "__kind__"
NOTHING = object()
_PLAIN = (bool, int, float, str, type(None))
CONTAINERS: dict[type, str] = {kind: kind.__name__ for kind in (list, tuple, dict, set, frozenset, deque)}
# Never changed in place: what is bound to the name is all there is.
_CONSTANTS = (
    bytes,
    complex,
    range,
    slice,
    type,
    enum.Enum,
    re.Pattern,
    PurePath,
    torch.dtype,
    torch.device,
    torch.Size,
    np.dtype,
    types.FunctionType,
    types.BuiltinFunctionType,
    types.ModuleType,
)
Generator = tuple[type, Callable[[Any], Any], Callable[[Any, Any], None]]
GENERATORS: dict[str, Generator] = {
    "generator": (torch.Generator, lambda g: g.get_state(), lambda g, state: g.set_state(state.cpu())),
    "python random": (random.Random, lambda g: g.getstate(), lambda g, state: g.setstate(state)),
    "numpy random": (
        np.random.Generator,
        lambda g: g.bit_generator.state,
        lambda g, state: setattr(g.bit_generator, "state", state),
    ),
}


class Kept:
    """Marks objects whose state somebody saves: what only points to one does not save it again."""


class NamedStream(Kept, torch.Generator):
    """A random stream that the environment's streams save."""


class Unsaveable(Exception):
    """Something whose state cannot be saved."""

    def __init__(self, path: str, value: Any, why: str = "") -> None:
        kind = type(value)
        name = kind.__name__ if kind.__module__ == "builtins" else f"{kind.__module__}.{kind.__name__}"
        super().__init__(f"keeps a {name} in '{path}'" + (f" ({why})" if why else ""))


@dataclasses.dataclass
class Reference:
    """Something that is not written: ``seen`` is what it held when it was looked at, as far as it could change."""

    value: Any
    seen: Any = None


# --- looking ---


def look(value: Any, path: str) -> Any:
    """Return a copy of a value in tensors, numbers, tagged dictionaries and references.

    Raises:
        Unsaveable: it is, or holds, something else.
    """
    if type(value) in _PLAIN:
        return value
    if isinstance(value, torch.Tensor):
        if value.layout != torch.strided:
            raise Unsaveable(path, value, "not strided")
        if vars(value):
            raise Unsaveable(path, value, f"with an attribute of its own, '{next(iter(vars(value)))}'")
        return value.detach().clone()
    if isinstance(value, (np.ndarray, np.generic)):
        return _array(value, path)
    if type(value) in CONTAINERS:
        return _container(value, path)
    if isinstance(value, Kept) or type(value) is object:
        return Reference(value)
    for tag, (kind, get, _) in GENERATORS.items():
        if isinstance(value, kind):
            return {TAG: tag, "data": look(get(value), path)}
    if _saves_itself(value):
        return {TAG: "stateful", "data": look(dict(value.state_dict()), path), "rest": _rest(value, path)}
    return _reference(value, path)


def _array(value: np.ndarray | np.generic, path: str) -> dict[str, Any]:
    if isinstance(value, np.ndarray) and type(value) is not np.ndarray:  # a mask or a file would be lost
        raise Unsaveable(path, value)
    try:
        tensor = torch.from_numpy(np.array(value))
    except TypeError:
        raise Unsaveable(path, value) from None
    return {TAG: "array" if isinstance(value, np.ndarray) else "scalar", "data": tensor}


def _container(value: Any, path: str) -> dict[str, Any]:
    tagged: dict[str, Any] = {TAG: CONTAINERS[type(value)]}
    if isinstance(value, dict):
        tagged["keys"] = [look(key, f"{path} (a key)") for key in value]
        return {**tagged, "items": [look(item, f"{path}[{key!r}]") for key, item in value.items()]}
    # A set's own order depends on the process.
    items = sorted(value, key=repr) if isinstance(value, (set, frozenset)) else value
    tagged["items"] = [look(item, f"{path}[{i}]") for i, item in enumerate(items)]
    return {**tagged, "maxlen": value.maxlen} if isinstance(value, deque) else tagged


def _saves_itself(value: Any) -> bool:
    return hasattr(value, "state_dict") and hasattr(value, "load_state_dict") and not isinstance(value, type)


def _rest(value: Any, path: str) -> Reference:
    """Return what a network's ``state_dict`` leaves out; whoever writes one of his own answers for it."""
    if not isinstance(value, torch.nn.Module) or isinstance(value, torch.jit.ScriptModule):
        return Reference(None)
    return Reference(None, {name: look(item, f"{path}.{name}") for name, item in _unlisted(value)})


def _unlisted(network: torch.nn.Module) -> Iterator[tuple[str, Any]]:
    """Yield a network's plain attributes and buffers that are not in its ``state_dict``."""
    own = vars(torch.nn.Module()).keys() - {"training"}
    for prefix, part in network.named_modules():
        buffers = {name: part._buffers[name] for name in part._non_persistent_buffers_set}
        plain = {name: item for name, item in vars(part).items() if name not in own and not _is_wiring(item)}
        yield from ((f"{prefix}.{name}".lstrip("."), item) for name, item in {**plain, **buffers}.items())


def _is_wiring(item: Any) -> bool:
    """Return whether an attribute only points at parameters, as recurrent networks keep them."""
    parts = item if isinstance(item, list) else [item]
    return bool(parts) and all(isinstance(part, (torch.nn.Parameter, weakref.ref, type(None))) for part in parts)


def _reference(value: Any, path: str) -> Reference:
    if isinstance(value, types.MethodType):
        return Reference(value, None if isinstance(value.__self__, type) else look(value.__self__, path))
    if isinstance(value, partial):
        return Reference(value, look([value.args, value.keywords], path))
    if isinstance(value, _CONSTANTS):
        return Reference(value)
    if dataclasses.is_dataclass(value) and hasattr(value, "__dict__"):
        return Reference(value, {name: look(item, f"{path}.{name}") for name, item in vars(value).items()})
    raise Unsaveable(path, value)


# --- comparing ---


def same(a: Any, b: Any) -> bool:
    """Return whether two looked-at trees are equal to the bit, NaN included."""
    if type(a) is not type(b):
        return False
    if isinstance(a, torch.Tensor):
        return a.dtype == b.dtype and a.shape == b.shape and _equal_bytes(a, b)
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(same(a[key], b[key]) for key in a)
    if isinstance(a, (list, tuple)):
        return len(a) == len(b) and all(same(x, y) for x, y in zip(a, b, strict=True))
    if isinstance(a, Reference):
        # A bound method is a new object each time, and equal.
        methods = isinstance(a.value, (*_CONSTANTS, types.MethodType)) and a.value == b.value
        return (a.value is b.value or methods) and same(a.seen, b.seen)
    if isinstance(a, float):
        return struct.pack("d", a) == struct.pack("d", b)
    return bool(a == b)


def _equal_bytes(a: torch.Tensor, b: torch.Tensor) -> bool:
    """NaN is equal to itself alone, and 0.0 is not -0.0."""
    return a.device == b.device and torch.equal(bytes_of(a), bytes_of(b))


def bytes_of(value: torch.Tensor) -> torch.Tensor:
    """Return the bytes of a tensor's elements in their order, without a copy where they lie so in memory."""
    flat = value.detach().resolve_conj().resolve_neg().contiguous().reshape(-1)
    if flat.stride(0) != 1:  # one element of a row: contiguous by name, and not by its stride
        flat = flat.clone(memory_format=torch.contiguous_format)
    return flat.view(torch.uint8)


def on_device(tree: Any, device: torch.device) -> Any:
    """Return mappings, lists and tuples with their tensors on a device; a file's are in the host's memory."""
    if isinstance(tree, torch.Tensor):
        return tree.to(device)
    if isinstance(tree, Mapping):
        return {key: on_device(value, device) for key, value in tree.items()}
    if isinstance(tree, (list, tuple)):
        return type(tree)(on_device(value, device) for value in tree)
    return tree


def cloned(tree: Any) -> Any:
    """Return a copy of mappings, lists and tuples of tensors that stands still."""
    if isinstance(tree, torch.Tensor):
        return tree.detach().clone()
    if isinstance(tree, Mapping):
        return {key: cloned(value) for key, value in tree.items()}
    if isinstance(tree, (list, tuple)):
        return type(tree)(cloned(value) for value in tree)
    return tree
