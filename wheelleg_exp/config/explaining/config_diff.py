"""Compare two config trees value by value, and compare two runs or tasks by the meaning of their configs."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import MISSING, dataclass, field, fields, is_dataclass
from typing import Any, Literal, TypeGuard

from wheelleg_exp.config import key_slots
from wheelleg_exp.config.tree_lookup import at, section_at
from wheelleg_exp.terms.key_syntax import Keys, dotted
from wheelleg_exp.terms.term_binding import TARGET, signature_parameters


class _Absent:
    def __str__(self) -> str:
        return "(absent)"


ABSENT = _Absent()


@dataclass(frozen=True)
class Change:
    """A config key whose values ``a`` and ``b`` differ in two configs; ``ABSENT`` means that a config lacks the key."""

    keys: Keys
    a: Any
    b: Any

    @property
    def key(self) -> str:
        return dotted(self.keys) if len(self.keys) > 1 else "".join(self.keys)


def changes(a: object, b: object, alike: Callable[[object, object], bool], keys: Keys = ()) -> Iterator[Change]:
    """Yield the leaves in which two trees differ: first in the order of A, then the leaves that only B has."""
    if isinstance(a, Mapping) and isinstance(b, Mapping):
        for name in dict.fromkeys([*a, *b]):
            yield from changes(a.get(name, ABSENT), b.get(name, ABSENT), alike, (*keys, str(name)))
    elif a is ABSENT or b is ABSENT or not alike(a, b):
        yield Change(keys, a, b)


def same(a: object, b: object) -> bool:
    """Return whether two plain config values are equal. 1 equals 1.0, and NaN equals NaN, but True differs from 1."""
    if isinstance(a, Mapping) and isinstance(b, Mapping):
        return a.keys() == b.keys() and all(same(a[key], b[key]) for key in a)
    if _is_list(a) and _is_list(b):
        return len(a) == len(b) and all(map(same, a, b))
    if isinstance(a, bool) or isinstance(b, bool):
        return a is b
    if isinstance(a, float) and isinstance(b, float) and math.isnan(a) and math.isnan(b):
        return True
    return bool(a == b)


def _is_list(value: object) -> TypeGuard[Sequence[object]]:
    return isinstance(value, Sequence) and not isinstance(value, str)


Kind = Literal["added", "removed", "changed", "reordered"]

# For each config section, ``ORDER`` states the effect of a different order of the section's terms.
ORDER: dict[str, str] = {
    "actions": "the layout of the action vector differs",
    "observations": "the layout of the observation differs",
    "events": "they run in this order",
    "curriculum": "they run in this order",
    "rewards": "the sum may differ in its last digits",
}
_LAID_OUT = ("actions", "observations")


@dataclass(frozen=True)
class Side:
    """One of two compared configs, such as the config of a run or of a task.

    ``where`` is a function that maps a config key to the file and line, or the override, that set or removed the key.
    ``facts`` describes a run's source code, package versions, and hardware.
    """

    label: str
    tree: Mapping[str, object]
    where: Callable[[str], str | None]
    facts: Mapping[str, Mapping[str, object]] = field(default_factory=dict)


@dataclass(frozen=True)
class PlacedChange:
    """One difference between two configs, with the file and line or override of both values.

    ``is_term`` is true for a change of a whole term, such as a reward, or of the order of terms. ``note`` states what
    the difference changes, such as ``the layout of the action vector differs``.
    """

    kind: Kind
    path: str
    is_term: bool
    a: object = None
    b: object = None
    where_a: str | None = None
    where_b: str | None = None
    note: str = ""


@dataclass(frozen=True)
class FactChange:
    """One fact, such as a version, in which two runs differ."""

    section: str
    name: str
    a: object
    b: object


@dataclass(frozen=True)
class Difference:
    """All differences between two configs; ``bool(difference)`` is false if the configs are equal."""

    terms: tuple[PlacedChange, ...]
    parameters: tuple[PlacedChange, ...]
    facts: tuple[FactChange, ...]

    def __bool__(self) -> bool:
        return bool(self.terms or self.parameters or self.facts)


def compare(a: Side, b: Side) -> Difference:
    """Return the differences between two configs; skip top-level sections that only one config has."""
    changes = [change for key in a.tree if key in b.tree for change in _walk(a, b, (str(key),))]
    terms = tuple(change for change in changes if change.is_term)
    return Difference(terms, tuple(c for c in changes if not c.is_term), tuple(_facts(a.facts, b.facts)))


def _walk(a: Side, b: Side, keys: Keys) -> Iterator[PlacedChange]:
    one, other = at(a.tree, keys), at(b.tree, keys)
    if not (isinstance(one, Mapping) and isinstance(other, Mapping)):
        if not same(one, other):
            yield _change("changed", a, b, keys, one, other)
        return
    section = key_slots.section_of((*keys, "any"))
    before, after = [str(n) for n in one if n in other], [str(n) for n in other if n in one]
    if before != after and section in ORDER:
        path = dotted(keys)
        yield PlacedChange("reordered", path, True, before, after, a.where(path), b.where(path), ORDER[section])
    for name in dict.fromkeys([*map(str, one), *map(str, other)]):
        inner = (*keys, name)
        if name in one and name in other:
            yield from _walk(a, b, inner)
        elif not _is_default(a, b, inner):
            kind: Kind = "added" if name in other else "removed"
            note = ORDER[section] if section in _LAID_OUT else ""
            yield _change(kind, a, b, inner, at(a.tree, inner), at(b.tree, inner), note)


def _change(kind: Kind, a: Side, b: Side, keys: Keys, one: object, other: object, note: str = "") -> PlacedChange:
    path, is_term = dotted(keys), key_slots.section_of(keys) is not None
    return PlacedChange(kind, path, is_term, one, other, a.where(path), b.where(path), note)


def _is_default(a: Side, b: Side, keys: Keys) -> bool:
    """Return whether one of two configs sets a key to its default value and the other config does not set the key."""
    parents = [section_at(side.tree, keys[:-1]) for side in (a, b)]
    if key_slots.section_of(keys) is not None or parents[0].get(TARGET) != parents[1].get(TARGET):
        return False
    side = a if keys[-1] in parents[0] else b
    slot, value = key_slots.slot(side.tree, keys), at(side.tree, keys)
    if slot is None or slot.default is key_slots.REQUIRED:
        return False
    target = key_slots.target_of(value)
    if target is None or type(slot.default) is not target or not isinstance(value, Mapping):
        return same(value, slot.default)
    # A ``_target_`` node that builds an equal object also sets the default value.
    made = [f.name for f in fields(target) if f.default_factory is not MISSING] if is_dataclass(target) else []
    parameters = {n: p for n, p in signature_parameters(target).items() if n in value or n not in made}
    return all(same(value.get(n, p.default), getattr(slot.default, n, None)) for n, p in parameters.items())


def _facts(a: Mapping[str, Mapping[str, object]], b: Mapping[str, Mapping[str, object]]) -> Iterator[FactChange]:
    for section in a:
        one, other = a[section], b.get(section, {})
        if section == "code" and one.get("tree") is not None and one.get("tree") == other.get("tree"):
            continue  # Commits with the same git tree contain the same source code, so report no difference.
        for name in one:
            if name in other and not same(one[name], other[name]):
                yield FactChange(section, name, one[name], other[name])
