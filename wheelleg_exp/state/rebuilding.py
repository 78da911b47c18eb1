"""Looked-at values on their way into a checkpoint, and made again from one."""

from __future__ import annotations

from collections import deque
from typing import Any

import numpy as np
import torch

from wheelleg_exp.state.values import CONTAINERS, GENERATORS, NOTHING, TAG, Reference, Unsaveable, same

_KINDS = {name: kind for kind, name in CONTAINERS.items()}


def writable(item: Any, before: Any, path: str) -> Any:
    """Return a looked-at value as a checkpoint takes it.

    Args:
        item: the value now.
        before: what stood there when its owner was made, into which it will be written.
        path: where it stands.

    Raises:
        Unsaveable: a reference was bound or changed since, or an object that only its owner could make again.
    """
    if isinstance(item, Reference):
        raise Unsaveable(path, item.value, "which came or changed since its owner was made")
    if not isinstance(item, dict):
        return item
    tag = item[TAG]
    alike = isinstance(before, dict) and before.get(TAG) == tag
    if tag == "stateful" or tag in GENERATORS:
        if not alike:
            raise Unsaveable(path, NOTHING, f"a {tag}, which came since its owner was made")
        _require_untouched(item.get("rest"), before.get("rest"), path)
        return {TAG: tag, "data": item["data"] if tag != "stateful" else writable(item["data"], before["data"], path)}
    if "items" not in item:
        return item
    there = before["items"] if alike and same(item.get("keys"), before.get("keys")) else []
    there = [*there, *([NOTHING] * (len(item["items"]) - len(there)))]
    items = [writable(part, there[i], f"{path}[{i}]") for i, part in enumerate(item["items"])]
    return {**item, "items": items}


def _require_untouched(now: Reference | None, before: Reference | None, path: str) -> None:
    now_seen, was_seen = (getattr(side, "seen", None) or {} for side in (now, before))
    for name in {**now_seen, **was_seen}:
        if not same(now_seen.get(name, NOTHING), was_seen.get(name, NOTHING)):
            raise Unsaveable(f"{path}.{name}", NOTHING, "which its network's state_dict leaves out; register a buffer")


def made_again(item: Any, present: Any = None) -> Any:
    """Return the value that a looked-at item stands for, written over ``present`` where that can be written."""
    if isinstance(item, torch.Tensor):
        return _tensor_again(item, present)
    if isinstance(item, Reference):
        return item.value
    if not isinstance(item, dict):
        return item
    tag: str = item[TAG]
    data: Any = item.get("data")
    if tag == "array":
        return _array_again(data, present)
    if tag == "scalar":
        return data.cpu().numpy()[()]
    if tag == "stateful":
        present.load_state_dict(made_again(data))
        return present
    if tag in GENERATORS:
        GENERATORS[tag][2](present, made_again(data))
        return present
    return _container_again(tag, item, present)


def _tensor_again(item: torch.Tensor, present: Any) -> torch.Tensor:
    if not isinstance(present, torch.Tensor) or (present.shape, present.dtype) != (item.shape, item.dtype):
        return item.clone()
    if 0 in present.stride() and present.numel() > 1:  # expanded: it cannot be written
        return item.clone()
    with torch.inference_mode() if present.is_inference() else torch.no_grad():
        return present.copy_(item)


def _array_again(item: torch.Tensor, present: Any) -> np.ndarray:
    array = item.cpu().numpy()
    fits = isinstance(present, np.ndarray) and (present.shape, present.dtype) == (array.shape, array.dtype)
    if not fits or not present.flags.writeable:
        return array.copy()
    np.copyto(present, array)
    return present


def _container_again(tag: str, item: dict[str, Any], present: Any) -> Any:
    alike = type(present) is _KINDS[tag]
    if tag == "dict":
        keys = [made_again(key) for key in item["keys"]]
        there = [present.get(key) if alike else None for key in keys]
    else:
        there = list(present)[: len(item["items"])] if alike and tag not in ("set", "frozenset") else []
        there += [None] * (len(item["items"]) - len(there))
    items = [made_again(part, at) for part, at in zip(item["items"], there, strict=True)]
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
