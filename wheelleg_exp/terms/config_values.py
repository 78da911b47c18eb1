"""Check whether a plain config value fits an annotation: its type and its constraints (``constraints``)."""

from __future__ import annotations

import dataclasses
import math
import types
import typing
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from wheelleg_exp.constraints import Constraint, MayBeInfinite, OfNodes
from wheelleg_exp.errors import ConfigError, nearest_name
from wheelleg_exp.terms.key_syntax import below

_SEQUENCES = (list, Sequence)
_MAPPINGS = (dict, Mapping)
_FINITE = "a finite number"


@dataclass(frozen=True)
class Misfit:
    """A mistake in a config value, such as a wrong type or a number out of range."""

    message: str
    expected: str
    # If the wrong value is inside a mapping or list, ``keys`` is its path there, such as ``('a', 'b')``.
    keys: tuple[str, ...] = ()
    nearest: str | None = None  # a similar valid word
    is_type: bool = False  # ``is_type`` is True if the value has a wrong type.


def fits(value: object, annotation: object) -> bool:
    """Return whether a value from YAML has the type that an annotation names; see ``misfits``."""
    return not misfits(value, annotation)


def value_errors(key: str, value: object, annotation: object) -> list[ConfigError]:
    """Return the mistakes in the value at a config key; each mistake has the full config key of the wrong value."""
    errors = []
    for found in misfits(value, annotation):
        place = key
        for part in found.keys:
            place = below(place, part)
        errors.append(ConfigError(found.message, key=place, expected=found.expected, nearest=found.nearest))
    return errors


def require_fit(key: str, value: object, annotation: object) -> None:
    """Raise a ConfigError for the first mistake in a config value."""
    for error in value_errors(key, value, annotation):
        raise error


def misfits(value: object, annotation: object) -> list[Misfit]:
    """Return all mistakes in a config value, such as a text where the type annotation requires a number.

    An int fits ``float``, a list fits ``tuple``, but a bool does not fit ``int``. Every value fits a class or callable.
    """
    origin, arguments = typing.get_origin(annotation), typing.get_args(annotation)
    if annotation is Any or annotation is object:
        return []
    if origin is typing.Annotated:
        return _constrained(value, annotation, arguments[0], constraints_of(annotation))
    if origin in (typing.Union, types.UnionType):
        # If the value fits no member of a Union, report the mistakes for the first member with the right basic type.
        found = [misfits(value, option) for option in typing.get_args(annotation)]
        if not all(found):
            return []
        near = [option for option in found if not (option[0].is_type and not option[0].keys)]
        return near[0] if near else [_wrong_type(value, annotation)]
    if origin is typing.Literal:
        known = any(value == option and type(value) is type(option) for option in arguments)
        return [] if known else [_wrong_type(value, annotation)]
    if annotation is None or annotation is type(None):
        return [] if value is None else [_wrong_type(value, annotation)]
    if annotation in _SCALARS:
        if not _SCALARS[annotation](value):
            return [_wrong_type(value, annotation)]
        if annotation is float and isinstance(value, float) and not math.isfinite(value):
            return [Misfit(f"{value!r} is out of range", _FINITE)]
        return []
    kind = origin or annotation
    if kind in _MAPPINGS:
        if not isinstance(value, Mapping):
            return [_wrong_type(value, annotation)]
        wrong_items: list[Misfit] = []
        for name, item in value.items() if arguments else ():
            wrong = [dataclasses.replace(m, message=f"unknown key '{name}'") for m in misfits(name, arguments[0])]
            wrong = wrong or misfits(item, arguments[1])
            wrong_items += [dataclasses.replace(m, keys=(str(name), *m.keys)) for m in wrong]
        return wrong_items
    if kind is tuple or kind in _SEQUENCES:
        if not isinstance(value, (list, tuple)):
            return [_wrong_type(value, annotation)]
        return _of_elements(value, annotation, kind, arguments)
    # If the annotation is a dataclass, the config value must be a mapping with ``_target_``.
    built = isinstance(value, Mapping) and "_target_" in value
    if built or not (isinstance(kind, type) and dataclasses.is_dataclass(kind)) or isinstance(value, kind):
        return []
    if not isinstance(value, Mapping):
        return [_wrong_type(value, kind)]
    return [Misfit(f"{value!r} does not say what it is", f"_target_: {kind.__module__}.{kind.__qualname__}")]


def constraints_of(annotation: object) -> list[Constraint[object]]:
    """Return the constraints of a type annotation, without the constraints of its element types or union options."""
    parts = typing.get_args(annotation)[1:] if typing.get_origin(annotation) is typing.Annotated else ()
    return [part for part in parts if isinstance(part, Constraint)]


