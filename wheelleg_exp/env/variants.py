"""Recordings of a part of the step, and what there has to be when one is repeated."""

from __future__ import annotations

import operator
from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence, Sized
from dataclasses import dataclass, field
from typing import Any

import torch

from wheelleg_exp.env.recorders import Recorder
from wheelleg_exp.env.slots import Slot, entry_of, is_plain

_MOST_VARIANTS = 8
_OFTEN, _MOST_WAITING = 3, 64  # runs that depend on the same, until that is recorded; those that are counted
_MOST_DOUBLINGS = 8  # of that number, one when a recording had to make room


@dataclass
class Memory:
    """What the parts of one step share, so that they need not copy from one to the other, nor look twice.

    Plain values that no part changes are settings: somebody else may change one between two parts, so all are looked
    at before each, or, where others tell when they have done something, only then.

    Attributes:
        is_told: whether others tell, by ``is_seen``, when they have done something.
        rebound: slots that some part lets hold another tensor.
        statics: the memory of their own that these have, by slot.
        moving: slots with plain values that parts change: what a recording begins with, it looks at by itself.
        is_seen: whether nobody has done anything since settings were looked at.
        version: how often settings were found to be others.
        grown: how often there were more of them, or fewer, in a container.
    """

    is_told: bool = False
    rebound: set[tuple[int, Any]] = field(default_factory=set)
    statics: dict[tuple[int, Any], torch.Tensor] = field(default_factory=dict)
    moving: set[tuple[int, Any]] = field(default_factory=set)
    is_seen: bool = False
    version: int = 0
    grown: int = 0
    _sized: dict[int, tuple[Sized, int]] = field(default_factory=dict)
    _settings: dict[tuple[int, Any], Slot] = field(default_factory=dict)
    _kept: Places | None = None

    def let_move(self, names: Collection[tuple[int, Any]]) -> None:
        """Take note of slots that a part has changed."""
        self.moving |= set(names)
        if self._settings.keys() & self.moving:
            self._settings = {name: slot for name, slot in self._settings.items() if name not in self.moving}
            self._kept = None

    def settings_of(self, plain: Mapping[tuple[int, Any], Slot]) -> None:
        """Take those of some slots for settings that no part changes."""
        new = {name: slot for name, slot in plain.items() if name not in self.moving and name not in self._settings}
        if new:
            self._settings |= new
            self._kept = None

    def watch(self, containers: Iterable[Sized]) -> None:
        """Look at how many entries some containers have, too."""
        self._sized |= {id(one): (one, len(one)) for one in containers}

    def look(self) -> None:
        """Note whether a setting is another than it was."""
        if self.is_told and self.is_seen and self._kept is not None:
            return
        if any([len(one) != count for one, count in self._sized.values()]):
            self.watch([one for one, _ in self._sized.values()])
            self.version += 1
            self.grown += 1
        if self._kept is None or not self._kept.hold():
            self.grown += self._kept is not None and self._kept.has_other_containers()
            self._kept = places_of(self._settings.values())
            self.version += 1
        self.is_seen = True


class Places:
    """Containers and keys in them, and what was there.

    Args:
        places: containers and keys in them.
    """

    def __init__(self, places: Sequence[tuple[Any, Any]]) -> None:
        self._places = list(places)
        self._values = [container[key] for container, key in places]

    def hold(self) -> bool:
        """Return whether the same things are there, or equal ones; one tensor is as good as another."""
        try:
            now = [container[key] for container, key in self._places]
        except LookupError:
            return False
        return all(map(operator.is_, now, self._values)) or all(map(_is_alike, now, self._values))

    def has_other_containers(self) -> bool:
        """Return whether a dictionary or a list is another one, or is not there."""
        held = zip(self._places, self._values, strict=True)
        return any(
            isinstance(was, (dict, list)) and entry_of(container, key, None) is not was
            for (container, key), was in held
        )


def places_of(slots: Iterable[Slot]) -> Places | None:
    """Return where slots are, their containers among them; None when one is not there."""
    found: dict[tuple[int, Any], tuple[Any, Any]] = {}
    for slot in slots:
        container: Any = vars(slot.holder)
        for key in slot.way:
            if entry_of(container, key, slot) is slot:
                return None
            found[id(container), key] = container, key
            container = container[key]
    return Places(list(found.values()))


