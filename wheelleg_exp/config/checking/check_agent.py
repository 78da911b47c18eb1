"""Check ``agent``: the keys that rsl_rl reads, and the classes that it imports."""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Collection, Iterator, Mapping

from wheelleg_exp.config.key_slots import EXTENSIONS, REQUIRED, class_packages, class_slots, extension_of, rsl_class
from wheelleg_exp.config.tree_lookup import section_at
from wheelleg_exp.errors import ConfigError, MissingValue, nearest_name, not_one_of
from wheelleg_exp.rl.options import PARAMETERS, parameter_errors
from wheelleg_exp.terms import term_binding
from wheelleg_exp.terms.config_values import value_errors
from wheelleg_exp.terms.term_binding import resolve_class, walk_nodes

# The values of ``class_name`` and ``data_augmentation_func`` name classes and functions that rsl_rl imports.
_CLASS_KEYS = ("class_name", "data_augmentation_func")
# ``RESOLVERS`` maps an rsl_rl parameter to the function of rsl_rl.utils that looks up the parameter's value.
RESOLVERS = {"activation": "resolve_nn_activation", "optimizer": "resolve_optimizer"}
_DISTRIBUTION = "distribution_cfg"
_MIRROR = "wheelleg_exp.rl.symmetry.left_right"
_SETS = ("actor", "critic", "student", "teacher", "rnd_state")


def check_agent(agent: object, groups: Collection[str]) -> list[ConfigError]:
    """Return the mistakes in the config section ``agent``; ``groups`` contains the names of the observation groups."""
    from wheelleg_exp.rl import mirror_rules

    if not isinstance(agent, Mapping):
        return []
    errors = list(parameter_errors(agent))
    for path, node in walk_nodes(agent, "agent"):
        for key in _CLASS_KEYS:
            errors += _check_class_name(f"{path}.{key}", node[key]) if node.get(key) is not None else []
    sets, empty, unread, unknown = agent.get("obs_groups"), [], [], []
    for name, members in sets.items() if isinstance(sets, Mapping) and groups else ():
        key, listed = f"agent.obs_groups.{name}", members if isinstance(members, list) else []
        if members == []:
            message, expected = "the set names no observation group", "some of " + ", ".join(groups)
            empty.append(ConfigError(message, key=key, expected=expected))
        if len({str(group) for group in listed}) < len(listed):
            empty.append(ConfigError("the set names a group twice", key=key, expected="each group once"))
        if name not in _SETS:
            unread.append(not_one_of("no network reads this set", name, _SETS, key=key))
        strange = [group for group in listed if group not in groups]
        unknown += [not_one_of(f"there is no observation group '{group}'", group, groups, key=key) for group in strange]
    errors += empty + unread + unknown
    for name in EXTENSIONS:
        algorithm = agent.get("algorithm")
        options = algorithm.get(name) if isinstance(algorithm, Mapping) else None
        path, found = f"agent.algorithm.{name}", extension_of(("agent", "algorithm", name))
        if not isinstance(options, Mapping) or found is None:
            continue
        errors += _check_parameters(path, options, found)
        absent = [k for k, slot in class_slots(found, name).items() if slot.default is REQUIRED and k not in options]
        errors += [MissingValue(key=f"{path}.{k}", expected=f"a value that {EXTENSIONS[name]} needs") for k in absent]
        if name == "symmetry_cfg" and options.get("data_augmentation_func") == _MIRROR and not agent.get("symmetry"):
            expected = "joint_pairs, which name the mirror image of each joint"
            errors.append(MissingValue(key="agent.symmetry", expected=expected))
        if name == "rnd_cfg" and isinstance(sets, Mapping) and not sets.get("rnd_state"):
            expected = "the observation groups whose novelty is rewarded"
            errors.append(MissingValue(key="agent.obs_groups.rnd_state", expected=expected))
    for name, rule in section_at(agent, ("symmetry", "terms")).items():
        if isinstance(rule, str) and rule not in mirror_rules.RULE_NAMES:
            errors.append(mirror_rules.unknown_rule_error(rule, str(name)))
    for section in ("algorithm", "actor", "critic", "student", "teacher"):
        errors += _check_constructor(f"agent.{section}", agent.get(section))
    return errors


