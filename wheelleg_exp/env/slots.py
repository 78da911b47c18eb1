"""Where objects hold tensors and values: what a part of the step reads, and what Python changes in it."""

from __future__ import annotations

import functools
from collections.abc import Iterator, Sequence
from types import FunctionType, MethodType
from typing import Any

import torch

from wheelleg_exp.managers.term import Term

PLAIN = (bool, int, float, str, type(None))
_OWN = ("wheelleg_exp.", "functools")
# Classes and attributes that stand still, or are no state of this part of the step.
_FIXED = frozenset(
    """Cfg GroupLayout Reference RobotLayout RobotOptions SimOptions TensorForm Captured CapturedStep CapturedReset
    Asked Memory TermState Graphs cfg options spec model asked extras
    common_step_counter _captured _captured_look _captured_reset _captured_commands _captured_memory""".split()  # noqa: SIM905
)
_OF_A_TERM = frozenset(("name", "path", "target", "generator", "_made_with", "_has_worked"))  # stand still too


class Slot:
    """A place that holds a value, by the way to it: an attribute, perhaps of entries of dictionaries and lists in it.

    Args:
        holder: the object.
        way: the attribute's name, then keys.
    """

    def __init__(self, holder: Any, way: tuple[Any, ...]) -> None:
        self.holder, self.way = holder, way
        self.name = (id(holder), *way)

    def up(self) -> Slot:
        """Return the place that holds what holds it."""
        return Slot(self.holder, self.way[:-1])

    def around(self) -> Any:
        """Return what holds it directly; itself when that is not there."""
        found = vars(self.holder)
        for key in self.way[:-1]:
            found = entry_of(found, key, self)
            if not isinstance(found, (dict, list)):
                return self
        return found

    def get(self) -> Any:
        """Return what it holds; itself when it is not there."""
        around = self.around()
        return self if around is self else entry_of(around, self.way[-1], self)

    def set(self, value: Any) -> None:
        """Let it hold a value; itself takes it away."""
        around, key = self.around(), self.way[-1]
        if around is self:
            return
        if value is self:
            if isinstance(around, dict):
                around.pop(key, None)
        elif isinstance(around, dict) or key < len(around):
            around[key] = value


def entry_of(container: Any, key: Any, otherwise: Any) -> Any:
    """Return what a dictionary or a list holds at a key; something else when it is not there."""
    if isinstance(container, dict):
        return container.get(key, otherwise)
    if isinstance(container, list):
        return container[key] if key < len(container) else otherwise
    return otherwise


def slots(roots: Sequence[Any]) -> Iterator[Slot]:
    """Yield every place below some objects that holds a tensor, a plain value or a dictionary."""
    seen: set[int] = set()
    waiting = list(roots)
    while waiting:
        node = waiting.pop()
        if id(node) in seen:
            continue
        seen.add(id(node))
        if isinstance(node, functools.partial):
            waiting += [node.func, *node.args, *node.keywords.values()]
        elif isinstance(node, (tuple, set, frozenset, list)):
            waiting += list(node)
        elif isinstance(node, dict):
            waiting += list(node.values())
        elif isinstance(node, MethodType):
            waiting.append(node.__self__)
        elif isinstance(node, FunctionType):
            waiting += [cell.cell_contents for cell in node.__closure__ or ()]
        elif _is_own(type(node)) and not _is_fixed(type(node)):
            fixed = _FIXED | _OF_A_TERM if isinstance(node, Term) else _FIXED
            for key in list(getattr(node, "__dict__", {})):
                if key not in fixed:
                    yield from _places(node, (key,), vars(node)[key], waiting)


def _is_fixed(kind: type) -> bool:
    """Return whether a class is one of this program's that stand still."""
    return kind.__name__ in _FIXED and kind.__module__.startswith(_OWN)


def _is_own(kind: type) -> bool:
    """Return whether a class is this program's, or a user's that derives from one."""
    return any(base.__module__.startswith(_OWN) for base in kind.__mro__)


def _places(holder: Any, way: tuple[Any, ...], value: Any, waiting: list[Any]) -> Iterator[Slot]:
    if isinstance(value, torch.Tensor) or type(value) in PLAIN:
        yield Slot(holder, way)
    elif isinstance(value, (dict, list)):
        yield Slot(holder, way)
        entries = value.items() if isinstance(value, dict) else enumerate(value)
        for key, entry in list(entries):
            yield from _places(holder, (*way, key), entry, waiting)
    else:
        waiting.append(value)