def constraints_in(annotation: object) -> list[Constraint[object]]:
    """Return all constraints in a type annotation, also those of list elements and union members."""
    inside = (found for part in typing.get_args(annotation) for found in constraints_in(part))
    return [*constraints_of(annotation), *inside]


def bare(annotation: object) -> object:
    """Return a type annotation without the outermost constraints; constraints of element types remain."""
    return typing.get_args(annotation)[0] if typing.get_origin(annotation) is typing.Annotated else annotation


_SCALARS: dict[Any, Callable[[Any], bool]] = {
    bool: lambda value: isinstance(value, bool),
    int: lambda value: isinstance(value, int) and not isinstance(value, bool),
    float: lambda value: isinstance(value, (int, float)) and not isinstance(value, bool),
    str: lambda value: isinstance(value, str),
    Path: lambda value: isinstance(value, (str, Path)),
}


def _constrained(
    value: object, annotation: object, inner: object, constraints: Sequence[Constraint[object]]
) -> list[Misfit]:
    is_infinite = any(isinstance(c, MayBeInfinite) for c in constraints) and value in (math.inf, -math.inf)
    has_nodes = any(isinstance(c, OfNodes) for c in constraints) and isinstance(value, Mapping)
    found = [] if is_infinite or has_nodes else misfits(value, inner)
    if found:  # Name the constraint in the error, too: 'a number, at least 0' instead of 'a number'.
        whole, part = describe(annotation), describe(inner)
        return [
            dataclasses.replace(m, expected=whole + m.expected.removeprefix(part)) if m.expected.startswith(part) else m
            for m in found
        ]
    broken = next((constraint for constraint in constraints if not constraint.holds(value)), None)
    return [] if broken is None else [Misfit(broken.broken or f"{value!r} is out of range", describe(annotation))]


def _of_elements(
    value: Sequence[object], annotation: object, kind: object, arguments: tuple[object, ...]
) -> list[Misfit]:
    if not arguments:
        return []
    each = arguments if kind is tuple and Ellipsis not in arguments else arguments[:1] * len(value)
    if len(each) != len(value):
        return [_wrong_type(value, annotation)]
    found = [m for item, of in zip(value, each, strict=True) for m in misfits(item, of)]
    if any(m.is_type for m in found):
        return [_wrong_type(value, annotation)]
    expected = describe(annotation) + (", finite" * any(m.expected == _FINITE for m in found))
    return [Misfit(f"{value!r} is out of range", expected)] if found else []


def _wrong_type(value: object, annotation: object) -> Misfit:
    choices = (option for option in options_in(annotation) if typing.get_origin(option) is typing.Literal)
    words = [str(word) for choice in choices for word in typing.get_args(choice)]
    nearest = nearest_name(str(value), words)
    what = "is not known" if words and isinstance(value, str) else "is not of the right type"
    return Misfit(f"{value!r} {what}", describe(annotation), nearest=nearest, is_type=True)


# --- annotation texts ---


def describe(annotation: object) -> str:
    """Return a type annotation and the annotation's constraints as text."""
    return ", ".join((type_words(annotation), *limit_words(annotation)))


def limit_words(annotation: object) -> tuple[str, ...]:
    """Return the constraints of a type annotation as texts, such as ``at least 0``."""
    constraints = constraints_of(annotation)
    words = tuple(c.words() for c in constraints if c.words())
    if not any(c.form for c in constraints):
        return words
    elements = typing.get_args(bare(annotation))
    each = limit_words(elements[0]) if len(elements) == 1 else ()
    return (*words, "each " + ", ".join(each)) if each else words


_NAMES = {bool: "true or false", int: "a whole number", float: "a number", str: "text", Path: "a path"}


def type_words(annotation: object) -> str:
    """Return the type in an annotation as words for users, without the annotation's constraints."""
    origin, arguments = typing.get_origin(annotation), typing.get_args(annotation)
    if annotation is None or annotation is type(None):
        return "null"
    if origin is typing.Annotated:
        return next((c.form for c in constraints_of(annotation) if c.form), type_words(arguments[0]))
    if origin in (typing.Union, types.UnionType):
        options = [describe(option) for option in arguments]
        return (", or " if any("," in option for option in options) else " or ").join(options)
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
        plain = len(arguments) != 2 or arguments[1] is Any or dataclasses.is_dataclass(arguments[1])
        return "a mapping" if plain else f"a mapping, each value {describe(arguments[1])}"
    return getattr(annotation, "__name__", str(annotation))


def options_in(annotation: object) -> Iterator[object]:
    """Yield the type of an annotation, or each member type of a union annotation, without ``Annotated`` constraints."""
    annotation = bare(annotation)
    if typing.get_origin(annotation) not in (typing.Union, types.UnionType):
        yield annotation
        return
    for option in typing.get_args(annotation):
        yield from options_in(option)
