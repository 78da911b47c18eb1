"""Whether a plain config value fits a type annotation."""

from __future__ import annotations

import dataclasses
import types
import typing
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

_SEQUENCES = (list, Sequence)
_MAPPINGS = (dict, Mapping)


def fits(value: Any, annotation: Any) -> bool:
    """Return whether a value out of YAML fits an annotation.

    An int is fine for a float, a bool is no int, a list is fine for a tuple. An annotation that YAML cannot
    express (a class, a callable) fits anything, because a nested ``_target_`` node builds it.
    """
    origin = typing.get_origin(annotation)
    if annotation is Any or annotation is object:
        return True
    if annotation is None or annotation is type(None):
        return value is None
    if origin in (typing.Union, types.UnionType):
        return any(fits(value, option) for option in typing.get_args(annotation))
    if origin is typing.Literal:
        return any(value == option and type(value) is type(option) for option in typing.get_args(annotation))
    if origin is typing.Annotated:
        return fits(value, typing.get_args(annotation)[0])
    if annotation in _SCALARS:
        return _SCALARS[annotation](value)
    return _container_fits(value, annotation, origin)


_SCALARS: dict[Any, Any] = {
    bool: lambda value: isinstance(value, bool),
    int: lambda value: isinstance(value, int) and not isinstance(value, bool),
    # NaN is the one number that differs from itself.
    float: lambda value: isinstance(value, (int, float)) and not isinstance(value, bool) and value == value,
    str: lambda value: isinstance(value, str),
    Path: lambda value: isinstance(value, str),
}


def _container_fits(value: Any, annotation: Any, origin: Any) -> bool:
    kind = origin or annotation
    arguments = typing.get_args(annotation)
    if kind is tuple:
        return isinstance(value, (list, tuple)) and _tuple_fits(value, arguments)
    if kind in _SEQUENCES:
        return isinstance(value, (list, tuple)) and all(fits(v, arguments[0]) for v in value if arguments)
    if kind in _MAPPINGS:
        if not isinstance(value, Mapping):
            return False
        return not arguments or all(fits(k, arguments[0]) and fits(v, arguments[1]) for k, v in value.items())
    if dataclasses.is_dataclass(kind):
        return isinstance(value, Mapping)
    return True


def _tuple_fits(value: Sequence[Any], arguments: tuple[Any, ...]) -> bool:
    if not arguments:
        return True
    if len(arguments) == 2 and arguments[1] is Ellipsis:
        return all(fits(v, arguments[0]) for v in value)
    return len(value) == len(arguments) and all(fits(v, a) for v, a in zip(value, arguments, strict=True))


_NAMES = {bool: "true or false", int: "a whole number", float: "a number", str: "text", Path: "a path"}


def describe(annotation: Any) -> str:
    """Return an annotation in words."""
    origin = typing.get_origin(annotation)
    arguments = typing.get_args(annotation)
    if annotation is None or annotation is type(None):
        return "null"
    if origin in (typing.Union, types.UnionType):
        return " or ".join(describe(option) for option in arguments)
    if origin is typing.Literal:
        return "one of " + ", ".join(str(option) for option in arguments)
    if annotation in _NAMES:
        return _NAMES[annotation]
    kind = origin or annotation
    if kind is tuple and Ellipsis not in arguments and arguments:
        return "a list of " + ", ".join(describe(a) for a in arguments)
    if kind is tuple or kind in _SEQUENCES:
        return f"a list, each {describe(arguments[0])}" if arguments else "a list"
    if kind in _MAPPINGS or dataclasses.is_dataclass(kind):
        plain = len(arguments) != 2 or arguments[1] is Any
        return "a mapping" if plain else f"a mapping, each value {describe(arguments[1])}"
    return getattr(annotation, "__name__", str(annotation))
