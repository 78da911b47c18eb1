"""What ``${...}`` in a raw value leads to."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from wheelleg_exp.config import known
from wheelleg_exp.config.compose import Composed
from wheelleg_exp.config.tree import Keys, dotted, split_path

# The inner part of a reference to a key; with a colon it calls a resolver instead.
_REFERENCE = re.compile(r"\$\{([^${}:]+)\}")


@dataclass(frozen=True)
class Reference:
    """One key that an interpolation reads.

    Attributes:
        path: the key.
        value: its value, resolved.
        raw: its value as written, where that is an interpolation itself.
        where: who set it.
    """

    path: str
    value: Any
    raw: Any
    where: str | None


def references(composed: Composed, keys: Keys, raw: Any) -> Iterator[Reference]:
    """Yield what a raw value refers to, and what those refer to in turn."""
    tree = composed.raw_tree()
    waiting, seen = [(keys, raw)], {keys}
    while waiting:
        here, text = waiting.pop(0)
        for match in _REFERENCE.finditer(str(text)):
            found = _absolute(match.group(1).strip(), here)
            if found in seen:
                continue
            seen.add(found)
            inner = known.at(tree, found)
            waiting.append((found, inner))
            written = inner if "${" in str(inner) else None
            yield Reference(
                dotted(found), known.at(composed.config, found), written, composed.provenance.where(dotted(found))
            )


def _absolute(text: str, keys: Keys) -> Keys:
    """Return the keys that a reference at ``keys`` names: one leading dot is the same mapping, two the one above."""
    dots = len(text) - len(text.lstrip("."))
    return split_path(text) if dots == 0 else (*keys[: len(keys) - dots], *split_path(text[dots:]))
