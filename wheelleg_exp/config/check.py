"""Every mistake in a composed config that can be found without simulating, all at once."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from wheelleg_exp.config import schema
from wheelleg_exp.config.check_agent import check_agent
from wheelleg_exp.config.check_links import check_folders, check_groups_in_use, check_links, check_recorded
from wheelleg_exp.config.check_mounts import (
    blame_mounts,
    check_headers,
    check_order,
    check_overwritten,
    check_term_files,
    emptied_by,
    mounted_files,
    stray_sections,
)
from wheelleg_exp.config.check_robot import check_robot
from wheelleg_exp.config.check_terms import check_nested_targets, check_sections
from wheelleg_exp.config.compose import Composed
from wheelleg_exp.config.problems import raise_all
from wheelleg_exp.config.robot_names import read_names
from wheelleg_exp.config.sections import NOTHING_READS, check_section, is_missing, wrong_type
from wheelleg_exp.config.tree import dotted, split_path
from wheelleg_exp.errors import ConfigError, nearest_name


def check(composed: Composed) -> list[ConfigError]:
    """Return every mistake that can be found without simulating.

    Looks at the keys, types and ranges of the fixed part; at each term's target and parameters against the
    target's signature; at settings for terms that are not selected; at the allow-list of every target; at the
    agent's classes and observation groups; at the names of joints, bodies and terms against the robot and the
    config; at the files' package lines, their terms and their order. Each error names the file and line, or the
    override, that the value came from.
    """
    files = mounted_files(composed)
    misplaced = check_headers(composed, files)
    if misplaced:  # all that stands in the wrong place would be told as well
        return misplaced
    errors = check_term_files(files)
    hidden = {str(error.key) for error in errors} | stray_sections(files)
    found = check_tree(composed.config, schema.Root) + (check_order(composed, files) or check_overwritten(composed))
    found += (
        check_groups_in_use(composed.config)
        + check_folders(composed.config)
        + check_recorded(composed.config)
        + _check_robot(composed)
    )
    errors += [error for error in found if not follows_from(error, hidden)]
    return _placed(blame_mounts(_first_causes(errors), composed, files), composed)


def _first_causes(errors: Sequence[ConfigError]) -> list[ConfigError]:
    """Leave out what only follows from keys that nothing reads, unless it would run foreign code.

    That is what is told of their inside, and of a key that is missing because it is misspelled beside.
    """
    unread = [error for error in errors if NOTHING_READS in error.message]
    inside = tuple(f"{error.key}." for error in unread)
    meant = {dotted((*split_path(str(error.key))[:-1], error.nearest)) for error in unread if error.nearest}
    return [
        error
        for error in errors
        if "allowed packages" in error.message
        or not (str(error.key).startswith(inside) or (is_missing(error) and error.key in meant))
    ]


def follows_from(error: ConfigError, lost: Collection[str]) -> bool:
    """Return whether an error speaks of a key whose content is not known: it may be no mistake at all.

    Args:
        error: the error.
        lost: keys whose content is not known; one that starts with a dot is a part of keys, wherever it stands.
    """
    key = error.key or ""
    return is_at_or_below(key, lost) or (is_missing(error) and any(name.startswith(f"{key}.") for name in lost))


def is_at_or_below(key: str, places: Collection[str]) -> bool:
    """Return whether a key is one of the places or below one; a place that starts with a dot may stand anywhere."""
    return any(f"{place}." in f".{key}." if place.startswith(".") else _below(key, place) for place in places)


def _below(key: str, place: str) -> bool:
    return f"{key}.".startswith(f"{place}.")


def _check_robot(composed: Composed) -> list[ConfigError]:
    """Hold names against the robot; nothing is said where the sections that name it are wrong themselves."""
    config = composed.config
    robot, scene = _at(config, "env.robot"), _at(config, "env.scene")
    if not isinstance(robot, Mapping) or not isinstance(scene, Mapping):
        return []
    if check_section("env.robot", {name: robot[name] for name in ("asset", "base") if name in robot}, _Asset):
        return []
    try:
        names = read_names(robot, composed.asset_roots)
    except ConfigError as error:
        return [error]
    return check_robot(config, names)


@dataclass(frozen=True)
class _Asset:
    """What reading the robot's names needs."""

    asset: str
    base: Literal["auto", "floating", "fixed"] = "auto"


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
    errors += check_links(config) + _check_silences(config)
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
            emptied = emptied_by(composed, error.key) if is_missing(error) else None
            error.where = emptied or composed.provenance.where(error.key)
        seen.setdefault(f"{error.key}: {error.message}", error)
    return list(seen.values())


def _check_silences(config: Mapping[str, Any]) -> list[ConfigError]:
    silences = _at(config, "check.silence")
    return [
        ConfigError(
            "there is no such rule",
            key=f"check.silence.{name}",
            expected="a rule of `wheelleg check --list`",
            nearest=nearest_name(str(name), schema.PHYSICS_RULES),
        )
        for name in (silences if isinstance(silences, Mapping) else ())
        if name not in schema.PHYSICS_RULES
    ] + [
        ConfigError("a silence has no reason", key=f"check.silence.{name}", expected="why the finding is accepted")
        for name, reason in (silences.items() if isinstance(silences, Mapping) else ())
        if isinstance(reason, str) and not reason.strip()
    ]


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
