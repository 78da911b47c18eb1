"""Convert the attributes of an object to values that a checkpoint can store; compare and restore such values.

State is: tensors, arrays, numbers, text, random generators, plain containers of these, and objects with their own
``state_dict`` and ``load_state_dict``. References are: functions, classes, and other constants; dataclasses, as long as
they do not change; and objects that another part saves (``Kept``). Every other value is ``Unsaveable``.

``snapshot`` converts a value to a tree of tensors, numbers, lists, and dictionaries, because loading a checkpoint must
not run code. ``snapshot`` replaces a value that checkpoints do not store, such as a function, by a ``Reference``.
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

from wheelleg_exp.state.object_graph import PLAIN

TAG = "__kind__"
NOTHING = object()
CONTAINERS: dict[type, str] = {kind: kind.__name__ for kind in (list, tuple, dict, set, frozenset, deque)}
# Objects of the types in `_CONSTANTS` cannot change in place, so a checkpoint need not store such objects.
_CONSTANTS = (
    *(bytes, complex, range, slice, type, enum.Enum, re.Pattern, PurePath),
    *(torch.dtype, torch.device, torch.Size, np.dtype),
    *(types.FunctionType, types.BuiltinFunctionType, types.ModuleType),
)
Generator = tuple[type, Callable[[Any], Any], Callable[[Any, Any], None]]
GENERATORS: dict[str, Generator] = {
    "generator": (torch.Generator, lambda g: g.get_state(), lambda g, state: g.set_state(state.cpu())),
    "python random": (random.Random, lambda g: g.getstate(), lambda g, state: g.setstate(state)),
    "numpy random": (
        np.random.Generator,
        lambda g: g.bit_generator.state,
        lambda g, s: setattr(g.bit_generator, "state", s),
    ),
}


class Kept:
    """Base class of objects that are not saved as attributes of other objects, because other code saves their state."""


class NamedStream(Kept, torch.Generator):
    """A random generator whose state the class ``Streams`` saves in checkpoints."""


class Unsaveable(Exception):
    """The exception ``Unsaveable`` reports a value whose state cannot be saved."""

    def __init__(self, path: str, value: Any, why: str = "") -> None:
        kind = type(value)
        name = kind.__name__ if kind.__module__ == "builtins" else f"{kind.__module__}.{kind.__name__}"
        super().__init__(f"holds a {name} in '{path}'" + (f" ({why})" if why else ""))


@dataclasses.dataclass
class Reference:
    """A value that checkpoints do not store, such as a function; ``seen`` copies contents that can change, if any."""

    value: Any
    seen: Any = None


# --- snapshots ---


def snapshot(value: Any, path: str) -> Any:
    """Copy a value to nested dictionaries of tensors, numbers, strings, and references, or raise Unsaveable."""
    if type(value) in PLAIN:
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
        tagged: dict[str, Any] = {TAG: CONTAINERS[type(value)]}
        if isinstance(value, dict):
            tagged["keys"] = [snapshot(key, f"{path} (a key)") for key in value]
            return {**tagged, "items": [snapshot(item, f"{path}[{key!r}]") for key, item in value.items()]}
        # Sort the items of a set, because their order differs between processes.
        items = sorted(value, key=repr) if isinstance(value, (set, frozenset)) else value
        tagged["items"] = [snapshot(item, f"{path}[{i}]") for i, item in enumerate(items)]
        return {**tagged, "maxlen": value.maxlen} if isinstance(value, deque) else tagged
    if isinstance(value, Kept) or type(value) is object:
        return Reference(value)
    for tag, (kind, get, _) in GENERATORS.items():
        if isinstance(value, kind):
            return {TAG: tag, "data": snapshot(get(value), path)}
    if all(hasattr(value, name) for name in ("state_dict", "load_state_dict")) and not isinstance(value, type):
        rest = None  # ``rest`` has the network's attributes that ``state_dict`` omits, such as numbers.
        if isinstance(value, torch.nn.Module) and not isinstance(value, torch.jit.ScriptModule):
            rest = {name: snapshot(item, f"{path}.{name}") for name, item in _unlisted(value)}
        data = snapshot(dict(value.state_dict()), path)
        return {TAG: "stateful", "data": data, "rest": Reference(None, rest)}
    if isinstance(value, types.MethodType):
        return Reference(value, None if isinstance(value.__self__, type) else snapshot(value.__self__, path))
    if isinstance(value, partial):
        return Reference(value, snapshot([value.args, value.keywords], path))
    if isinstance(value, _CONSTANTS):
        return Reference(value)
    if dataclasses.is_dataclass(value) and hasattr(value, "__dict__"):
        return Reference(value, {name: snapshot(item, f"{path}.{name}") for name, item in vars(value).items()})
    raise Unsaveable(path, value)


def _array(value: np.ndarray | np.generic, path: str) -> dict[str, Any]:
    # Reject subclasses of ndarray, because they can have further state, such as the mask of a masked array.
    if isinstance(value, np.ndarray) and type(value) is not np.ndarray:
        raise Unsaveable(path, value)
    try:
        tensor = torch.from_numpy(np.array(value))
    except TypeError:
        raise Unsaveable(path, value) from None
    return {TAG: "array" if isinstance(value, np.ndarray) else "scalar", "data": tensor}


def _unlisted(network: torch.nn.Module) -> Iterator[tuple[str, Any]]:
    own = vars(torch.nn.Module()).keys() - {"training"}
    for prefix, part in network.named_modules():
        buffers = {name: part._buffers[name] for name in part._non_persistent_buffers_set}
        plain = {name: item for name, item in vars(part).items() if name not in own and not _is_wiring(item)}
        yield from ((f"{prefix}.{name}".lstrip("."), item) for name, item in {**plain, **buffers}.items())


def _is_wiring(item: Any) -> bool:
    """Return whether a network's attribute contains only parameters and weak references, as in ``torch.nn.RNN``."""
    parts = item if isinstance(item, list) else [item]
    return bool(parts) and all(isinstance(part, (torch.nn.Parameter, weakref.ref, type(None))) for part in parts)


