"""Checking ``agent``: the keys that rsl_rl reads, and the classes that it would import."""

from __future__ import annotations

import inspect
import re
import typing
from collections.abc import Collection, Iterator, Mapping
from typing import Any

from wheelleg_exp import terms
from wheelleg_exp.config import schema
from wheelleg_exp.config.sections import check_section, wrong_type
from wheelleg_exp.config.values import fits
from wheelleg_exp.errors import ConfigError, nearest_name
from wheelleg_exp.projects import make_importable

# Keys whose text rsl_rl imports and calls.
_CLASS_KEYS = ("class_name", "data_augmentation_func")
# Where the classes of an agent may come from, beside the packages of targets.
_LIBRARIES = ("rsl_rl", "wheelleg_exp.rl")
# Constructor parameters that rsl_rl passes itself.
_MODEL_INJECTED = ("self", "obs", "obs_groups", "obs_set", "output_dim", "cnns")
_ALGORITHM_INJECTED = (
    "self", "actor", "critic", "student", "teacher", "storage", "device", "multi_gpu_cfg",
)  # fmt: skip
# Parameters whose words rsl_rl looks up, and the function of its utils that does so.
RESOLVERS = {"activation": "resolve_nn_activation", "optimizer": "resolve_optimizer"}
# What rsl_rl takes without a word and then fails on, or passes over.
_AT_LEAST_ONE = ("num_learning_epochs", "num_mini_batches")
SCHEDULES = ("fixed", "adaptive")
_SETS = ("actor", "critic", "student", "teacher", "rnd_state")
_EXTRA_KEYS = {"algorithm": ("share_cnn_encoders",)}


def check_agent(agent: Any, groups: Collection[str]) -> list[ConfigError]:
    """Return the mistakes of the agent section.

    Args:
        agent: the section.
        groups: names of the observation groups, which ``obs_groups`` may name.
    """
    if not isinstance(agent, Mapping):
        return []
    errors = check_section("agent", agent, schema.Agent)
    for path, name in _class_names(agent, "agent"):
        errors += _check_class_name(path, name)
    errors += _check_groups(agent.get("obs_groups"), groups)
    if not errors:
        for section in ("algorithm", "actor", "critic", "student", "teacher"):
            errors += _check_constructor(f"agent.{section}", agent.get(section))
    return errors


def _check_groups(sets: Any, groups: Collection[str]) -> list[ConfigError]:
    named = list(sets.items()) if isinstance(sets, Mapping) and groups else []
    empty = [
        ConfigError("names no group", key=f"agent.obs_groups.{name}", expected="some of " + ", ".join(groups))
        for name, members in named
        if members == []
    ]
    empty += [
        ConfigError("names a group twice", key=f"agent.obs_groups.{name}", expected="each group once")
        for name, members in named
        if isinstance(members, list) and len({str(m) for m in members}) < len(members)
    ]
    unread = [
        ConfigError(
            "no network reads this set",
            key=f"agent.obs_groups.{name}",
            expected="one of " + ", ".join(_SETS),
            nearest=nearest_name(str(name), _SETS),
        )
        for name, _ in named
        if name not in _SETS
    ]
    return (
        empty
        + unread
        + [
            ConfigError(
                f"there is no observation group '{group}'",
                key=f"agent.obs_groups.{name}",
                expected="one of " + ", ".join(groups),
                nearest=nearest_name(str(group), groups),
            )
            for name, members in named
            for group in (members if isinstance(members, list) else [])
            if group not in groups
        ]
    )


def _class_names(node: Any, path: str) -> Iterator[tuple[str, Any]]:
    if isinstance(node, Mapping):
        for key, value in node.items():
            if key in _CLASS_KEYS and value is not None:
                yield f"{path}.{key}", value
            yield from _class_names(value, f"{path}.{key}")
    elif isinstance(node, (list, tuple)):
        for index, value in enumerate(node):
            yield from _class_names(value, f"{path}[{index}]")


