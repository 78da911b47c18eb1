"""What else could stand at a key: the type, the default, the bounds and, where they can be counted, the values."""

from __future__ import annotations

import enum
import inspect
import typing
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import import_module
from typing import Any

from wheelleg_exp.config import keys as known
from wheelleg_exp.config.checking.check_agent import RESOLVERS, known_words
from wheelleg_exp.config.explaining.docstrings import is_own
from wheelleg_exp.config.tree import Keys, section_at
from wheelleg_exp.terms.binding import EVENT_MODES, TARGET
from wheelleg_exp.terms.values import limit_words, options_in, type_words
from wheelleg_exp.user_code import importing


@dataclass(frozen=True)
class Alternatives:
    """What else could stand at a key.

    Attributes:
        type: the type in words; empty when anything fits.
        limits: the bounds in words.
        values: the values, where they can be counted.
        has_default: whether the key may be left out.
        default: what then holds.
        keys: keys that may stand below it and are not set, with their defaults.
    """

    type: str = ""
    limits: tuple[str, ...] = ()
    values: tuple[Any, ...] = ()
    has_default: bool = False
    default: Any = None
    keys: tuple[tuple[str, Any], ...] = ()


def alternatives(tree: Mapping[str, Any], keys: Keys, slot: known.Slot | None) -> Alternatives:
    """Return what else could stand at ``keys``."""
    node = known.at(tree, keys)
    below = known.slots(tree, keys) if isinstance(node, Mapping) else {}
    absent = tuple(
        (n, _plain(s.default)) for n, s in below.items() if n not in node and s.default is not known.REQUIRED
    )
    if slot is None:
        return Alternatives(keys=absent)
    return Alternatives(
        "" if slot.annotation is Any else type_words(slot.annotation),
        limit_words(slot.annotation),
        tuple(_values(tree, keys, slot)),
        slot.default is not known.REQUIRED,
        None if slot.default is known.REQUIRED else _plain(slot.default),
        absent,
    )


def _plain(value: Any) -> Any:
    """Return a default as config would write it; an object, such as a default entity, as its text."""
    if isinstance(value, enum.Enum):
        return value.value
    if isinstance(value, (tuple, list)):
        return [_plain(item) for item in value]
    return value if value is None or isinstance(value, (bool, int, float, str, Mapping)) else str(value)


def _values(tree: Mapping[str, Any], keys: Keys, slot: known.Slot) -> list[Any]:
    name = keys[-1]
    if name == TARGET:
        return siblings(str(known.at(tree, keys)))
    if name == "mode" and known.section_of(keys[:-1]) == "events":
        return list(EVENT_MODES)
    if named := known.named_section(known.section_of(keys[:-1]), name):
        return _names(tree, ("env", named))
    if keys[:2] == ("agent", "obs_groups"):
        return _names(tree, ("env", "observations"))
    if name == "name" and slot.reader.endswith(".SceneEntityCfg"):
        return ["robot", *_names(tree, ("env", "scene", "sensors"))]
    if keys[0] == "agent" and slot.reader.startswith("rsl_rl.") and name in RESOLVERS:
        return known_words(name) or []
    return literal_values(slot.annotation)


def literal_values(annotation: Any) -> list[Any]:
    """Return the values that an annotation counts up: literals, members of an enum, true and false."""
    options = list(options_in(annotation))
    found = [value for option in options for value in _counted(option)]
    return [*found, None] if found and type(None) in options else found


def _counted(option: Any) -> list[Any]:
    if option is bool:
        return [True, False]
    if inspect.isclass(option) and issubclass(option, enum.Enum):
        return [member.value for member in option]
    return list(typing.get_args(option)) if typing.get_origin(option) is typing.Literal else []


def siblings(target: str) -> list[str]:
    """Return the public functions and classes that stand in the target's module, the target among them."""
    module_name = target.rpartition(".")[0]
    try:
        with importing(module_name):
            module = import_module(module_name)
    except Exception:  # it has been told what is wrong with it
        return []
    return [
        f"{module_name}.{name}"
        for name, found in vars(module).items()
        if not name.startswith("_") and callable(found) and is_own(module, found)
    ]


def _names(tree: Mapping[str, Any], keys: Keys) -> list[str]:
    return [str(name) for name, value in section_at(tree, keys).items() if value is not None]