# --- comparing ---


def same(a: Any, b: Any) -> bool:
    """Return whether two saved values (trees of tensors and plain values) are bit-identical; NaN equals its copy."""
    if type(a) is not type(b):
        return False
    if isinstance(a, torch.Tensor):
        # Tensors are compared by their bytes, so that a NaN equals its copy, and 0.0 differs from -0.0.
        alike = (a.dtype, a.shape, a.device) == (b.dtype, b.shape, b.device)
        return alike and torch.equal(bytes_of(a), bytes_of(b))
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(same(a[key], b[key]) for key in a)
    if isinstance(a, (list, tuple)):
        return len(a) == len(b) and all(same(x, y) for x, y in zip(a, b, strict=True))
    if isinstance(a, Reference):
        # Bound methods are compared with ==, because each access to a bound method makes a new object.
        methods = isinstance(a.value, (*_CONSTANTS, types.MethodType)) and a.value == b.value
        return (a.value is b.value or methods) and same(a.seen, b.seen)
    if isinstance(a, float):
        return struct.pack("d", a) == struct.pack("d", b)
    return bool(a == b)


def bytes_of(value: torch.Tensor) -> torch.Tensor:
    """Return the bytes of a tensor's elements in order; a contiguous tensor is not copied."""
    flat = value.detach().resolve_conj().resolve_neg().contiguous().reshape(-1)
    if flat.stride(0) != 1:  # ``contiguous`` leaves the stride of a one-element tensor unchanged.
        flat = flat.clone(memory_format=torch.contiguous_format)
    return flat.view(torch.uint8)


def on_device(tree: Any, device: torch.device) -> Any:
    """Copy nested mappings, lists, and tuples, and move all tensors in them to a device."""
    return _converted(tree, lambda tensor: tensor.to(device))


def cloned(tree: Any) -> Any:
    """Copy nested mappings, lists, and tuples, including all tensors in them."""
    return _converted(tree, lambda tensor: tensor.detach().clone())


def _converted(tree: Any, convert: Callable[[torch.Tensor], torch.Tensor]) -> Any:
    if isinstance(tree, torch.Tensor):
        return convert(tree)
    if isinstance(tree, Mapping):
        return {key: _converted(value, convert) for key, value in tree.items()}
    if isinstance(tree, (list, tuple)):
        return type(tree)(_converted(value, convert) for value in tree)
    return tree


