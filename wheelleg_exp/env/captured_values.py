"""Values that the parts of an environment's step read and write: what a recording depends on and what it changes.

See ``graph_capture`` for the contract.
"""

from __future__ import annotations

import itertools
import operator
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import torch
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from wheelleg_exp.managers.manager_base import Term, TermBase
from wheelleg_exp.state.object_graph import PLAIN, Slot, is_own, is_plain, parts, slots, walk
from wheelleg_exp.state.saved_values import Unsaveable, same, snapshot

Key = tuple[Any, ...]
_MOST_KNOWN = 64  # combinations of settings


class Values:
    """The attributes below an environment that parts of its step read or write.

    Plain values that a part changes are *flags*, all others are *settings*. Flags are compared before each part. To
    compare all settings takes longer. So they are compared only when code has run that may have changed one.

    Args:
        root: the environment.

    Attributes:
        is_checked: whether nothing has run since the last comparison that may have changed a setting.
        generation: how often a new flag was found.
        rebound: slots that some part binds to another tensor.
    """

    def __init__(self, root: Any) -> None:
        self._root = root
        self.is_checked = False
        self.generation = 0
        self.rebound: set[tuple[Any, ...]] = set()
        self._statics: dict[tuple[Any, ...], torch.Tensor] = {}
        self._flags: dict[tuple[Any, ...], Slot] = {}
        self._readers: list[Callable[[], Any]] = []
        self._settings: list[Slot] = []
        self._places: list[tuple[Any, Any]] = []
        self._present: list[Any] = []
        self._sizes: list[tuple[Any, int]] = []
        self._known: dict[Key, int] = {}
        self._number, self._numbers = -1, itertools.count()

    def objects(self) -> Iterator[Any]:
        """Yield every object whose attributes a part may read or write."""

        def children(name: str, node: Any) -> Iterator[tuple[str, Any]]:
            return iter(()) if _runs_outside(node) else parts(name, node)

        return (node for _, node in walk([("env", self._root)], children) if not _runs_outside(node))

    def slots(self) -> Iterator[Slot]:
        """Yield every slot of these objects."""
        return (slot for node in self.objects() for slot in slots(node))

    def key(self) -> Key:
        """Return the present settings, as a number, and the present flags."""
        if not self.is_checked:
            self._check()
            self.is_checked = True
        return self._number, tuple([kind_of(get()) for get in self._readers])

    def add_flags(self, found: Sequence[Slot]) -> bool:
        """Treat slots as flags from now on; return whether any is new."""
        new = {slot.id: slot for slot in found if slot.id not in self._flags}
        if new:
            self._flags |= new
            self._readers = [slot.reader() for slot in self._flags.values()]
            self.generation += 1
            self.is_checked, self._places = False, []
        return bool(new)

    def difference(self, before: Key, now: Key) -> str:
        """Return the name of a setting or a flag that differs between two keys."""
        (old, old_flags), (new, new_flags) = before, now
        known = {number: settings for settings, number in self._known.items()}
        pairs = [*zip(self._settings, known.get(old, ()), known.get(new, ()), strict=False)]
        pairs += zip(self._flags.values(), old_flags, new_flags, strict=False)
        return next((str(slot) for slot, was, value in pairs if was != value), "the set of attributes")

    def _check(self) -> None:
        """Compare all settings with those of the last comparison, and number a combination that is new."""
        before = self._present
        if not self._places or any([len(one) != size for one, size in self._sizes]):
            self._find_settings()
        try:
            now = [container[key] for container, key in self._places]
        except LookupError:
            self._find_settings()
            now = self._present
        if self._present is before and all(map(operator.is_, now, before)):
            return
        if self._present is before and any(
            _is_container(was) and was is not n for was, n in zip(before, now, strict=True)
        ):
            self._find_settings()
            now = self._present
        self._present = now
        settings = tuple([kind_of(value) for value in now if not _is_container(value)])
        self._number = self._known.pop(settings, next(self._numbers))
        self._known[settings] = self._number  # last, because the combination that was not used for longest is dropped
        if len(self._known) > _MOST_KNOWN:
            del self._known[next(iter(self._known))]

    def _find_settings(self) -> None:
        found = [(node, list(slots(node))) for node in self.objects()]
        self._settings, places = [], dict[tuple[int, Any], tuple[Any, Any]]()
        for slot in (slot for _, own in found for slot in own if slot.id not in self._flags):
            value = slot.get()
            if is_plain(value) or isinstance(value, tuple):
                self._settings.append(slot)
                places[id(slot.container), slot.path[-1]] = slot.container, slot.path[-1]
                places |= {(id(parent), key): (parent, key) for parent, key, _ in slot.containers}
        self._places = list(places.values())
        self._present = [container[key] for container, key in self._places]
        terms = [(node, own) for node, own in found if isinstance(node, (Term, TermBase))]
        sized: list[Any] = [vars(node) for node, _ in terms]
        sized += [value for _, own in terms for slot in own if isinstance(value := slot.get(), (dict, list))]
        self._sizes = [(one, len(one)) for one in sized]

    def move_rebound(self, found: Sequence[Slot]) -> None:
        """Give each tensor that some part rebinds its own memory, which all recordings share."""
        moved = []
        with torch.inference_mode(False), torch.no_grad():
            for slot in found:
                value = slot.get()
                if slot.id not in self.rebound or not isinstance(value, torch.Tensor):
                    continue
                static = self._statics.get(slot.id)
                if static is None or form_of(static) != form_of(value):
                    static = self._statics[slot.id] = value.detach().clone()
                    slot.set(static)
                elif static is not value:
                    moved.append((slot, static, value))
            copy_tensors([(static, value) for _, static, value in moved])
            for slot, static, _ in moved:
                slot.set(static)

    def undeclared(self) -> Iterator[tuple[tuple[int, str], tuple[str, Any]]]:
        """Yield what terms hold that is neither a buffer nor a setting, by term and attribute."""
        for term in self.objects():
            if isinstance(term, TermBase):
                for name, value in list(vars(term).items()):
                    yield (id(term), name), (f"'{name}' of {type(term).__name__}", _undeclared_in(value))

    def undeclared_changes(self, before: Mapping[Any, Any]) -> Iterator[tuple[str, tuple[Any, Any]]]:
        """Yield what has changed since ``undeclared`` returned ``before``, by name."""
        for key, (name, now) in self.undeclared():
            if key in before and not same(now, before[key][1]):
                yield name, (before[key][1], now)