def _check_class_name(path: str, name: Any) -> list[ConfigError]:
    """Refuse a class that is not rsl_rl's or an allowed package's own; only modules of these are imported."""
    packages = (*_LIBRARIES, *terms.allowed_packages())
    text = str(name).replace(":", ".")
    plain = re.fullmatch(r"[A-Za-z_]\w*", text) is not None
    expected = "a plain name such as PPO, or a class in " + ", ".join(packages)
    refused = ConfigError(f"class '{name}' is outside the allowed packages", key=path, expected=expected)
    if not plain and not _inside(text, packages):
        return [refused]
    make_importable(text)
    found = _resolve(name)
    if found is None:
        nearest = nearest_name(str(name), _library_names())
        return [ConfigError(f"there is no class '{name}'", key=path, expected=expected, nearest=nearest)]
    # What a module has only imported is not its own: a standard library function must not slip through.
    own = _inside(f"{getattr(found, '__module__', '')}.{text}", packages)
    return [] if own else [refused]


def _inside(name: str, packages: Collection[str]) -> bool:
    return any(name.startswith(f"{package}.") for package in packages)


def _resolve(name: Any) -> Any:
    from rsl_rl.utils import resolve_callable

    try:
        return resolve_callable(name)
    except (ImportError, AttributeError, ValueError, TypeError):
        return None


def _check_constructor(path: str, node: Any) -> list[ConfigError]:
    """Hold a section's keys against the constructor of its class."""
    if not isinstance(node, Mapping):
        return []
    if "class_name" not in node:
        return [ConfigError("this value is missing", key=f"{path}.class_name", expected="a class of rsl_rl")]
    return _check_parameters(path, node, _resolve(node["class_name"]))


def _check_parameters(path: str, node: Mapping[str, Any], found: Any) -> list[ConfigError]:
    accepted = _parameters(found, path.rsplit(".", 1)[-1])
    hints = typing.get_type_hints(found.__init__)
    errors = []
    for name, value in node.items():
        key = f"{path}.{name}"
        if name == "class_name" or accepted is None:
            continue
        if name not in accepted:
            errors.append(
                ConfigError(
                    f"'{node['class_name']}' takes no parameter '{name}'",
                    key=key,
                    expected="one of " + ", ".join(accepted),
                    nearest=nearest_name(str(name), accepted),
                )
            )
        elif name in hints and not fits(value, hints[name]):
            errors.append(wrong_type(key, value, hints[name]))
        elif name in RESOLVERS:
            errors += _check_word(key, value, RESOLVERS[name])
        else:
            errors += _check_range(key, name, value)
    return errors


def _check_range(key: str, name: str, value: Any) -> list[ConfigError]:
    if name == "learning_rate" and value <= 0:
        return [ConfigError(f"is {value}", key=key, expected="more than 0")]
    if name in _AT_LEAST_ONE and value < 1:
        return [ConfigError(f"is {value}", key=key, expected="at least 1")]
    if name == "hidden_dims" and (not value or min(value) < 1):
        return [ConfigError(f"is {list(value)}", key=key, expected="at least one layer, each of at least 1 unit")]
    if name == "schedule" and value not in SCHEDULES:
        nearest = nearest_name(str(value), SCHEDULES)
        return [ConfigError(f"'{value}' is not known", key=key, expected=" or ".join(SCHEDULES), nearest=nearest)]
    return []


def _check_word(path: str, value: Any, resolver: str) -> list[ConfigError]:
    """Ask rsl_rl whether it knows the name of an activation or an optimiser."""
    import rsl_rl.utils

    try:
        getattr(rsl_rl.utils, resolver)(value)
    except ValueError as error:
        names = re.findall(r"'([^']+)'", str(error).split("Valid")[-1])
        nearest = nearest_name(str(value), names)
        return [
            ConfigError(f"'{value}' is not known", key=path, expected="one of " + ", ".join(names), nearest=nearest)
        ]
    return []


def _parameters(found: Any, section: str) -> list[str] | None:
    """Return the names a constructor takes from the config; None when it takes any."""
    parameters = inspect.signature(found.__init__).parameters
    if any(p.kind is inspect.Parameter.VAR_KEYWORD for p in parameters.values()):
        return None
    injected = _ALGORITHM_INJECTED if section == "algorithm" else _MODEL_INJECTED
    return [name for name in parameters if name not in injected] + list(_EXTRA_KEYS.get(section, ()))


def _library_names() -> list[str]:
    from importlib import import_module

    modules = [import_module(f"rsl_rl.{part}") for part in ("algorithms", "models", "modules", "runners")]
    return [name for module in modules for name in dir(module) if not name.startswith("_")]
