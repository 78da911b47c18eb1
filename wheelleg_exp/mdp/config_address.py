"""Read and write an environment's settings by addresses such as ``commands.base_velocity.ranges.lin_vel_x[1]``."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

import torch

from wheelleg_exp.errors import ConfigError, nearest_name
from wheelleg_exp.managers import ObservationManager, Term
from wheelleg_exp.managers.manager_base import ManagerBase

Part = str | int
_KEY = "address"
# Curricula can change only those fields of a term that managers read at each use.
_READ_AT_EACH_USE = ("weight", "interval_range_s", "min_step_count_between_reset")


def parse(address: str) -> tuple[Part, ...]:
    """Split an address into names and indices: The address ``a.b[2].c`` becomes ('a', 'b', 2, 'c')."""
    parts: list[Part] = []
    for text in address.split("."):
        found = re.fullmatch(r"(\w+)((?:\[\d+\])*)", text)
        if found is None:
            message = f"'{address}' is not the address of a setting"
            raise ConfigError(message, key=_KEY, expected="names and indices, as in a.b[2].c")
        parts += [found[1], *(int(index) for index in re.findall(r"\d+", found[2]))]
    return tuple(parts)


def look_up(root: object, parts: tuple[Part, ...]) -> object:
    """Return the value of the setting at an address relative to the object ``root``."""
    for part in parts:
        root = _below(root, part)
    return root


def terms_of(root: object, parts: tuple[Part, ...]) -> list[Term]:
    """Return the manager terms, whose settings are in every checkpoint, to which an address belongs."""
    passed = (look_up(root, parts[:length]) for length in range(1, len(parts)))
    return [found for found in passed if isinstance(found, Term)]


def write(root: object, parts: tuple[Part, ...], value: object) -> None:
    """Set the setting at an address relative to ``root``, and a constructor argument also in the term's object."""
    _set(root, parts, value)
    for term in terms_of(root, parts):
        term.take_arguments()


def _set(root: object, parts: tuple[Part, ...], value: Any) -> None:
    last: Any = parts[-1]
    holder = look_up(root, parts[:-1])
    if isinstance(holder, Term):
        holder = _holder(holder, last, to_write=True)
    if isinstance(holder, tuple):
        _set(root, parts[:-1], (*holder[:last], value, *holder[last + 1 :]))
    elif isinstance(holder, (dict, list, torch.Tensor)):
        holder[last] = value
    else:
        setattr(holder, last, value)


def require_writable(root: object, parts: tuple[Part, ...]) -> None:
    """Raise ConfigError if the setting at an address does not exist, or if a new value would have no effect."""
    look_up(root, parts)
    holder = look_up(root, parts[:-1])
    if isinstance(holder, Term):
        _holder(holder, parts[-1], to_write=True)


def _below(holder: Any, part: Part) -> Any:
    if isinstance(holder, Term):
        if part in ("func", "params"):  # Isaac Lab writes `TERM.params.NAME` for `TERM.NAME`.
            return holder
        holder = _holder(holder, part)
    elif isinstance(holder, ObservationManager) and part in holder.active_terms:
        terms = {name: term.term for name, term in holder.terms(str(part)).items()}
        return {"terms": terms, **terms}
    elif isinstance(holder, ManagerBase) and part in holder.term_names:
        return holder.get_term_cfg(str(part))
    if part == "cfg" and isinstance(holder, (ManagerBase, ObservationManager)):
        return holder  # Isaac Lab's address `reward_manager.cfg.TERM` is `reward_manager.TERM` in this project.
    try:
        return holder[part] if isinstance(part, int) or isinstance(holder, Mapping) else getattr(holder, part)
    except (KeyError, IndexError, AttributeError, TypeError):
        names: list[str] = []
        if isinstance(holder, Mapping):
            names = [str(name) for name in holder]
        elif isinstance(holder, (ManagerBase, ObservationManager)):
            names = list(holder.active_terms if isinstance(holder, ObservationManager) else holder.term_names)
        elif not isinstance(holder, (list, tuple, torch.Tensor)):
            names = [name for name in getattr(holder, "__dict__", ()) if not name.startswith("_")]
        what = f"of {len(holder)}" if isinstance(holder, (list, tuple)) else f"in a {type(holder).__name__}"
        expected, nearest = "one of " + ", ".join(names) if names else None, nearest_name(str(part), names)
        message = f"there is no '{part}' {what}"
        raise ConfigError(message, key=_KEY, expected=expected, nearest=nearest) from None


def _holder(term: Term, part: Part, *, to_write: bool = False) -> object:
    """Return the object that stores a term's setting ``part``: the term's fields, parameters, or class instance."""
    if part in term.fields:
        if to_write and part not in _READ_AT_EACH_USE:
            message = f"'{part}' of '{term.name}' is read only once, when the environment is created"
            expected = "a parameter, or one of " + ", ".join(_READ_AT_EACH_USE)
            raise ConfigError(message, key=_KEY, expected=expected)
        return term.fields
    if term.stateful is None or part in term.params:
        return term.params
    return term.stateful if hasattr(term.stateful, str(part)) else term.arguments