class TouchedMemory(TorchDispatchMode):
    """Notes the memory that torch's operations read and write."""

    def __init__(self) -> None:
        super().__init__()
        self._memory: set[int] = set()

    def __torch_dispatch__(self, operation: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        """Run an operation and note its tensors."""
        del types
        result = operation(*args, **(kwargs or {}))
        self.note((args, kwargs, result))
        return result

    def note(self, tree: Any) -> None:
        """Note the tensors of a nested structure."""
        self._memory |= {
            leaf.untyped_storage().data_ptr() for leaf in tree_leaves(tree) if isinstance(leaf, torch.Tensor)
        }

    def has(self, tensor: torch.Tensor) -> bool:
        """Return whether the memory of a tensor was noted."""
        return tensor.untyped_storage().data_ptr() in self._memory


def write_back(tensors: Sequence[tuple[Slot, torch.Tensor]]) -> None:
    """Copy tensors that were rebound to new memory back into the memory that the slots held before."""
    moved = [(slot, static, now) for slot, static in tensors if (now := slot.get()) is not static and fits(now, static)]
    every = {static.untyped_storage().data_ptr() for _, static in tensors}
    copies = [(static, now.clone() if now.untyped_storage().data_ptr() in every else now) for _, static, now in moved]
    for static, now in copies:
        static.copy_(now)
    for slot, static, _ in moved:
        slot.set(static)


def copy_tensors(pairs: Sequence[tuple[torch.Tensor, torch.Tensor]]) -> None:
    """Copy each second tensor into the first, also where one of the second lies in the memory of one of the first."""
    targets = {static.untyped_storage().data_ptr() for static, _ in pairs}
    copies = [(static, v.clone() if v.untyped_storage().data_ptr() in targets else v) for static, v in pairs]
    for static, value in copies:
        static.copy_(value)


def _is_container(value: Any) -> bool:
    return isinstance(value, (dict, list))


def _runs_outside(node: Any) -> bool:
    """Return whether an object is a term of an event that no part calls: parts call the events of resets only."""
    return isinstance(node, Term) and node.fields.get("mode", "reset") != "reset"


def _undeclared_in(value: Any) -> Any:
    """Return a copy of what a value holds that is neither a tensor, nor plain, nor an object of this package."""
    if isinstance(value, torch.Tensor) or is_plain(value) or is_own(type(value)):
        return None
    if isinstance(value, (dict, list)):
        items = list(value.values()) if isinstance(value, dict) else value
        found = [_undeclared_in(item) for item in items]
        return [len(found), *found] if isinstance(value, list) else found
    try:
        return snapshot(value, "")
    except (Unsaveable, RecursionError):
        return id(value)


def form_of(value: Any) -> Any:
    """Return what must be equal for a tensor to take the place of another; of other values, the value itself."""
    return (value.shape, value.dtype, value.device) if isinstance(value, torch.Tensor) else value


def fits(value: Any, static: torch.Tensor) -> bool:
    """Return whether a value is a tensor that can be copied into static memory."""
    return isinstance(value, torch.Tensor) and form_of(value) == form_of(static)


class _Identity:
    """Compares equal to the same object only, and keeps the object alive so that its id is not used again."""

    def __init__(self, value: Any) -> None:
        self.value = value

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Identity) and self.value is other.value

    def __hash__(self) -> int:
        return id(self.value)


def kind_of(value: Any) -> Any:
    """Return what a recording depends on: a plain value with its type, a tuple itself, or the form of a tensor."""
    kind = type(value)
    if kind in PLAIN:
        return kind, value
    if isinstance(value, torch.Tensor):
        return form_of(value)
    if is_plain(value):
        return kind, value
    return _Identity(value) if kind is tuple else kind


def is_changed(was: Any, now: Any) -> bool:
    """Return whether a value became another, apart from a tensor that became another tensor."""
    if now is was or (isinstance(was, torch.Tensor) and isinstance(now, torch.Tensor)):
        return False
    return not isinstance(was, (dict, list)) and kind_of(was) != kind_of(now)


def has_other_entries(now: Any, was: dict[Any, Any]) -> bool:
    """Return whether a dictionary has other keys or holds other objects than before."""
    return isinstance(now, dict) and (now.keys() != was.keys() or any(now[key] is not was[key] for key in was))


def frozen(tree: Any) -> Any:
    """Return the same tensors in new containers, because the work may change its containers later."""
    if isinstance(tree, dict):
        return {key: frozen(value) for key, value in tree.items()}
    return type(tree)(frozen(value) for value in tree) if isinstance(tree, (list, tuple)) else tree
