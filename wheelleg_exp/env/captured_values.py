"""Find the attribute values that the methods of an environment's step read and write.

``graph_capture`` replays a CUDA graph only if the attributes have the same numbers, texts, and tensor shapes as during
the recording. A *slot* is a place that holds a value: an attribute, or an entry of a dictionary or list in an attribute
(see ``state.object_graph``).
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
_MOST_KNOWN = 64  # numbered combinations of settings


class Values:
    """The attributes of an environment and its managers that CUDA graphs of the environment's step read or write.

    A number or text that a captured method changes (a *flag*) is read before each replay of a CUDA graph. A number or
    text that no captured method changes (a *setting*) can change only in Python code, and is read only after such code.

    Attributes:
        is_checked: whether no code that may change settings has run since the settings were last compared.
        generation: how often the method ``add_flags`` has found a new flag.
        rebound: the ids of attributes to which a captured method assigns another tensor.
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
        """Yield the environment and all objects below it, except event terms whose mode is not ``reset``."""

        def children(name: str, node: Any) -> Iterator[tuple[str, Any]]:
            return iter(()) if _runs_outside(node) else parts(name, node)

        return (node for _, node in walk([("env", self._root)], children) if not _runs_outside(node))

    def slots(self) -> Iterator[Slot]:
        """Yield all attributes of ``objects()``, and all entries of dictionaries and lists in these attributes."""
        return (slot for node in self.objects() for slot in slots(node))

    def key(self) -> Key:
        """Return the key of a CUDA graph: a number for the values of all settings, and the values of all flags."""
        if not self.is_checked:
            self._check()
            self.is_checked = True
        return self._number, tuple([kind_of(get()) for get in self._readers])

    def add_flags(self, found: Sequence[Slot]) -> bool:
        """Include the attributes ``found`` in the keys of CUDA graphs; return whether the keys lacked one of them."""
        new = {slot.id: slot for slot in found if slot.id not in self._flags}
        if new:
            self._flags |= new
            self._readers = [slot.reader() for slot in self._flags.values()]
            self.generation += 1
            self.is_checked, self._places = False, []
        return bool(new)

    def difference(self, before: Key, now: Key) -> str:
        """Return the name of an attribute that has different values in the CUDA graph keys ``before`` and ``now``."""
        (old, old_flags), (new, new_flags) = before, now
        known = {number: settings for settings, number in self._known.items()}
        pairs = [*zip(self._settings, known.get(old, ()), known.get(new, ()), strict=False)]
        pairs += zip(self._flags.values(), old_flags, new_flags, strict=False)
        return next((str(slot) for slot, was, value in pairs if was != value), "the set of attributes")

    def _check(self) -> None:
        """Check whether a setting has changed; set ``_number``, which identifies the combination of setting values.

        Most calls find no change and must be fast, so ``_check`` compares identities of the attributes' objects first.
        ``_check`` searches for new attributes only if a dictionary or list was replaced or changed its size.
        """
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
        changed = zip(before, now, strict=True) if self._present is before else ()
        if any(_is_container(was) and was is not value for was, value in changed):
            self._find_settings()
            now = self._present
        self._present = now
        settings = tuple([kind_of(value) for value in now if not _is_container(value)])
        self._number = self._known.pop(settings, next(self._numbers))
        # Re-insert the used entry at the end of ``_known``, so that the first entry is the least recently used one.
        self._known[settings] = self._number
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
                # Record dictionaries and lists too, so that ``_check`` detects when code replaces a dictionary or list.
                places |= {(id(parent), key): (parent, key) for parent, key, _ in slot.containers}
        self._places = list(places.values())
        self._present = [container[key] for container, key in self._places]
        terms = [(node, own) for node, own in found if isinstance(node, (Term, TermBase))]
        sized: list[Any] = [vars(node) for node, _ in terms]
        sized += [value for _, own in terms for slot in own if isinstance(value := slot.get(), (dict, list))]
        self._sizes = [(one, len(one)) for one in sized]

    def move_rebound(self, found: Sequence[Slot]) -> None:
        """Replace newly assigned tensors by static tensors with the same values, which all CUDA graphs share."""
        moved = []
        # Tensors made in inference mode cannot be written in place outside of inference mode.
        with torch.inference_mode(False), torch.no_grad():
            for slot in (slot for slot in found if slot.id in self.rebound):
                value, static = slot.get(), self._statics.get(slot.id)
                if not isinstance(value, torch.Tensor):
                    continue
                if static is None or form_of(static) != form_of(value):
                    static = self._statics[slot.id] = value.detach().clone()
                    slot.set(static)
                elif static is not value:
                    moved.append((slot, static, value))
            copy_tensors([(static, value) for _, static, value in moved])
            for slot, static, _ in moved:
                slot.set(static)

    def undeclared(self) -> Iterator[tuple[tuple[int, str], tuple[str, Any]]]:
        """Yield copies of the manager terms' attributes; in the copies, tensors, numbers, and texts are None."""
        for term in self.objects():
            if isinstance(term, TermBase):
                for name, value in list(vars(term).items()):
                    yield (id(term), name), (f"'{name}' of {type(term).__name__}", _undeclared_in(value))

    def undeclared_changes(self, before: Mapping[Any, Any]) -> Iterator[str]:
        """Yield the names of manager terms' attributes that have changed since ``undeclared`` returned ``before``."""
        for key, (name, now) in self.undeclared():
            if key in before and not same(now, before[key][1]):
                yield name


