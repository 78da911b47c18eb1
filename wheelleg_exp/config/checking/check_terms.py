"""Check the terms of a config, and the references from one config section to another section."""

from __future__ import annotations

import inspect
import pkgutil
from collections.abc import Callable, Iterator, Mapping
from importlib import import_module
from pathlib import Path
from typing import Any

from wheelleg_exp.config.config_errors import UnknownName
from wheelleg_exp.config.explaining.catalog import LIBRARY, MODULES
from wheelleg_exp.config.key_slots import named_section
from wheelleg_exp.config.tree_lookup import at, section_at
from wheelleg_exp.errors import ConfigError, nearest_name
from wheelleg_exp.terms import term_binding as binding
from wheelleg_exp.terms.term_errors import field_errors, nested_errors, parameter_errors

# For some config sections, `_CLASSES` names the base class of terms, `_ARGUMENTS` the first parameters of functions.
_CLASSES = {"commands": "CommandTerm", "actions": "ActionTerm", "recorders": "RecorderTerm"}
_ARGUMENTS = {"events": ("env", "env_ids"), "curriculum": ("env", "env_ids")}


def term_nodes(config: Mapping[str, object]) -> Iterator[tuple[str, str, Any]]:
    """Yield the config section, the config path, and the config node of every term in the config."""
    for section in binding.RESERVED:
        nodes = section_at(config, f"env.{section}")
        if section == "observations":
            for name, group in nodes.items():
                for term, node in section_at(group, "terms").items():
                    yield section, f"env.observations.{name}.terms.{term}", node
        else:
            for term, node in nodes.items():
                yield section, f"env.{section}.{term}", node


def check_sections(config: Mapping[str, object]) -> Iterator[ConfigError]:
    """Yield the mistakes in every term of the config."""
    for section, path, node in term_nodes(config):
        for error in check_term(section, path, node):
            if isinstance(error, binding.NotSelected):
                parent, _, name = path.rpartition(".")
                terms = section_at(config, parent).items()
                selected = [str(t) for t, other in terms if isinstance(other, Mapping) and binding.TARGET in other]
                error.nearest = nearest_name(name, selected)
            yield error


def check_term(section: str, path: str, node: object) -> list[ConfigError]:
    """Return the mistakes in one term: a missing or wrong ``_target_``, wrong manager fields, and wrong parameters."""
    try:
        term = binding.split_node(section, path, node)
    except ConfigError as error:
        return [error]
    errors = list(field_errors(section, term))
    try:
        target = import_target(term.target, path)
    except ConfigError as error:
        return [*errors, error]
    # Report the mistakes in a term's parameters only if the term's ``_target_`` is valid in the term's section.
    wrong = _section_errors(section, term) or _kind_errors(section, term, target)
    return errors + (wrong or parameter_errors(section, term, target))


def _kind_errors(section: str, term: binding.TermNode, target: Callable[..., object]) -> list[ConfigError]:
    if inspect.isclass(target):
        from wheelleg_exp import managers

        kind = _CLASSES.get(section, "TermBase")
        if not issubclass(target, getattr(managers, kind)):
            expected = f"a subclass of {kind}" + ("" if section in _CLASSES else " or a function")
            return [ConfigError(f"'{term.target}' is not a subclass of {kind}", key=term.path, expected=expected)]
        if section not in _CLASSES and not any("__call__" in vars(owner) for owner in target.__mro__):
            expected = f"def __call__(self, {', '.join(_ARGUMENTS.get(section, ('env',)))})"
            return [ConfigError(f"'{term.target}' cannot be called", key=term.path, expected=expected)]
        return []
    if section in _CLASSES:
        expected = f"a subclass of {_CLASSES[section]}"
        return [ConfigError(f"'{term.target}' is not {expected}", key=term.path, expected=expected)]
    wanted = _ARGUMENTS.get(section, ("env",))
    parameters = inspect.signature(target).parameters.values()
    positional = (inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD)
    taken = tuple(p.name for p in parameters if p.kind in positional)
    if taken[: len(wanted)] == wanted or any(p.kind is inspect.Parameter.VAR_POSITIONAL for p in parameters):
        return []
    name, listed = term.target.rpartition(".")[2], ", ".join(wanted)
    message = f"'{term.target}' takes ({', '.join(taken)}), but it is called with ({listed}) first"
    return [ConfigError(message, key=term.path, expected=f"def {name}({listed}, ...)")]


def _section_errors(section: str, term: binding.TermNode) -> list[ConfigError]:
    """Return an error for a stock term in a wrong section, such as a stock reward term in ``env.events``."""
    module, _, name = term.target.removeprefix(f"{LIBRARY}.").partition(".")
    belongs = MODULES.get(module) if term.target.startswith(f"{LIBRARY}.") else None
    if belongs is None or belongs == section:
        return []
    home = next(key for key, value in MODULES.items() if value == section)
    names = [n for n in vars(import_module(f"{LIBRARY}.{home}")) if not n.startswith("_")]
    nearest = nearest_name(name, names)
    message = f"'{term.target}' is a term of {belongs}"
    expected = f"a term of {LIBRARY}.{home}, or of a package of yours"
    nearest = f"{LIBRARY}.{home}.{nearest}" if nearest else None
    return [ConfigError(message, key=f"{term.path}.{binding.TARGET}", expected=expected, nearest=nearest)]


