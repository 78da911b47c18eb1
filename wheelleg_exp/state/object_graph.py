"""Walk over an object graph: find the objects below some roots, and the slots that hold their values.

The checks for unsaved state and the capture of CUDA graphs both use this module to visit objects. The search visits
every object that a manager term, such as a reward function, can change. Objects of other packages are not visited,
because such objects can be huge or have side effects. The search visits instances of this package's classes and their
subclasses, and the containers and closures that hold these instances. A class attribute ``outside_graphs`` lists the
attributes that no captured CUDA graph reads or writes.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Iterator
from numbers import Number
from types import FunctionType, MethodType
from typing import Any

import torch

PACKAGE = __name__.partition(".")[0]
PLAIN = (bool, int, float, str, type(None))
MISSING = object()

Named = tuple[str, Any]


def walk(roots: Iterable[Named], children: Callable[[str, Any], Iterable[Named]]) -> Iterator[Named]:
    """Yield each object once with its dotted name: the roots, the ``children`` of each object, and so on."""
    waiting, seen = list(roots), set[int]()
    # Search breadth-first by appending the children of each object to the list over which the loop iterates.
    for name, node in waiting:
        if id(node) not in seen:
            seen.add(id(node))
            yield name, node
            waiting += children(name, node)


def is_own(kind: type) -> bool:
    """Return whether a class belongs to this package or derives from a class of this package."""
    return any(base.__module__.partition(".")[0] == PACKAGE for base in kind.__mro__)


def is_plain(value: Any) -> bool:
    """Return whether a value is a number, a string, None, or a tuple of numbers, strings, and None."""
    if type(value) in PLAIN or isinstance(value, Number):
        return True
    return type(value) is tuple and all(map(is_plain, value))


class Slot:
    """A place that holds a value: an attribute of an object, or an entry of a dictionary or list in an attribute.

    ``path`` is the name of an attribute, followed by the keys of nested dictionaries and lists.
    """

    def __init__(self, owner: Any, path: tuple[Any, ...]) -> None:
        self.owner, self.path = owner, path
        self.id = (id(owner), *path)

    def __str__(self) -> str:
        return f"'{'.'.join(map(str, self.path))}' of {getattr(self.owner, 'path', type(self.owner).__name__)}"

    @property
    def container(self) -> Any:
        """The dictionary or list that holds the slot's value, or ``MISSING`` if a key in ``path`` no longer exists."""
        found: Any = vars(self.owner)
        for key in self.path[:-1]:
            found = entry(found, key)
            if not isinstance(found, (dict, list)):
                return MISSING
        return found

    @property
    def containers(self) -> Iterator[tuple[Any, Any, Any]]:
        """The nested dictionaries and lists around the slot's value, as tuples (parent, key in parent, container)."""
        parent: Any = vars(self.owner)
        for key in self.path[:-1]:
            yield parent, key, entry(parent, key)
            parent = entry(parent, key)

    def get(self) -> Any:
        """Return the value of the attribute or entry at ``path``; ``MISSING`` if the entry no longer exists."""
        return entry(self.container, self.path[-1])

    def reader(self) -> Callable[[], Any]:
        """Return a function that returns the value at ``path``; for attributes, the function is faster than ``get``."""
        if len(self.path) > 1:
            return self.get
        return functools.partial(vars(self.owner).get, self.path[0], MISSING)

    def set(self, value: Any) -> None:
        """Assign a value to the attribute or entry at ``path``; the value ``MISSING`` deletes the entry."""
        container, key = self.container, self.path[-1]
        if value is MISSING and isinstance(container, dict):
            container.pop(key, None)
        elif isinstance(container, dict) or (isinstance(container, list) and key < len(container)):
            container[key] = value


def entry(container: Any, key: Any) -> Any:
    """Return the entry of a dictionary or list, or ``MISSING`` if the key does not exist."""
    if isinstance(container, dict):
        return container.get(key, MISSING)
    return container[key] if isinstance(container, list) and key < len(container) else MISSING


def parts(name: str, node: Any) -> Iterator[Named]:
    """Yield the objects that an object refers to directly, such as attributes, list elements, and closure variables."""
    if isinstance(node, functools.partial):
        found: Iterable[Any] = (node.func, *node.args, *node.keywords.values())
    elif isinstance(node, (tuple, set, frozenset, list)):
        found = node
    elif isinstance(node, dict):
        found = node.values()
    elif isinstance(node, MethodType):
        found = (node.__self__,)
    elif isinstance(node, FunctionType):
        # A closure can refer to tensors that are not attributes of any object.
        found = (cell.cell_contents for cell in node.__closure__ or ())
    else:
        yield from ((f"{name}.{key}", value) for key, value in attributes_in_graphs(node))
        return
    yield from ((name, value) for value in found if not isinstance(value, torch.Tensor) and not is_plain(value))


def attributes_in_graphs(node: Any) -> Iterator[Named]:
    """Yield an object's attributes that CUDA graphs may read or write, but nothing for an object of another package."""
    kind = type(node)
    # Skip instances of classes in the package ``state``, because they only refer to the state of other objects.
    if not is_own(kind) or kind.__module__.startswith(f"{PACKAGE}.state."):
        return
    skipped = {name for base in kind.__mro__ for name in vars(base).get("outside_graphs", ())}
    yield from ((name, value) for name, value in getattr(node, "__dict__", {}).items() if name not in skipped)


def slots(node: Any) -> Iterator[Slot]:
    """Yield the slots of one object: tensors, plain values, tuples, and dictionaries and lists of these."""
    for name, value in list(attributes_in_graphs(node)):
        yield from _slots_below(node, (name,), value)


def _slots_below(owner: Any, path: tuple[Any, ...], value: Any) -> Iterator[Slot]:
    if isinstance(value, (torch.Tensor, tuple, dict, list)) or is_plain(value):
        yield Slot(owner, path)
    if isinstance(value, (dict, list)) and not _are_names(owner, value):
        for key, item in list(value.items() if isinstance(value, dict) else enumerate(value)):
            yield from _slots_below(owner, (*path, key), item)


def _are_names(owner: Any, value: Any) -> bool:
    """Return whether a list contains only names of joints and bodies, which never change."""
    own = type(owner).__module__.partition(".")[0] == PACKAGE
    return own and isinstance(value, list) and all(type(item) is str for item in value)