class TouchedMemory(TorchDispatchMode):
    """Records the memory addresses of all tensors that torch operations read or write."""

    def __init__(self) -> None:
        super().__init__()
        self._memory: set[int] = set()

    def __torch_dispatch__(self, operation: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        del types
        result = operation(*args, **(kwargs or {}))
        self.note((args, kwargs, result))
        return result

    def note(self, tree: Any) -> None:
        """Record the memory addresses of all tensors in a nested structure."""
        leaves = (leaf for leaf in tree_leaves(tree) if isinstance(leaf, torch.Tensor))
        # Record the address of each tensor's storage, because all views of a tensor share its storage.
        self._memory |= {leaf.untyped_storage().data_ptr() for leaf in leaves}

    def has(self, tensor: torch.Tensor) -> bool:
        """Return whether a torch operation has read or written the memory of a tensor."""
        return tensor.untyped_storage().data_ptr() in self._memory


def write_back(tensors: Sequence[tuple[Slot, torch.Tensor]]) -> None:
    """Copy newly assigned tensors into their attributes' old tensors, and assign the old tensors again.

    Each replay of a CUDA graph reads and writes the same memory, so attributes must keep their tensors.
    """
    moved = [(slot, static, now) for slot, static in tensors if (now := slot.get()) is not static and fits(now, static)]
    copy_tensors([(static, now) for _, static, now in moved])
    for slot, static, _ in moved:
        slot.set(static)


def copy_tensors(pairs: Sequence[tuple[torch.Tensor, torch.Tensor]]) -> None:
    """Copy the second tensor of each pair into the pair's first tensor.

    First clone source tensors that share memory with a target, because a copy could overwrite them.
    """
    targets = {static.untyped_storage().data_ptr() for static, _ in pairs}
    copies = [(static, v.clone() if v.untyped_storage().data_ptr() in targets else v) for static, v in pairs]
    for static, value in copies:
        static.copy_(value)


def _is_container(value: Any) -> bool:
    return isinstance(value, (dict, list))


def _runs_outside(node: Any) -> bool:
    """Return whether an object is an event term with another mode than ``reset``; no CUDA graph runs such terms."""
    return isinstance(node, Term) and node.fields.get("mode", "reset") != "reset"


def _undeclared_in(value: Any) -> Any:
    """Copy a value, but replace tensors, numbers, texts, and objects of this package by None."""
    if isinstance(value, torch.Tensor) or is_plain(value) or is_own(type(value)):
        return None
    if isinstance(value, (dict, list)):
        found = [_undeclared_in(item) for item in (value.values() if isinstance(value, dict) else value)]
        return [len(found), *found] if isinstance(value, list) else found
    try:
        return snapshot(value, "")
    except (Unsaveable, RecursionError):
        return id(value)


def form_of(value: Any) -> Any:
    """Return the shape, dtype, and device of a tensor; return a value of another type unchanged."""
    return (value.shape, value.dtype, value.device) if isinstance(value, torch.Tensor) else value


def fits(value: Any, static: torch.Tensor) -> bool:
    """Return whether a value is a tensor with the shape, dtype, and device of the tensor ``static``."""
    return isinstance(value, torch.Tensor) and form_of(value) == form_of(static)


class _Identity:
    """A dictionary key that compares objects by identity, and keeps its object alive, so that the id stays unique."""

    def __init__(self, value: Any) -> None:
        self.value = value

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Identity) and self.value is other.value

    def __hash__(self) -> int:
        return id(self.value)


def kind_of(value: Any) -> Any:
    """Return what a CUDA graph depends on in a value: type and plain value, tuple identity, or tensor form."""
    kind = type(value)
    if kind in PLAIN:
        return kind, value
    if isinstance(value, torch.Tensor):
        return form_of(value)
    if is_plain(value):
        return kind, value
    return _Identity(value) if kind is tuple else kind


def is_changed(was: Any, now: Any) -> bool:
    """Return whether an attribute's value has changed; replacing a tensor does not count as a change."""
    if now is was or (isinstance(was, torch.Tensor) and isinstance(now, torch.Tensor)):
        return False
    return not isinstance(was, (dict, list)) and kind_of(was) != kind_of(now)


def has_other_entries(now: Any, was: dict[Any, Any]) -> bool:
    """Return whether the keys or the value objects of a dictionary differ from those of its earlier copy ``was``."""
    return isinstance(now, dict) and (now.keys() != was.keys() or any(now[key] is not was[key] for key in was))


def frozen(tree: Any) -> Any:
    """Copy the containers of a nested structure, but not its tensors: recorded work may change the originals."""
    if isinstance(tree, dict):
        return {key: frozen(value) for key, value in tree.items()}
    return type(tree)(frozen(value) for value in tree) if isinstance(tree, (list, tuple)) else tree