_KINDS = {name: kind for kind, name in CONTAINERS.items()}


def checkpoint_value(item: Any, before: Any, path: str) -> Any:
    """Convert ``item``, which the function ``snapshot`` returned, to a value that a checkpoint can store.

    ``item`` is a copy of an attribute's present value; ``before`` is a copy of its value right after the object's
    construction. Loading a checkpoint sets the attributes of a new object that was constructed from the same config.
    Raise Unsaveable if a function, random generator, or network was assigned to the attribute after the object's
    construction.
    """
    if isinstance(item, Reference):
        raise Unsaveable(path, item.value, "which was added or changed after its owner was made")
    if not isinstance(item, dict):
        return item
    tag = item[TAG]
    alike = isinstance(before, dict) and before.get(TAG) == tag
    if tag == "stateful" or tag in GENERATORS:
        if not alike:
            raise Unsaveable(path, NOTHING, f"a {tag}, which was added after its owner was made")
        now_seen, was_seen = (getattr(side.get("rest"), "seen", None) or {} for side in (item, before))
        for name in {**now_seen, **was_seen}:
            if not same(now_seen.get(name, NOTHING), was_seen.get(name, NOTHING)):
                why = "which its network's state_dict leaves out; register a buffer"
                raise Unsaveable(f"{path}.{name}", NOTHING, why)
        data = item["data"] if tag != "stateful" else checkpoint_value(item["data"], before["data"], path)
        return {TAG: tag, "data": data}
    if "items" not in item:
        return item
    there = before["items"] if alike and same(item.get("keys"), before.get("keys")) else []
    there = [*there, *([NOTHING] * (len(item["items"]) - len(there)))]
    items = [checkpoint_value(part, there[i], f"{path}[{i}]") for i, part in enumerate(item["items"])]
    return {**item, "items": items}


def restored_value(item: Any, present: Any = None) -> Any:
    """Convert a snapshot to the original value; if possible, write it to the existing object ``present`` in place."""
    if isinstance(item, torch.Tensor):
        alike = isinstance(present, torch.Tensor) and (present.shape, present.dtype) == (item.shape, item.dtype)
        if not alike or (0 in present.stride() and present.numel() > 1):  # torch cannot write to expanded tensors.
            return item.clone()
        with torch.inference_mode() if present.is_inference() else torch.no_grad():
            return present.copy_(item)
    if isinstance(item, Reference):
        return item.value
    if not isinstance(item, dict):
        return item
    tag: str = item[TAG]
    data: Any = item.get("data")
    if tag == "array":
        array = data.cpu().numpy()
        fits = isinstance(present, np.ndarray) and (present.shape, present.dtype) == (array.shape, array.dtype)
        if not fits or not present.flags.writeable:
            return array.copy()
        np.copyto(present, array)
        return present
    if tag == "scalar":
        return data.cpu().numpy()[()]
    if tag == "stateful":
        present.load_state_dict(restored_value(data))
        return present
    if tag in GENERATORS:
        GENERATORS[tag][2](present, restored_value(data))
        return present
    return _container_again(tag, item, present)


def _container_again(tag: str, item: dict[str, Any], present: Any) -> Any:
    alike = type(present) is _KINDS[tag]
    if tag == "dict":
        keys = [restored_value(key) for key in item["keys"]]
        there = [present.get(key) if alike else None for key in keys]
    else:
        there = list(present)[: len(item["items"])] if alike and tag not in ("set", "frozenset") else []
        there += [None] * (len(item["items"]) - len(there))
    items = [restored_value(part, at) for part, at in zip(item["items"], there, strict=True)]
    if tag == "dict":
        return _refilled(present if alike else {}, dict(zip(keys, items, strict=True)))
    if tag in ("tuple", "frozenset"):
        return _KINDS[tag](items)
    fits = alike and getattr(present, "maxlen", None) == item.get("maxlen")
    empty = deque(maxlen=item["maxlen"]) if tag == "deque" else _KINDS[tag]()
    return _refilled(present if fits else empty, items)


def _refilled(container: Any, items: Any) -> Any:
    container.clear()
    container.extend(items) if isinstance(container, (list, deque)) else container.update(items)
    return container
