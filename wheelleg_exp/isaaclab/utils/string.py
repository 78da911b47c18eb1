"""Functions of ``isaaclab.utils.string`` that match names with regular expressions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TypeVar

from wheelleg_exp.sim.names import match_names

Value = TypeVar("Value")


def resolve_matching_names(
    keys: str | Sequence[str], list_of_strings: Sequence[str], preserve_order: bool = False
) -> tuple[list[int], list[str]]:
    """Return indices and names that expressions match completely; raise ConfigError if an expression has no match."""
    return match_names(keys, list_of_strings, what="name", preserve_order=preserve_order)


def resolve_matching_names_values(
    data: Mapping[str, Value], list_of_strings: Sequence[str], preserve_order: bool = False
) -> tuple[list[int], list[str], list[Value]]:
    """Return the results of ``resolve_matching_names`` for the keys of ``data``, and the value of each matched name."""
    indices, names = match_names(list(data), list_of_strings, what="name", preserve_order=preserve_order)
    owners = {name: value for key, value in data.items() for name in match_names(key, names, what="name")[1]}
    return indices, names, [owners[name] for name in names]