@dataclass
class Variant:
    """One recording, and what the host does beside it: tensors that slots must hold before, and all they hold after.

    ``shared`` are those of ``before``, by id, in memory that other slots see as well.
    """

    recorder: Recorder
    before: list[tuple[Slot, torch.Tensor]]
    shared: set[int]
    after: list[tuple[Slot, Any]]
    contents: list[tuple[Slot, dict[Any, Any]]]
    outputs: Any


class Variants:
    """Recordings of a part by what they depend on. That which was not used for longest makes room.

    Attributes:
        missed: how much more often what there was had no recording than it had one.
    """

    def __init__(self) -> None:
        self._known: dict[tuple[Any, ...], Variant] = {}  # the last is the one that was used last
        self._waiting: dict[tuple[Any, ...], int] = {}
        self._evicted = 0
        self.missed = 0

    def __len__(self) -> int:
        return len(self._known)

    @property
    def last(self) -> tuple[Any, ...]:
        """What the recording depends on that was used last."""
        return next(reversed(self._known))

    def get(self, key: tuple[Any, ...]) -> Variant | None:
        """Return the recording that depends on this, if there is one."""
        return self._known.get(key)

    def use(self, key: tuple[Any, ...], variant: Variant) -> None:
        """Take note of a recording that is about to be repeated."""
        self._known.pop(key, None)
        if len(self._known) >= _MOST_VARIANTS:
            del self._known[next(iter(self._known))]
            self._evicted += 1
        self._known[key] = variant
        self.missed -= self.missed > 0

    def is_worth(self, key: tuple[Any, ...]) -> bool:
        """Return whether to record what depends on this: at first, and when it has come up often."""
        if not self._known:
            return True
        self.missed += 1
        count = self._waiting.pop(key, 0) + 1
        if count >= _OFTEN << min(self._evicted, _MOST_DOUBLINGS):  # else more than there is room for would take turns
            return True
        if len(self._waiting) >= _MOST_WAITING:
            del self._waiting[next(iter(self._waiting))]
        self._waiting[key] = count
        return False

    def clear(self) -> None:
        """Forget all."""
        self._known.clear()
        self._waiting.clear()


@dataclass
class Entry:
    """What there was when a recording was entered: as long as it is that, nothing else has to be looked at.

    Attributes:
        version: of the settings.
        places: where plain values are that a recording depends on, and containers.
        leaves: containers and the keys in them, of tensors that a recording reads or writes, and its memory for them.
        variant: the recording.
    """

    version: int
    places: Places
    leaves: list[tuple[Any, Any, torch.Tensor]]
    variant: Variant

    def enter(self, version: int) -> bool:
        """Bring what is there into the recording's memory; return whether the very same things are there."""
        if version != self.version or not self.places.hold():
            return False
        try:
            found = [container[key] for container, key, _ in self.leaves]
        except LookupError:
            return False
        others = [(leaf, now) for leaf, now in zip(self.leaves, found, strict=True) if now is not leaf[2]]
        if not all(is_like(now, leaf[2]) and id(leaf[2]) not in self.variant.shared for leaf, now in others):
            return False
        bring([(static, now) for (_, _, static), now in others])
        for (container, key, static), _ in others:
            container[key] = static
        return True


def bring(pairs: Sequence[tuple[torch.Tensor, torch.Tensor]]) -> None:
    """Copy values into the memory that recordings have for them, though one may lie in that of another."""
    taken = {static.untyped_storage().data_ptr() for static, _ in pairs}
    apart = [(static, v.clone() if v.untyped_storage().data_ptr() in taken else v) for static, v in pairs]
    for static, value in apart:
        static.copy_(value)


def shared_of(before: Sequence[tuple[Slot, torch.Tensor]]) -> set[int]:
    """Return the tensors, by id, that are seen through more than one slot: no other numbers may be brought there."""
    counts = Counter(static.untyped_storage().data_ptr() for _, static in before)
    return {id(static) for _, static in before if counts[static.untyped_storage().data_ptr()] > 1}


def _is_alike(now: Any, was: Any) -> bool:
    """Return whether a recording holds for one as for the other: equal plain values, or tensors, which leaves tell."""
    if now is was or (isinstance(now, torch.Tensor) and isinstance(was, torch.Tensor)):
        return True
    return type(now) is type(was) and is_plain(now) and bool(now == was)


def is_like(value: Any, static: torch.Tensor) -> bool:
    """Return whether a value can be brought into a recording's memory."""
    return isinstance(value, torch.Tensor) and form_of(value) == form_of(static)


def form_of(value: torch.Tensor) -> tuple[Any, ...]:
    """Return what has to be alike in a tensor that takes another's place."""
    return value.shape, value.dtype, value.device