def import_target(target: str, path: str) -> Callable[..., object]:
    """Import the object of a ``_target_`` path; the error for a misspelled module names the most similar module."""
    try:
        return binding.resolve_target(target, path)
    except ConfigError as error:
        if error.nearest is None and isinstance(error.__cause__, ModuleNotFoundError):
            nearest = _nearest_target(target)
            error.nearest = nearest if nearest != target else None
        raise


def _nearest_target(target: str) -> str | None:
    """Return a ``_target_`` path with its misspelled module corrected; None if no module has a similar name."""
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


def check_nested_targets(config: Mapping[str, object]) -> Iterator[ConfigError]:
    """Yield the mistakes in ``_target_`` nodes that are not terms, such as sensors, actuators, and noise models."""
    terms = {path for _, path, _ in term_nodes(config)}
    for path, node in binding.walk_nodes(config):
        if binding.TARGET not in node or path in terms:
            continue
        try:
            yield from nested_errors(path, node, import_target(str(node[binding.TARGET]), path))
        except ConfigError as error:
            yield error


def check_links(config: Mapping[str, object]) -> Iterator[ConfigError]:
    """Yield an error for each parameter such as ``command_name`` whose value is not the name of an existing term."""
    for section, path, node in term_nodes(config):
        if not isinstance(node, Mapping):
            continue
        for name, value in node.items():
            kind = named_section(section, name)
            known = [str(term) for term in section_at(config, f"env.{kind}")]
            if kind is None or not isinstance(value, str) or value in known:
                continue
            message, key = f"there is no {kind.removesuffix('s')} '{value}'", f"{path}.{name}"
            expected = "one of " + ", ".join(known) if known else f"a term of env.{kind}; there is none"
            error = UnknownName(message, key=key, expected=expected, nearest=nearest_name(value, known))
            error.named = f"env.{kind}.{value}"
            yield error


def check_realism(config: Mapping[str, object]) -> list[ConfigError]:
    """Find misspelled names of terms, observation groups, and functions in ``env.realism``."""
    realism = at(config, "env.realism")
    if not isinstance(realism, Mapping):
        return []
    targets = [str(node.get(binding.TARGET)) for _, _, node in term_nodes(config) if isinstance(node, Mapping)]
    functions = {*vars(import_module("wheelleg_exp.mdp.observations")), *(name.rpartition(".")[2] for name in targets)}
    events = section_at(config, "env.events")
    known = {"events": events, "replaces": events, "curriculum": section_at(config, "env.curriculum")}
    known |= {"groups": section_at(config, "env.observations"), "sensors": dict.fromkeys(functions)}
    return [
        ConfigError(f"there is no '{name}'", key=f"env.realism.{key}", expected="an existing name", nearest=nearest)
        for key, names in known.items()
        for name in realism.get(key) or []
        # An override such as ~env.events.kicks removes a term that the variant still names.
        if name not in names and ((nearest := nearest_name(str(name), names)) or key == "sensors")
    ]


def check_groups_in_use(config: Mapping[str, object]) -> Iterator[ConfigError]:
    """Find observation groups that no neural network reads, and observation groups without terms."""
    groups, sets = at(config, "env.observations"), at(config, "agent.obs_groups")
    if not isinstance(groups, Mapping) or not isinstance(sets, Mapping):
        return
    used = {name for members in sets.values() if isinstance(members, list) for name in members}
    if not used <= set(groups) or not all(sets.values()):
        return  # If an observation group does not exist, another check reports this.
    if at(config, "agent.teacher") is not None:
        used |= set(groups)  # Distillation may keep the critic's observation groups, which no network reads.
    for name, group in groups.items():
        if name not in used and isinstance(group, Mapping) and "terms" in group:
            message, key = f"no network reads the observation group '{name}'", "agent.obs_groups"
            expected = "every group in some network's list, or no such group"
            yield ConfigError(message, key=f"{key}.{name}" if name in sets else key, expected=expected)
    for name, group in groups.items():
        if isinstance(group, Mapping) and group.get("terms") == {}:
            key = f"env.observations.{name}.terms"
            yield ConfigError("the group has no terms", key=key, expected="at least one term")


def recorded_errors(ids: object, count: object) -> Iterator[ConfigError]:
    """Yield the mistake in ``recording.env_ids`` if an id is repeated, or is outside 0 to ``count`` - 1."""
    if not isinstance(ids, list) or not isinstance(count, int) or not all(isinstance(i, int) for i in ids):
        return
    valid = ids and len(set(ids)) == len(ids) and all(0 <= i < count for i in ids)
    if count >= 1 and not valid:  # If env.num_envs is below 1, a separate type check reports this.
        expected = f"at least one environment, each once, from 0 to {count - 1}"
        yield ConfigError(f"is {ids}", key="recording.env_ids", expected=expected)


def require_recorded(config: Mapping[str, object]) -> None:
    """Raise ConfigError if ``recording.env_ids`` contains an environment that does not exist."""
    for error in recorded_errors(at(config, "recording.env_ids"), at(config, "env.num_envs")):
        raise error


def check_folders(config: Mapping[str, object]) -> Iterator[ConfigError]:
    """Yield the mistake in the config key ``run.root`` if this path cannot be a folder."""
    root = at(config, "run.root")
    places = (Path(root), *Path(root).parents) if isinstance(root, str) else ()
    wrong = next((place for place in places if place.exists() and not place.is_dir()), None)
    if wrong is not None:
        expected = "a folder, or a path where one can be made"
        yield ConfigError(f"'{wrong}' is a file", key="run.root", expected=expected)
