"""Tensors that lie in one memory: two names of one object, or an object and its surroundings.

Each attribute is saved and restored by itself. Two that share memory would be two afterwards, so sharing is refused
within an object, and between an object and others unless it was so from the start and still is: then what is written
in place reaches both.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from wheelleg_exp.errors import ConfigError
from wheelleg_exp.state.saved_or_refused import attributes

_MUTABLE = (list, dict, set, deque)
_MOST_WORK = 10_000  # of numpy's exact answer; beyond it, overlapping bounds are taken for sharing


@dataclass(frozen=True)
class _Place:
    """A tensor, an array or a container: whose it is, its name there, and the addresses that it spans."""

    owner: str
    name: str
    node: Any
    first: int
    end: int


class Memory:
    """Holds the memory of objects apart.

    Args:
        owners: objects that save their attributes, by config key; none of their tensors may come to lie in another's.
        others: returns the tensors of the surroundings, by name.

    Raises:
        ConfigError: two attributes of one object share memory.
    """

    def __init__(self, owners: Mapping[str, Any], others: Callable[[], Mapping[str, torch.Tensor]]) -> None:
        self._owners, self._others = dict(owners), others
        self._shared = self._sharing()

    def require_apart(self) -> None:
        """Raise ConfigError when something has come to share memory, or shares it no longer."""
        now = self._sharing()
        for owner, name, other in sorted(now ^ self._shared):
            verb = "has come to share" if (owner, name, other) in now else "no longer shares"
            raise _refusal(owner, f"'{name}' {verb} its memory with {other}")

    def _sharing(self) -> set[tuple[str, str, str]]:
        """Return who shares memory with whom: an owner, the name of its attribute, and the other's."""
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
    return ConfigError(
        f"{message}, which a resumed run could not make again",
        key=owner,
        expected="a clone() of what belongs to others, and one name for each tensor and list",
    )


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
    """Return whether two things whose spans meet have an element in common."""
    if not isinstance(a, (torch.Tensor, np.ndarray)) or not isinstance(b, (torch.Tensor, np.ndarray)):
        return a is b
    try:
        return np.shares_memory(_array(a), _array(b), max_work=_MOST_WORK)  # type: ignore[arg-type]  # numpy's stubs know two values
    except (TypeError, RuntimeError):  # no strides; too hard (an error of numpy's own)
        return True


def _array(node: torch.Tensor | np.ndarray) -> np.ndarray:
    """Return an array at the same addresses, only to ask where it lies: they may be a GPU's, and nothing is read."""
    return node if isinstance(node, np.ndarray) else np.asarray(_Addresses(node))


class _Addresses:
    """A tensor's addresses, in numpy's terms."""

    def __init__(self, node: torch.Tensor) -> None:
        size = node.element_size()
        self.__array_interface__ = {
            "version": 3,
            "typestr": f"|V{size}",
            "shape": tuple(node.shape),
            "strides": tuple(stride * size for stride in node.stride()),
            "data": (node.data_ptr(), True),
        }
