"""Checking the terms: is each one selected, is its target there and allowed, do its parameters fit."""

from __future__ import annotations

import inspect
import pkgutil
from collections.abc import Callable, Iterator, Mapping
from importlib import import_module
from typing import Any

from wheelleg_exp.config.explaining.catalog import LIBRARY, MODULES
from wheelleg_exp.config.tree import section_at
from wheelleg_exp.errors import ConfigError, nearest_name
from wheelleg_exp.terms.binding import RESERVED, TARGET, NotSelected, TermNode, resolve_target, split_node, walk_nodes
from wheelleg_exp.terms.term_errors import field_errors, nested_errors, parameter_errors

# The classes that the terms of some sections must be, and what the managers of some pass beside the environment.
_CLASSES = {"commands": "CommandTerm", "actions": "ActionTerm", "recorders": "RecorderTerm"}
_ARGUMENTS = {"events": ("env", "env_ids"), "curriculum": ("env", "env_ids")}


def term_nodes(config: Mapping[str, Any]) -> Iterator[tuple[str, str, Any]]:
    """Yield ``(section, path, node)`` of every term in the tree."""
    for section in RESERVED:
        nodes = section_at(config, f"env.{section}")
        if section == "observations":
            for name, group in nodes.items():
                for term, node in section_at(group, "terms").items():
                    yield section, f"env.observations.{name}.terms.{term}", node
        else:
            for term, node in nodes.items():
                yield section, f"env.{section}.{term}", node


def check_sections(config: Mapping[str, Any]) -> list[ConfigError]:
    """Return the mistakes of every term in the eight sections."""
    errors = []
    for section, path, node in term_nodes(config):
        for error in check_term(section, path, node):
            if isinstance(error, NotSelected):
                error.nearest = _nearest_selected(config, path)
            errors.append(error)
    return errors


def _nearest_selected(config: Mapping[str, Any], path: str) -> str | None:
    """Return the selected term beside a path whose name is most like it."""
    parent, _, name = path.rpartition(".")
    beside = [(where.rpartition("."), node) for _, where, node in term_nodes(config)]
    names = [
        term for (above, _, term), node in beside if above == parent and isinstance(node, Mapping) and TARGET in node
    ]
    return nearest_name(name, names)


def check_term(section: str, path: str, node: Any) -> list[ConfigError]:
    """Return the mistakes of one term: selection, target, the manager's fields, parameters."""
    try:
        term = split_node(section, path, node)
    except ConfigError as error:
        return [error]
    errors = field_errors(section, term)
    try:
        target = import_target(term.target, path)
    except ConfigError as error:
        return [*errors, error]
    # Of a target that cannot be a term here the parameters say nothing.
    wrong = _section_errors(section, term) or _kind_errors(section, term, target)
    return errors + (wrong or parameter_errors(section, term, target))


def _kind_errors(section: str, term: TermNode, target: Callable[..., Any]) -> list[ConfigError]:
    """Find a target that its manager cannot make a term of, or cannot call."""
    if inspect.isclass(target):
        return _class_errors(section, term, target)
    if section in _CLASSES:
        kind = _CLASSES[section]
        return [ConfigError(f"'{term.target}' is no {kind}", key=term.path, expected=f"a subclass of {kind}")]
    wanted = _ARGUMENTS.get(section, ("env",))
    parameters = inspect.signature(target).parameters.values()
    positional = (inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD)
    taken = tuple(p.name for p in parameters if p.kind in positional)
    if taken[: len(wanted)] == wanted or any(p.kind is inspect.Parameter.VAR_POSITIONAL for p in parameters):
        return []
    name, listed = term.target.rpartition(".")[2], ", ".join(wanted)
    message = f"'{term.target}' takes ({', '.join(taken)}), and is called with ({listed}) first"
    return [ConfigError(message, key=term.path, expected=f"def {name}({listed}, ...)")]


def _class_errors(section: str, term: TermNode, target: type) -> list[ConfigError]:
    from wheelleg_exp import managers

    kind = _CLASSES.get(section, "TermBase")
    if not issubclass(target, getattr(managers, kind)):
        expected = f"a subclass of {kind}" + ("" if section in _CLASSES else " or a function")
        return [ConfigError(f"'{term.target}' is no {kind}", key=term.path, expected=expected)]
    if section not in _CLASSES and not any("__call__" in vars(owner) for owner in target.__mro__):
        expected = f"def __call__(self, {', '.join(_ARGUMENTS.get(section, ('env',)))})"
        return [ConfigError(f"'{term.target}' cannot be called", key=term.path, expected=expected)]
    return []


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
    """Import an allowed target (raises as ``resolve_target``), of a misspelled module with the name that is meant."""
    try:
        return resolve_target(target, path)
    except ConfigError as error:
        if error.nearest is None and isinstance(error.__cause__, ModuleNotFoundError):
            nearest = _nearest_target(target)
            error.nearest = nearest if nearest != target else None
        raise


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


def check_nested_targets(config: Mapping[str, Any]) -> list[ConfigError]:
    """Return the mistakes of every ``_target_`` node that is no term itself: sensors, actuators, noise."""
    terms = {path for _, path, _ in term_nodes(config)}
    errors: list[ConfigError] = []
    for path, node in walk_nodes(config):
        if TARGET not in node or path in terms:
            continue
        try:
            errors += nested_errors(path, node, import_target(str(node[TARGET]), path))
        except ConfigError as error:
            errors.append(error)
    return errors
