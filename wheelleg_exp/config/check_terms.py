"""Checking the terms: is each one selected, is its target there and allowed, do its parameters fit."""

from __future__ import annotations

import inspect
import pkgutil
import typing
from collections.abc import Callable, Iterator, Mapping
from importlib import import_module
from typing import Any

from wheelleg_exp.config import schema
from wheelleg_exp.config.library import LIBRARY, MODULES
from wheelleg_exp.config.values import describe, fits
from wheelleg_exp.errors import ConfigError, nearest_name
from wheelleg_exp.terms import (
    RESERVED,
    TARGET,
    TermNode,
    check_parameters,
    require_allowed,
    resolve_target,
    split_node,
    walk_targets,
)

_INSTANTIATE_KEYS = ("_target_", "_args_", "_partial_", "_recursive_", "_convert_")


def term_nodes(config: Mapping[str, Any]) -> Iterator[tuple[str, str, Any]]:
    """Yield ``(section, path, node)`` of every term in the tree."""
    env = config.get("env")
    for section in RESERVED:
        nodes = env.get(section) if isinstance(env, Mapping) else None
        if not isinstance(nodes, Mapping):
            continue
        if section == "observations":
            for name, group in nodes.items():
                terms = group.get("terms") if isinstance(group, Mapping) else None
                for term, node in terms.items() if isinstance(terms, Mapping) else ():
                    yield section, f"env.observations.{name}.terms.{term}", node
        else:
            for term, node in nodes.items():
                yield section, f"env.{section}.{term}", node


def check_sections(config: Mapping[str, Any]) -> list[ConfigError]:
    """Return the mistakes of every term in the seven sections."""
    return [error for section, path, node in term_nodes(config) for error in check_term(section, path, node)]


def check_term(section: str, path: str, node: Any) -> list[ConfigError]:
    """Return the mistakes of one term: selection, target, the manager's fields, parameters."""
    try:
        term = split_node(section, path, node)
    except ConfigError as error:
        return [error]
    errors = _check_fields(section, term)
    try:
        target = import_target(term.target, path)
    except ConfigError as error:
        return [*errors, error]
    errors += _section_errors(section, term)
    return errors + _parameter_errors(section, term, target) + _type_errors(term, target)


def _section_errors(section: str, term: TermNode) -> list[ConfigError]:
    """Find a stock term of another section: its value would be taken for something that it is not."""
    module, _, name = term.target.removeprefix(f"{LIBRARY}.").partition(".")
    belongs = MODULES.get(module) if term.target.startswith(f"{LIBRARY}.") else None
    if belongs is None or belongs == section:
        return []
    home = next(key for key, value in MODULES.items() if value == section)
    names = [n for n in vars(import_module(f"{LIBRARY}.{home}")) if not n.startswith("_")]
    nearest = nearest_name(name, names)
    return [
        ConfigError(
            f"'{term.target}' is a term of {belongs}",
            key=f"{term.path}.{TARGET}",
            expected=f"a term of {LIBRARY}.{home}, or of a package of yours",
            nearest=f"{LIBRARY}.{home}.{nearest}" if nearest else None,
        )
    ]


def import_target(target: str, path: str) -> Callable[..., Any]:
    """Import an allowed target; whatever its module raises becomes a ConfigError.

    Raises:
        ConfigError: the target is not allowed, not there, not callable, or its module does not import.
    """
    try:
        return resolve_target(target, path)
    except ConfigError as error:
        if error.nearest is None and isinstance(error.__cause__, ModuleNotFoundError):
            error.nearest = _nearest_target(target)
        raise
    except Exception as error:
        raise ConfigError(
            f"importing '{target}' fails: {type(error).__name__}: {error}",
            key=f"{path}.{TARGET}",
            expected="package.module.name",
        ) from error


def _nearest_target(target: str) -> str | None:
    """Return the target with its first wrong module name put right."""
    parts = target.split(".")
    for n in range(1, len(parts) - 1):
        try:
            package = import_module(".".join(parts[:n]))
            import_module(".".join(parts[: n + 1]))
        except ModuleNotFoundError:
            names = [module.name for module in pkgutil.iter_modules(getattr(package, "__path__", []))]
            name = nearest_name(parts[n], names)
            return ".".join([*parts[:n], name, *parts[n + 1 :]]) if name else None
        except ImportError:
            return None
    return None


def _check_fields(section: str, term: TermNode) -> list[ConfigError]:
    errors = [
        ConfigError(f"every term of {section} needs '{name}'", key=f"{term.path}.{name}")
        for name in schema.REQUIRED_FIELDS.get(section, ())
        if name not in term.fields
    ]
    for name, value in term.fields.items():
        annotation = schema.FIELD_TYPES.get(name, Any)
        if not _has_target(value) and not fits(value, annotation):
            errors.append(
                ConfigError(
                    f"{value!r} is not of the right type",
                    key=f"{term.path}.{name}",
                    expected=describe(annotation),
                    nearest=nearest_name(str(value), map(str, typing.get_args(annotation))),
                )
            )
    return errors + _mode_errors(term)


