"""Where objects hold tensors and values: what a part of the step reads, and what Python changes in it."""

from __future__ import annotations

import functools
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from numbers import Number
from types import FunctionType, MethodType, ModuleType
from typing import Any

import torch

from wheelleg_exp.managers.manager_base import Term, TermBase

_PLAIN = (bool, int, float, str, type(None))
_OWN = ("wheelleg_exp.", "functools")
# Of an environment, what is no state of a part of its step.
_OF_AN_ENVIRONMENT = frozenset(
    """cfg asked extras observers curriculum_manager common_step_counter _captured _captured_look _captured_reset
    _captured_commands _captured_memory""".split()  # noqa: SIM905
)
# Of this program's own classes and their attributes, those that stand still.
_FIXED = _OF_AN_ENVIRONMENT | frozenset(
    """Cfg GroupLayout Reference RobotLayout RobotOptions SimOptions TensorForm Captured CapturedStep
    CapturedReset Asked Memory TermState Graphs Settings options spec model num_envs _num_envs arguments
    joint_names body_names joint_names_expr fixed_tendon_names object_collection_names preserve_order
    metric_names _bodies _per_joint _config _weights _width _widths width history_length same_as _flatten
    _same_sample _keeps_params""".split()  # noqa: SIM905
)
_STILL = (torch.Tensor, type, ModuleType, FunctionType, MethodType)
_OF_A_TERM = frozenset(("name", "path", "target", "generator", "_made_with", "_has_worked"))  # stand still too


def is_plain(value: Any) -> bool:
    """Return whether something is a number, a word, nothing, or a tuple of such."""
    if type(value) in _PLAIN or isinstance(value, Number):  # NumPy's are numbers, too
        return True
    return type(value) is tuple and all(map(is_plain, value))


@dataclass(frozen=True, eq=False)
class Itself:
    """Something that is equal to nothing but itself, and is kept, so that nothing else comes to be where it is."""

    value: Any

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Itself) and self.value is other.value

    def __hash__(self) -> int:
        return id(self.value)


class Slot:
    """A place that holds a value, by the way to it: an attribute, perhaps of entries of dictionaries and lists in it.

    Args:
        holder: the object.
        way: the attribute's name, then keys.
    """

    def __init__(self, holder: Any, way: tuple[Any, ...]) -> None:
        self.holder, self.way = holder, way
        self.name = (id(holder), *way)

    @property
    def told(self) -> str:
        """How it is named to people."""
        return f"'{'.'.join(map(str, self.way))}' of {getattr(self.holder, 'path', type(self.holder).__name__)}"

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
    """Yield every place below some objects that holds a tensor, a plain value, a dictionary or a list."""
    for _, places in _objects(roots):
        yield from places


def _objects(roots: Sequence[Any]) -> Iterator[tuple[Any, list[Slot]]]:
    """Yield this program's objects, and those that derive from them, with the places that each of them has."""
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
        elif _is_own(type(node)) and not _is_fixed(type(node)) and not _is_apart(node):
            fixed = _fixed_of(node)
            keys = [key for key in getattr(node, "__dict__", {}) if key not in fixed]
            yield node, [place for key in keys for place in _places(node, (key,), vars(node)[key], waiting)]


def _fixed_of(node: Any) -> frozenset[str]:
    """Return the attributes that stand still: of a user's class none but what every environment has."""
    if isinstance(node, Term):
        return _FIXED | _OF_A_TERM
    return _FIXED if type(node).__module__.startswith(_OWN) else _OF_AN_ENVIRONMENT


def _is_fixed(kind: type) -> bool:
    """Return whether a class is one of this program's that stand still."""
    return kind.__name__ in _FIXED and kind.__module__.startswith(_OWN)


def _is_apart(node: Any) -> bool:
    """Return whether it is an event that no recorded part runs: those at resets alone are within one."""
    return isinstance(node, Term) and node.fields.get("mode", "reset") != "reset"


def _is_own(kind: type) -> bool:
    """Return whether a class is this program's, or a user's that derives from one."""
    return any(base.__module__.startswith(_OWN) for base in kind.__mro__)


def _places(holder: Any, way: tuple[Any, ...], value: Any, waiting: list[Any]) -> Iterator[Slot]:
    if isinstance(value, (torch.Tensor, tuple)) or is_plain(value):
        yield Slot(holder, way)
        if isinstance(value, tuple):
            waiting.append(value)
    elif isinstance(value, (dict, list)):
        yield Slot(holder, way)
        entries = value.items() if isinstance(value, dict) else enumerate(value)
        for key, entry in list(entries):
            yield from _places(holder, (*way, key), entry, waiting)
    else:
        waiting.append(value)


def containers_of_terms(roots: Sequence[Any]) -> Iterator[dict[Any, Any] | list[Any]]:
    """Yield the attributes of terms, and their dictionaries and lists: what is added there is a setting too."""
    for term, places in _objects(roots):
        if isinstance(term, (Term, TermBase)):
            yield vars(term)
            yield from (value for place in places if isinstance(value := place.get(), (dict, list)))


def kept_apart(roots: Sequence[Any]) -> dict[tuple[int, str], tuple[str, Any]]:
    """Return what terms keep where ``slots`` does not look, by object and attribute: its name, and what it is.

    Lists by their length; tuples, deques, sets, modules and other objects by the tensors and plain values in them.
    """
    return {
        (id(term), name): (f"'{name}' of {type(term).__name__}", _unfollowed(value))
        for term, _ in _objects(roots)
        if isinstance(term, TermBase)
        for name, value in vars(term).items()
    }


def _unfollowed(value: Any) -> Any:
    if isinstance(value, torch.Tensor) or is_plain(value) or _is_own(type(value)):
        return None
    if isinstance(value, dict):
        return [_unfollowed(entry) for entry in value.values()]
    if isinstance(value, list):
        return [_unfollowed(entry) for entry in value]
    return _trace(value, set())


def _trace(value: Any, seen: set[int]) -> Any:
    """Return what tells whether an object holds the same tensors and plain values as before."""
    if is_plain(value):
        return value
    if isinstance(value, (tuple, list, deque, set, frozenset)):
        return [_trace(entry, seen) for entry in value]
    if isinstance(value, dict):
        return [(key, _trace(entry, seen)) for key, entry in value.items()]
    if id(value) in seen or _is_own(type(value)) or isinstance(value, _STILL):
        return Itself(value)
    seen.add(id(value))
    return [Itself(value), _trace(getattr(value, "__dict__", {}), seen)]
