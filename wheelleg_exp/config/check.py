"""Every mistake in a composed config that can be found without simulating, all at once."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from wheelleg_exp.config import schema
from wheelleg_exp.config.check_agent import check_agent
from wheelleg_exp.config.check_terms import check_nested_targets, check_sections
from wheelleg_exp.config.compose import Composed
from wheelleg_exp.config.problems import raise_all
from wheelleg_exp.config.sections import check_section, wrong_type
from wheelleg_exp.errors import ConfigError


def check(composed: Composed) -> list[ConfigError]:
    """Return every mistake that can be found without simulating.

    Looks at the keys, types and ranges of the fixed part; at each term's target and parameters against the
    target's signature; at settings for terms that are not selected; at the allow-list of every target; and at
    the agent's classes. Each error names the file and line, or the override, that the value came from.
    """
    return _placed(check_tree(composed.config, schema.Root), composed)


def check_tree(config: Mapping[str, Any], root: type) -> list[ConfigError]:
    """Return every mistake of a plain tree whose top is that of the dataclass ``root``; places are not known."""
    errors = check_section("", config, root)
    for path in schema.OPTIONS:
        options = schema.options_of(path)
        node = _at(config, path)
        if options is not None and isinstance(node, Mapping) and schema.is_open(root, path):
            errors += check_section(path, node, options)
    errors += _check_observation_groups(config)
    errors += check_sections(config)
    errors += check_nested_targets(config)
    groups = _at(config, "env.observations")
    errors += check_agent(config.get("agent"), list(groups) if isinstance(groups, Mapping) else [])
    return errors


def require_valid(composed: Composed) -> None:
    """Raise one ConfigError that tells every mistake ``check`` finds; several stand one a line."""
    errors = check(composed)
    if errors:
        raise_all(errors)


def _at(config: Mapping[str, Any], path: str) -> Any:
    node: Any = config
    for key in path.split("."):
        node = node.get(key) if isinstance(node, Mapping) else None
    return node


def _placed(errors: list[ConfigError], composed: Composed) -> list[ConfigError]:
    """Say where each value came from, and leave out what was found twice."""
    seen: dict[str, ConfigError] = {}
    for error in errors:
        if error.where is None and error.key is not None:
            error.where = composed.provenance.where(error.key)
        seen.setdefault(f"{error.key}: {error.message}", error)
    return list(seen.values())


def _check_observation_groups(config: Mapping[str, Any]) -> list[ConfigError]:
    groups = _at(config, "env.observations")
    errors: list[ConfigError] = []
    for name, group in groups.items() if isinstance(groups, Mapping) else ():
        path = f"env.observations.{name}"
        if isinstance(group, Mapping):
            errors += check_section(path, group, schema.ObservationGroup)
        else:
            errors.append(wrong_type(path, group, schema.Section))
    return errors
