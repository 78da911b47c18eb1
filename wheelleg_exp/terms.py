"""What a term node is: a flat mapping of ``_target_``, the manager's own fields, and the term's parameters.

Free of torch and MuJoCo, because the config commands read it as well as the managers.
"""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

from wheelleg_exp import projects
from wheelleg_exp.errors import ConfigError, nearest_name

TARGET = "_target_"

# Names that a manager keeps for itself; no target may use one as a parameter.
RESERVED: dict[str, tuple[str, ...]] = {
    "commands": (),
    "actions": (),
    "observations": ("modifiers", "noise", "clip", "scale", "history_length", "flatten_history_dim"),
    "events": ("mode", "interval_range_s", "is_global_time", "min_step_count_between_reset"),
    "rewards": ("weight",),
    "terminations": ("time_out",),
    "curriculum": (),
}

# What a manager passes to every target; never written in a config.
INJECTED = ("env", "env_ids", "generator")

ENTRY_POINT_GROUP = projects.ENTRY_POINT_GROUP

# A config may build terms, noise, entities, actuators and sensors, but call nothing else of this package.
_OWN_PACKAGES = ("wheelleg_exp.mdp", "wheelleg_exp.managers", "wheelleg_exp.sim")


@dataclass(frozen=True)
class TermNode:
    """A term node, split: ``fields`` are the manager's, ``params`` go to the target."""

    name: str
    path: str
    target: str
    fields: dict[str, Any] = field(default_factory=dict)
    params: dict[str, Any] = field(default_factory=dict)


def drop_removed(config: dict[str, Any]) -> tuple[str, ...]:
    """Take null terms out of a tree, give absent sections an empty mapping, and return the paths that were null."""
    env = config.get("env")
    if not isinstance(env, dict):
        return ()
    removed: list[str] = []
    for section in RESERVED:
        if env.get(section) is None:
            env[section] = {}
        removed += _drop_null(env, section, "env")
    groups = env["observations"]
    if isinstance(groups, dict):
        for name, group in groups.items():
            if isinstance(group, dict) and "terms" in group:
                group["terms"] = {} if group["terms"] is None else group["terms"]
                removed += _drop_null(group, "terms", f"env.observations.{name}")
    return tuple(removed)


def _drop_null(parent: dict[str, Any], key: str, path: str) -> list[str]:
    section = parent[key]
    if not isinstance(section, dict):
        return []
    parent[key] = {name: node for name, node in section.items() if node is not None}
    return [f"{path}.{key}.{name}" for name, node in section.items() if node is None]


def split_node(kind: str, path: str, node: Any) -> TermNode:
    """Split one term node into the manager's fields and the target's parameters.

    Args:
        kind: a key of ``RESERVED``, the section that the node stands in.
        path: the node's config key, such as ``env.rewards.alive``.
        node: the composed mapping.

    Raises:
        ConfigError: the node is no mapping or has no target.
    """
    if not isinstance(node, Mapping):
        raise ConfigError(f"a term must be a mapping, not {node!r}", key=path, expected="_target_ and parameters")
    if TARGET not in node:
        raise ConfigError(
            "there are settings for this term, but the term is not selected (it has no _target_)",
            key=path,
            expected=f"the term in the task's list of {kind}, or no settings for it",
        )
    reserved = RESERVED[kind]
    fields = {k: v for k, v in node.items() if k in reserved}
    params = {k: v for k, v in node.items() if k not in reserved and k != TARGET}
    return TermNode(path.rsplit(".", 1)[-1], path, str(node[TARGET]), fields, params)


def allowed_packages() -> tuple[str, ...]:
    """Return the packages that targets may come from: this one's terms, and those that declare themselves.

    A user's package joins by an entry point in the group ``wheelleg_exp.packages``, whose value is its name: installed,
    or in the ``pyproject.toml`` of the project whose configs are in use (see ``projects``).
    """
    return tuple(dict.fromkeys((*_OWN_PACKAGES, *_declared_packages(), *projects.joined_packages())))


