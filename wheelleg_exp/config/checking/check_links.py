"""Checking what names other parts of the config: commands, action terms, rewards, observation groups, folders."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from wheelleg_exp.config.checking.check_terms import term_nodes
from wheelleg_exp.config.keys import named_section
from wheelleg_exp.config.problems import UnknownName
from wheelleg_exp.config.tree import at, section_at
from wheelleg_exp.errors import ConfigError, nearest_name
from wheelleg_exp.rendering.limits import too_many


def check_links(config: Mapping[str, Any]) -> list[ConfigError]:
    """Return the mistakes of parameters that name terms of other sections."""
    errors = []
    for section, path, node in term_nodes(config):
        if not isinstance(node, Mapping):
            continue
        for name, value in node.items():
            kind = named_section(section, name)
            if kind is not None and isinstance(value, str):
                errors += _unknown_term(config, kind, f"{path}.{name}", value)
    return errors


def _unknown_term(config: Mapping[str, Any], kind: str, key: str, name: str) -> list[ConfigError]:
    known = [str(term) for term in section_at(config, f"env.{kind}")]
    if name in known:
        return []
    what = kind.removesuffix("s")
    expected = "one of " + ", ".join(known) if known else f"a term of env.{kind}; there is none"
    error = UnknownName(f"there is no {what} '{name}'", key=key, expected=expected, nearest=nearest_name(name, known))
    error.named = f"env.{kind}.{name}"
    return [error]


def check_groups_in_use(config: Mapping[str, Any]) -> list[ConfigError]:
    """Return the observation groups that no network gets, and those without a term."""
    groups, sets = at(config, "env.observations"), at(config, "agent.obs_groups")
    if not isinstance(groups, Mapping) or not isinstance(sets, Mapping):
        return []
    used = {name for members in sets.values() if isinstance(members, list) for name in members}
    if not used <= set(groups) or not all(sets.values()):
        return []  # a misspelled group is told where it stands
    if at(config, "agent.teacher") is not None:  # a student's task is its teacher's, whose critic is gone
        used |= set(groups)
    unused = [
        ConfigError(
            f"no network gets the observation group '{name}'",
            key=f"agent.obs_groups.{name}" if name in sets else "agent.obs_groups",
            expected="every group in some network's list, or no such group",
            nearest=nearest_name(str(name), [str(n) for n in used if n not in groups]),
        )
        for name, group in groups.items()
        if name not in used and isinstance(group, Mapping) and "terms" in group
    ]
    return unused + [
        ConfigError("the group has no terms", key=f"env.observations.{name}.terms", expected="at least one term")
        for name, group in groups.items()
        if isinstance(group, Mapping) and group.get("terms") == {}
    ]


def recorded_errors(ids: Any, count: Any) -> list[ConfigError]:
    """Return the mistake of environments that are to be recorded and are not among as many as there are."""
    if not isinstance(ids, list) or not isinstance(count, int) or not all(isinstance(i, int) for i in ids):
        return []
    if count < 1:
        return []  # told elsewhere
    if ids and len(set(ids)) == len(ids) and all(0 <= i < count for i in ids):
        return []
    expected = f"at least one environment, each once, from 0 to {count - 1}"
    return [ConfigError(f"is {ids}", key="recording.env_ids", expected=expected)]


def require_recorded(config: Mapping[str, Any]) -> None:
    """Raise the mistake of a config's recorded environments, of a config that need not have been checked."""
    for error in recorded_errors(at(config, "recording.env_ids"), at(config, "env.num_envs")):
        raise error


def check_drawn(config: Mapping[str, Any]) -> list[ConfigError]:
    """Return the mistakes of cameras that would draw more environments than they may."""
    count, sensors = at(config, "env.num_envs"), section_at(config, "env.scene.sensors")
    limits = {name: node.get("max_num_envs") for name, node in sensors.items() if isinstance(node, Mapping)}
    found = (
        too_many(count, limit, f"env.scene.sensors.{name}")
        for name, limit in limits.items()
        if isinstance(count, int) and isinstance(limit, int)
    )
    return [error for error in found if error is not None]


def check_folders(config: Mapping[str, Any]) -> list[ConfigError]:
    """Return the mistake of a run root that cannot become a folder."""
    root = at(config, "run.root")
    if not isinstance(root, str):
        return []
    path = Path(root)
    wrong = next((place for place in (path, *path.parents) if place.exists() and not place.is_dir()), None)
    if wrong is None:
        return []
    return [ConfigError(f"'{wrong}' is a file", key="run.root", expected="a folder, or a path where one can be made")]
