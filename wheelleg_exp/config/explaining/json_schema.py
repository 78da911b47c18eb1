"""Describe a composed config as a JSON Schema (draft 2020-12), from the types that ``wheelleg check`` also uses."""

from __future__ import annotations

import types
import typing
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from wheelleg_exp import constraints as limits
from wheelleg_exp.config import key_slots
from wheelleg_exp.config.tree_lookup import at
from wheelleg_exp.terms.config_values import constraints_of, options_in
from wheelleg_exp.terms.key_syntax import Keys

DRAFT = "https://json-schema.org/draft/2020-12/schema"
_TYPES = {bool: "boolean", int: "integer", float: "number", str: "string", Path: "string", type(None): "null"}
# JSON Schema applies ``minItems`` only to arrays, ``minLength`` only to strings, and so on.
_KEYWORDS: dict[type, Callable[[Any], dict[str, Any]]] = {
    limits.AtLeast: lambda limit: {"minimum": limit.bound},
    limits.Above: lambda limit: {"exclusiveMinimum": limit.bound},
    limits.AtMost: lambda limit: {"maximum": limit.bound},
    limits.Length: lambda limit: {"minItems": limit.count, "maxItems": limit.count},
    limits.Ordered: lambda _: {"minItems": 2, "maxItems": 2},
    limits.NotEmpty: lambda _: {"minItems": 1, "minLength": 1, "minProperties": 1},
    limits.Pattern: lambda limit: {"pattern": f"^(?:{limit.expression})$"},
    limits.Targeted: lambda _: {"required": ["_target_"]},
}


def json_schema(tree: Mapping[str, object], keys: Keys = ()) -> dict[str, Any]:
    """Return the schema of the value at ``keys`` in a resolved config, in which each ``_target_`` selects other keys.

    The schema contains types, ranges, lengths, and choices. Only ``wheelleg check`` checks relations between keys.
    """
    slot, node = key_slots.slot(tree, keys) or key_slots.Slot(), at(tree, keys)
    found = type_schema(slot.annotation)
    if isinstance(node, Mapping):
        known = key_slots.slots(tree, keys)
        inside = known or [str(name) for name, value in node.items() if isinstance(value, Mapping)]
        # The types of some classes do not show which keys have a default, so require only keys that are set.
        needed = [name for name, key in known.items() if key.default is key_slots.REQUIRED and name in node]
        properties = {name: json_schema(tree, (*keys, name)) for name in inside}
        others = False if known else found.get("additionalProperties", {})
        if key_slots.section_of((*keys, "")) is not None:
            others = {"anyOf": [others, {"type": "null"}]}
        section = {"type": "object", "properties": properties, "required": needed, "additionalProperties": others}
        # Some keys also accept null or a number. A term can be null, which removes it.
        options = [type(None)] * (key_slots.section_of(keys) is not None) + list(options_in(slot.annotation))
        plain = [option for option in map(type_schema, options) if option and option.get("type") != "object"]
        found = {"anyOf": [section, *plain]} if plain else section
    about = {"description": slot.meaning} if slot.meaning else {}
    has_default = slot.default is None or isinstance(slot.default, (bool, int, float, str))
    return about | found | ({"default": slot.default} if has_default else {})


def type_schema(annotation: Any) -> dict[str, Any]:
    """Return the schema of a type annotation with its constraints; ``{}``, which accepts all values, for a class."""
    kind, arguments = typing.get_origin(annotation) or annotation, typing.get_args(annotation)
    if kind is typing.Annotated:
        found = type_schema(arguments[0])
        for limit in constraints_of(annotation):
            if isinstance(limit, limits.MayBeInfinite):
                found = {"anyOf": [found, {"enum": ["inf", "-inf"]}]}
            for constraint, keywords in _KEYWORDS.items():
                found |= keywords(limit) if isinstance(limit, constraint) else {}
        return found
    if kind in (typing.Union, types.UnionType):
        return {"anyOf": [type_schema(option) for option in arguments]}
    if kind is typing.Literal:
        return {"enum": list(arguments)}
    if kind in _TYPES:
        return {"type": _TYPES[kind]}
    if kind in (dict, Mapping):
        return {"type": "object", "additionalProperties": type_schema(arguments[1]) if arguments else {}}
    if kind is tuple and arguments and Ellipsis not in arguments:
        elements, count = [type_schema(option) for option in arguments], len(arguments)
        return {"type": "array", "prefixItems": elements, "minItems": count, "maxItems": count}
    if kind in (list, tuple, Sequence):
        return {"type": "array", "items": type_schema(arguments[0]) if arguments else {}}
    return {}
