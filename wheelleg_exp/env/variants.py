"""Recordings of a part of the step, and what there has to be when one is repeated."""

from __future__ import annotations

import operator
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import torch

from wheelleg_exp.env.recorders import Recorder
from wheelleg_exp.env.slots import Slot


@dataclass
class Memory:
    """What the parts of one step share, so that they need not copy from one to the other.

    Attributes:
        rebound: slots that some part lets hold another tensor.
        statics: the memory of their own that these have, by slot.
    """

    rebound: set[tuple[int, Any]] = field(default_factory=set)
    statics: dict[tuple[int, Any], torch.Tensor] = field(default_factory=dict)


@dataclass
class Variant:
    """One recording, and what the host does beside it: tensors that slots must hold before, and all they hold after.

    ``shared`` are those of ``before``, by id, in memory that other slots see as well.
    """

    recorder: Recorder
    before: list[tuple[Slot, torch.Tensor]]
    shared: set[int]
    empty: list[Slot]
    after: list[tuple[Slot, Any]]
    contents: list[tuple[Slot, dict[Any, Any]]]
    outputs: Any


@dataclass
class Entry:
    """What there was when a recording was entered: as long as it is that, nothing else has to be looked at.

    Attributes:
        places: containers and the keys in them, of plain values that a recording depends on, and of the containers.
        values: what was there.
        leaves: containers and the keys in them, of tensors that a recording reads or writes, and its memory for them.
        variant: the recording.
    """

    places: list[tuple[Any, Any]]
    values: list[Any]
    leaves: list[tuple[Any, Any, torch.Tensor]]
    variant: Variant

    def enter(self) -> bool:
        """Bring what is there into the recording's memory; return whether the very same things are there."""
        try:
            now = [container[key] for container, key in self.places]
            found = [container[key] for container, key, _ in self.leaves]
        except LookupError:
            return False
        if not all(map(operator.is_, now, self.values)) and not all(map(_is_alike, now, self.values)):
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
    """Return whether a recording that does not read it holds for one as for the other."""
    return now is was or (isinstance(now, torch.Tensor) and isinstance(was, torch.Tensor))


def is_like(value: Any, static: torch.Tensor) -> bool:
    """Return whether a value can be brought into a recording's memory."""
    return isinstance(value, torch.Tensor) and form_of(value) == form_of(static)


def form_of(value: torch.Tensor) -> tuple[Any, ...]:
    """Return what has to be alike in a tensor that takes another's place."""
    return value.shape, value.dtype, value.device