@functools.cache
def _declared_packages() -> tuple[str, ...]:
    """Read the declarations of every installed distribution, once: it takes a millisecond."""
    return projects.installed_packages()


def require_allowed(target: str, path: str) -> None:
    """Raise ConfigError unless ``target`` lies in an allowed package, so that a config runs no other code."""
    packages = allowed_packages()
    if not _inside(target, packages):
        raise ConfigError(
            f"target '{target}' is outside the allowed packages",
            key=f"{path}.{TARGET}",
            expected="a target in " + ", ".join(packages),
            nearest=None,
        )


def _inside(name: str, packages: tuple[str, ...]) -> bool:
    return any(name.startswith(f"{package}.") for package in packages)


def walk_targets(node: Any, path: str = "") -> Iterator[tuple[str, str]]:
    """Yield ``(path, target)`` for every ``_target_`` at or below ``node``."""
    if isinstance(node, Mapping):
        if TARGET in node:
            yield path, str(node[TARGET])
        for key, value in node.items():
            yield from walk_targets(value, f"{path}.{key}" if path else str(key))
    elif isinstance(node, (list, tuple)):
        for index, value in enumerate(node):
            yield from walk_targets(value, f"{path}[{index}]")


def resolve_target(target: str, path: str) -> Callable[..., Any]:
    """Import and return an allowed target.

    Raises:
        ConfigError: the target is not allowed, does not exist, or is not callable.
    """
    require_allowed(target, path)
    module_name, _, attribute = target.rpartition(".")
    try:
        projects.make_importable(target)
    except ConfigError as error:
        error.key = error.key or f"{path}.{TARGET}"
        raise
    try:
        module = __import__(module_name, fromlist=[attribute])
    except Exception as error:  # a user's module may fail in any way
        raise ConfigError(
            f"cannot import '{module_name}': {error}", key=f"{path}.{TARGET}", expected="package.module.name"
        ) from error
    found = getattr(module, attribute, None)
    if not callable(found):
        public = [n for n in dir(module) if not n.startswith("_") and callable(getattr(module, n))]
        raise ConfigError(
            f"'{module_name}' has no callable '{attribute}'",
            key=f"{path}.{TARGET}",
            nearest=nearest_name(attribute, public),
        )
    # What a module has only imported is not its own: a standard library function must not slip through.
    require_allowed(f"{getattr(found, '__module__', None) or module_name}.{attribute}", path)
    return found


def signature_parameters(target: Callable[..., Any]) -> dict[str, inspect.Parameter]:
    """Return the parameters of ``target`` that a config may set."""
    parameters = inspect.signature(target).parameters.values()
    open_ended = (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)
    return {p.name: p for p in parameters if p.name not in INJECTED and p.kind not in open_ended}


def check_parameters(kind: str, node: TermNode, target: Callable[..., Any]) -> None:
    """Hold a node's parameters against its target's signature.

    Raises:
        ConfigError: the target uses a reserved name, or a parameter is unknown or missing.
    """
    accepted = signature_parameters(target)
    for name in accepted:
        if name in RESERVED[kind]:
            raise ConfigError(
                f"'{node.target}' has a parameter '{name}', a name that the manager keeps for itself",
                key=node.path,
                expected="a target without parameters named " + ", ".join(RESERVED[kind]),
            )
    for name in node.params:
        if name not in accepted:
            known = [*accepted, *RESERVED[kind]]
            raise ConfigError(
                f"'{node.target}' takes no parameter '{name}'",
                key=f"{node.path}.{name}",
                expected="one of " + ", ".join(known) if known else "no parameters",
                nearest=nearest_name(name, known),
            )
    missing = [n for n, p in accepted.items() if p.default is inspect.Parameter.empty and n not in node.params]
    if missing:
        raise ConfigError(
            f"'{node.target}' needs " + ", ".join(f"'{n}'" for n in missing),
            key=node.path,
            expected="a value for each parameter without a default",
        )
