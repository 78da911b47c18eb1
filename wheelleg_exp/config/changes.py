"""Two plain trees compared leaf by leaf."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from wheelleg_exp.config.tree import Keys, dotted


class _Absent:
    def __str__(self) -> str:
        return "(absent)"


ABSENT = _Absent()


@dataclass(frozen=True)
class Change:
    """One leaf in which two trees differ; ``a`` or ``b`` is ``ABSENT`` where the key is not there."""

    keys: Keys
    a: Any
    b: Any

    @property
    def key(self) -> str:
        """The dotted key."""
        return dotted(self.keys) if len(self.keys) > 1 else "".join(self.keys)


def changes(a: Any, b: Any, alike: Callable[[Any, Any], bool], keys: Keys = ()) -> Iterator[Change]:
    """Yield the leaves in which two trees differ, in A's order and then B's.

    Args:
        a: a tree.
        b: another.
        alike: whether two leaves count as the same.
        keys: where both stand.
    """
    if isinstance(a, Mapping) and isinstance(b, Mapping):
        for name in dict.fromkeys([*a, *b]):
            yield from changes(a.get(name, ABSENT), b.get(name, ABSENT), alike, (*keys, str(name)))
    elif a is ABSENT or b is ABSENT or not alike(a, b):
        yield Change(keys, a, b)


def same(a: Any, b: Any) -> bool:
    """Return whether two plain values mean the same: a whole number equals the same one with a fraction of zero."""
    if isinstance(a, Mapping) and isinstance(b, Mapping):
        return a.keys() == b.keys() and all(same(a[key], b[key]) for key in a)
    if _is_list(a) and _is_list(b):
        return len(a) == len(b) and all(map(same, a, b))
    if isinstance(a, bool) or isinstance(b, bool):
        return a is b
    if isinstance(a, float) and isinstance(b, float) and math.isnan(a) and math.isnan(b):
        return True
    return bool(a == b)


def _is_list(value: Any) -> bool:
    return isinstance(value, Sequence) and not isinstance(value, str)