def _mode_errors(term: TermNode) -> list[ConfigError]:
    mode = term.fields.get("mode")
    if not isinstance(mode, str):
        return []
    nearest = nearest_name(mode, schema.EVENT_MODES)
    if nearest is not None and mode != nearest:
        expected = ", ".join(schema.EVENT_MODES) + ", or a name of your own that is not so like one of them"
        message = f"unknown mode '{mode}'"
        return [ConfigError(message, key=f"{term.path}.mode", expected=expected, nearest=nearest)]
    errors = [
        ConfigError(
            f"only events of mode '{owner}' read it, and this one has mode '{mode}'",
            key=f"{term.path}.{name}",
            expected=f"mode {owner}, or no {name}",
        )
        for name, owner in schema.MODE_FIELDS.items()
        if name in term.fields and owner != mode
    ]
    if mode == "interval" and term.fields.get("interval_range_s") is None:
        key = f"{term.path}.interval_range_s"
        errors.append(ConfigError("an interval event needs an interval", key=key, expected="[shortest, longest] in s"))
    return errors


def _parameter_errors(section: str, term: TermNode, target: Callable[..., Any]) -> list[ConfigError]:
    """Collect what ``check_parameters`` raises, taking each unknown parameter out and looking again."""
    errors: list[ConfigError] = []
    params = dict(term.params)
    while True:
        try:
            check_parameters(section, TermNode(term.name, term.path, term.target, term.fields, params), target)
        except ConfigError as error:
            errors.append(error)
            name = (error.key or "").removeprefix(f"{term.path}.")
            if name not in params:
                return errors
            del params[name]
        else:
            return errors


def _type_errors(term: TermNode, target: Callable[..., Any]) -> list[ConfigError]:
    """Hold parameter values against the annotations of the target."""
    hints = _hints(target)
    return [
        ConfigError(f"{value!r} is not of the right type", key=f"{term.path}.{name}", expected=describe(hints[name]))
        for name, value in term.params.items()
        if name in hints and not _has_target(value) and not fits(value, hints[name])
    ]


def _hints(target: Callable[..., Any]) -> dict[str, Any]:
    function = target.__init__ if inspect.isclass(target) else target
    try:
        return typing.get_type_hints(function)
    except (NameError, TypeError, AttributeError):
        return {}


def _has_target(value: Any) -> bool:
    return any(True for _ in walk_targets(value))


def check_nested_targets(config: Mapping[str, Any]) -> list[ConfigError]:
    """Return the mistakes of every ``_target_`` node that is no term itself: sensors, actuators, noise."""
    terms = {path for _, path, _ in term_nodes(config)}
    errors: list[ConfigError] = []
    for path, target in walk_targets(config):
        if path in terms:
            continue
        try:
            require_allowed(target, path)
            errors += _nested_errors(path, target, config)
        except ConfigError as error:
            errors.append(error)
    return errors


def _nested_errors(path: str, target: str, config: Mapping[str, Any]) -> list[ConfigError]:
    found = import_target(target, path)
    node = _node_at(config, path)
    if not isinstance(node, Mapping):
        return []
    params = {k: v for k, v in node.items() if k not in _INSTANTIATE_KEYS}
    term = TermNode(path.rsplit(".", 1)[-1], path, target, {}, params)
    if node.get("_partial_") or "_args_" in node:
        return [e for e in _parameter_errors("commands", term, found) if e.key != path]
    return _parameter_errors("commands", term, found) + _type_errors(term, found)


def _node_at(config: Mapping[str, Any], path: str) -> Any:
    """Return the node at a path of ``walk_targets``, whose list indices stand in brackets."""
    for found, node in walk_nodes(config, ""):
        if found == path:
            return node
    return None


def walk_nodes(node: Any, path: str) -> Iterator[tuple[str, Any]]:
    """Yield ``(path, node)`` of each mapping at or below ``node``; list indices stand in brackets."""
    if isinstance(node, Mapping):
        yield path, node
        for key, value in node.items():
            yield from walk_nodes(value, f"{path}.{key}" if path else str(key))
    elif isinstance(node, (list, tuple)):
        for index, value in enumerate(node):
            yield from walk_nodes(value, f"{path}[{index}]")


def documentation(target: Callable[..., Any]) -> str:
    """Return the first line of a target's docstring, or nothing."""
    text = inspect.getdoc(target) or ""
    return text.strip().splitlines()[0] if text.strip() else ""
