"""Values made again from what was saved, written over what stands in their place where that can be written."""

from __future__ import annotations

from collections import deque
from typing import Any

import numpy as np
import torch

from wheelleg_exp.sim.state_binding import Binder, writable
from wheelleg_exp.sim.state_values import TAG, Constant, Inside, look, same

_GENERATORS = ("generator", "python random", "numpy random", "stateful")
_KINDS: dict[str, type] = {"list": list, "dict": dict, "set": set, "deque": deque}


def made_again(item: Any, path: str = "", binder: Binder | None = None) -> Any:
    """Return the value that a looked-at item stands for, written to what its binder finds for its path."""
    binder = Binder() if binder is None else binder
    if isinstance(item, torch.Tensor):
        return _tensor(item, path, binder)
    if isinstance(item, Constant):
        return item.value
    if not isinstance(item, dict):
        return item
    if isinstance(item, Inside):
        return _attributes(item, path, binder)
    kind = item[TAG]
    if kind == "array":
        return _array(item["data"], path, binder)
    if kind == "scalar":
        return item["data"].numpy()[()]
    if kind in _GENERATORS:
        present = binder.present(path)
        _load_into(present, kind, item["data"])
        return present
    return _container(kind, item, path, binder)


def _tensor(item: torch.Tensor, path: str, binder: Binder) -> torch.Tensor:
    binder.dtype(path, item.dtype)
    present = binder.present(path)
    if not isinstance(present, torch.Tensor) or (present.shape, present.dtype) != (item.shape, item.dtype):
        new: torch.Tensor = binder.bring(path, item.clone())
        return new
    with torch.inference_mode() if present.is_inference() else torch.no_grad():
        target = writable(present)
        target.copy_(item[tuple(slice(0, n) for n in target.shape)])
    return present


def _array(item: torch.Tensor, path: str, binder: Binder) -> np.ndarray:
    present, array = binder.present(path), item.numpy()
    if not isinstance(present, np.ndarray) or (present.shape, present.dtype) != (array.shape, array.dtype):
        new: np.ndarray = binder.bring(path, array.copy())
        return new
    if not same(look(present, path), look(array, path)):
        if not present.flags.writeable:
            return array.copy()
        np.copyto(writable(present), array[tuple(slice(0, n) for n in writable(present).shape)])
    return present


def _attributes(item: Inside, path: str, binder: Binder) -> Any:
    present = binder.present(path)
    for name, value in item.items():
        put(present, name, made_again(value, f"{path}.{name}", binder))
    return present


def put(owner: Any, name: str, value: Any) -> None:
    """Bind an attribute, unless it is bound to the very thing."""
    if not hasattr(owner, name) or getattr(owner, name) is not value:
        setattr(owner, name, value)


def _load_into(present: Any, kind: str, data: Any) -> None:
    if kind == "generator":
        present.set_state(data)
    elif kind == "python random":
        present.setstate(made_again(data))
    elif kind == "numpy random":
        present.bit_generator.state = made_again(data)
    else:
        present.load_state_dict(made_again(data))


def _container(kind: str, item: dict[str, Any], path: str, binder: Binder) -> Any:
    keys = [made_again(key) for key in item["keys"]] if kind == "dict" else range(len(item["items"]))
    items = [made_again(v, f"{path}[{k!r}]", binder) for k, v in zip(keys, item["items"], strict=True)]
    if kind == "frozenset":
        return frozenset(items)
    present = binder.present(path)
    if kind == "tuple":
        present = binder.made.get(path)
        return getattr(type(present), "_make", tuple)(items)  # a named tuple's own
    fits = isinstance(present, _KINDS[kind]) and getattr(present, "maxlen", None) == item.get("maxlen")
    if not fits:
        present = deque(maxlen=item.get("maxlen")) if kind == "deque" else _KINDS[kind]()
        binder.bring(path, present)
    present.clear()
    if kind == "dict":
        present.update(zip(keys, items, strict=True))
    elif kind == "set":
        present.update(items)
    else:
        present.extend(items)
    return present