def _check_class_name(path: str, name: object) -> list[ConfigError]:
    # Reject a class outside the allowed packages without importing the class, because an import runs code.
    packages = class_packages()
    text = str(name).replace(":", ".")
    plain = re.fullmatch(r"[A-Za-z_]\w*", text) is not None
    expected = "a plain name such as PPO, or a class in " + ", ".join(packages)
    refused = term_binding.NotAllowed(f"class '{name}' is outside the allowed packages", key=path, expected=expected)
    if not plain and not term_binding.is_inside(text, packages):
        return [refused]
    try:
        found = resolve_class(name)
    except ConfigError as error:
        error.key = error.key or path
        return [error]
    if found is None:
        from importlib import import_module

        modules = [import_module(f"rsl_rl.{part}") for part in ("algorithms", "models", "modules", "runners")]
        names = [known for module in modules for known in dir(module) if not known.startswith("_")]
        nearest = nearest_name(str(name), [*names, _MIRROR])
        return [ConfigError(f"there is no class '{name}'", key=path, expected=expected, nearest=nearest)]
    # A module of an allowed package can import a class of a forbidden package, so check where the class is defined.
    defined_there = term_binding.is_inside(f"{getattr(found, '__module__', '')}.{text}", packages)
    return [] if defined_there else [refused]


def _check_constructor(path: str, node: object) -> Iterator[ConfigError]:
    if not isinstance(node, Mapping):
        return
    if "class_name" not in node:
        yield MissingValue(key=f"{path}.class_name", expected="a class of rsl_rl")
        return
    found = rsl_class(node["class_name"])
    if found is None:
        return  # If the class does not exist, ``_check_class_name`` reports this.
    yield from _check_parameters(path, node, found)
    # rsl_rl accepts an actor without an action distribution, but cannot train such an actor.
    is_actor = path in ("agent.actor", "agent.student")
    draws = is_actor and not _takes_any(found) and _DISTRIBUTION in class_slots(found, "actor")
    if draws and node.get(_DISTRIBUTION) is None:
        expected = "the distribution of the actions, such as {class_name: GaussianDistribution}"
        yield MissingValue(key=f"{path}.{_DISTRIBUTION}", expected=expected)


def _check_parameters(path: str, node: Mapping[str, object], found: Callable[..., object]) -> Iterator[ConfigError]:
    accepted = class_slots(found, path.rsplit(".", 1)[-1])
    for name, value in node.items() if not _takes_any(found) else ():
        key = f"{path}.{name}"
        if name == "class_name":
            continue
        if name not in accepted:
            message = f"'{node.get('class_name', found.__name__)}' takes no parameter '{name}'"
            yield not_one_of(message, name, accepted, key=key)
        elif isinstance(value, Mapping) and "class_name" in value:
            yield from _check_constructor(key, value)
        elif name not in PARAMETERS:  # ``parameter_errors`` checks the rsl_rl parameters in ``PARAMETERS``.
            wrong = value_errors(key, value, accepted[name].annotation)
            words = known_words(name, value) if name in RESOLVERS and not wrong else None
            yield from wrong if words is None else [not_one_of(f"'{value}' is not known", value, words, key=key)]


def _takes_any(found: Callable[..., object]) -> bool:
    from rsl_rl.algorithms import Distillation

    parameters = inspect.signature(found.__init__).parameters.values()
    # The constructor of rsl_rl's class Distillation accepts unknown keyword arguments, but ignores them.
    return found is not Distillation and any(p.kind is inspect.Parameter.VAR_KEYWORD for p in parameters)


def known_words(name: str, value: object = "?") -> list[str] | None:
    """Return None if rsl_rl knows the activation or optimiser ``value``; otherwise return all names that it knows."""
    import rsl_rl.utils

    try:
        getattr(rsl_rl.utils, RESOLVERS[name])(value)
    except ValueError as error:
        return re.findall(r"'([^']+)'", str(error).split("Valid")[-1])
    return None
