"""All that is wrong with a term node and the nodes within it, by the annotations of what they build.

``check`` tells all of it before anything is built; whatever builds a term raises the first of it.
"""

from __future__ import annotations

import inspect
import types
import typing
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from typing import Any

from wheelleg_exp.constraints import rules_of
from wheelleg_exp.errors import ConfigError, nearest_name
from wheelleg_exp.terms.binding import (
    EVENT_MODES,
    FIELD_TYPES,
    MODE_FIELDS,
    REQUIRED_FIELDS,
    RESERVED,
    TARGET,
    TermNode,
    read_from,
    signature_parameters,
    target_arguments,
    walk_targets,
)
from wheelleg_exp.terms.keys import below
from wheelleg_exp.terms.values import value_errors


def field_errors(section: str, term: TermNode) -> list[ConfigError]:
    """Return the mistakes of the manager's own fields of a term."""
    errors = [
        ConfigError(f"every term of {section} needs '{name}'", key=f"{term.path}.{name}")
        for name in REQUIRED_FIELDS.get(section, ())
        if name not in term.fields
    ]
    for name, value in term.fields.items():
        if not has_target(value):
            errors += value_errors(f"{term.path}.{name}", value, FIELD_TYPES.get(name, Any))
    return errors + _mode_errors(term)


def _mode_errors(term: TermNode) -> list[ConfigError]:
    mode = term.fields.get("mode")
    if not isinstance(mode, str):
        return []
    nearest = nearest_name(mode, EVENT_MODES)
    if nearest is not None and mode != nearest:
        expected = ", ".join(EVENT_MODES) + ", or a name of your own that is not so like one of them"
        message = f"unknown mode '{mode}'"
        return [ConfigError(message, key=f"{term.path}.mode", expected=expected, nearest=nearest)]
    errors = [
        ConfigError(
            f"only events of mode '{owner}' read it, and this one has mode '{mode}'",
            key=f"{term.path}.{name}",
            expected=f"mode {owner}, or no {name}",
        )
        for name, owner in MODE_FIELDS.items()
        if name in term.fields and owner != mode
    ]
    if mode == "interval" and term.fields.get("interval_range_s") is None:
        key = f"{term.path}.interval_range_s"
        errors.append(ConfigError("an interval event needs an interval", key=key, expected="[shortest, longest] in s"))
    return errors


def parameter_errors(section: str, term: TermNode, target: Callable[..., Any]) -> list[ConfigError]:
    """Return the mistakes of a term's parameters: their names, their values, and the rules between them."""
    return list(_name_errors(section, term, target)) + _value_errors(term, target)


def nested_errors(path: str, node: Mapping[str, Any], target: Callable[..., Any]) -> list[ConfigError]:
    """Return the mistakes of a ``_target_`` node that is no term itself: a sensor, an actuator, noise, an entity."""
    try:
        term = TermNode(path.rsplit(".", 1)[-1], path, str(node[TARGET]), {}, target_arguments(node, path))
    except ConfigError as error:
        return [error]
    return parameter_errors("commands", term, target)  # a section without fields of its manager's


def _name_errors(section: str, term: TermNode, target: Callable[..., Any]) -> Iterator[ConfigError]:
    accepted = signature_parameters(target)
    for name in accepted:
        if name in RESERVED[section]:
            yield ConfigError(
                f"'{term.target}' has a parameter '{name}', a name that the manager keeps for itself",
                key=term.path,
                expected="a target without parameters named " + ", ".join(RESERVED[section]),
            )
            return
    known = [*accepted, *RESERVED[section]]
    meant: set[str] = set()  # what is missing because it is written otherwise is told there
    for name, value in term.params.items():
        if name in accepted:
            continue
        nearest, expected = nearest_name(name, known), "one of " + ", ".join(known) if known else "no parameters"
        if isinstance(value, Mapping) and set(value) & set(known):
            expected = f"{', '.join(value)} beside _target_, not below '{name}'"
            meant |= set(value)
        meant |= {nearest} if nearest else set()
        message = f"'{term.target}' takes no parameter '{name}'"
        yield ConfigError(message, key=f"{term.path}.{name}", expected=expected, nearest=nearest)
    given = {*term.params, *meant}
    missing = [n for n, p in accepted.items() if p.default is inspect.Parameter.empty and n not in given]
    if missing:
        yield ConfigError(
            f"'{term.target}' needs " + ", ".join(f"'{n}'" for n in missing),
            key=term.path,
            expected="a value for each parameter without a default",
        )


def _value_errors(term: TermNode, target: Callable[..., Any]) -> list[ConfigError]:
    """Hold parameters against the annotations of the target and, where each is right by itself, against its rules."""
    hints = type_hints(target)
    errors: list[ConfigError] = []
    accepted = signature_parameters(target)
    for name, value in term.params.items():
        is_default = value is None and name in accepted and accepted[name].default is None
        if name in hints and not has_target(value) and not is_default:
            errors += value_errors(below(term.path, name), value, hints[name])
    if errors:
        return errors
    given = {name: term.params.get(name, parameter.default) for name, parameter in accepted.items()}
    if any(value is inspect.Parameter.empty for value in given.values()):
        return []  # what is missing is told by its name
    return [
        ConfigError(broken.message, key=f"{term.path}.{broken.key}", expected=broken.expected)
        for rule in rules_of(target)
        for broken in rule(given)
    ]


def type_hints(target: Callable[..., Any]) -> dict[str, Any]:
    """Return the annotations of what a target takes, constraints included, but for those that cannot be read.

    One that names what its module imports for type checkers alone, as terms of Isaac Lab name the environment's class,
    hides none of the others.
    """
    target = read_from(target)
    function = target.__init__ if inspect.isclass(target) else target
    try:
        return typing.get_type_hints(function, include_extras=True)
    except (NameError, TypeError, AttributeError):
        return dict(_readable_hints(inspect.unwrap(function)))


def _readable_hints(function: Callable[..., Any]) -> Iterator[tuple[str, Any]]:
    for name, annotation in getattr(function, "__annotations__", {}).items():
        alone = types.SimpleNamespace(__annotations__={name: annotation})
        with suppress(Exception):  # whatever evaluating a text may raise
            yield name, typing.get_type_hints(alone, getattr(function, "__globals__", {}), include_extras=True)[name]


def has_target(value: Any) -> bool:
    """Return whether something is built within a value, so that it is not plain."""
    return any(True for _ in walk_targets(value))
