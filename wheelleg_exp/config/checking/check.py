"""Every mistake in a composed config that can be found without simulating, all at once."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from wheelleg_exp.config import schema
from wheelleg_exp.config.checking.check_agent import check_agent
from wheelleg_exp.config.checking.check_hydra import unread_in_files
from wheelleg_exp.config.checking.check_links import (
    check_drawn,
    check_folders,
    check_groups_in_use,
    check_links,
    recorded_errors,
)
from wheelleg_exp.config.checking.check_mounts import (
    MountedFile,
    blame_mounts,
    check_group_lists,
    check_headers,
    check_listed_twice,
    check_order,
    check_overwritten,
    check_targets_of_files,
    check_term_files,
    emptied_by,
    mounted_files,
    without_strays,
)
from wheelleg_exp.config.checking.check_robot import check_robot
from wheelleg_exp.config.checking.check_terms import check_nested_targets, check_sections
from wheelleg_exp.config.checking.robot_names import read_names
from wheelleg_exp.config.composing.compose import Composed
from wheelleg_exp.config.problems import AbsentKey, UnknownName, override_of, raise_all
from wheelleg_exp.config.tree import at, dotted, section_at, show_file, split_path
from wheelleg_exp.errors import ConfigError, MissingValue, UnreadKey, nearest_name
from wheelleg_exp.terms.allowed_targets import NotAllowed
from wheelleg_exp.terms.sections import ObservationGroup, Section, section_errors
from wheelleg_exp.terms.values import value_errors


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
    config = without_strays(composed.config, files)
    errors = check_term_files(files) + check_targets_of_files(config, files) + check_group_lists(composed, files)
    hidden = {str(error.key) for error in errors}
    found = check_tree(config, schema.Root) + (check_order(composed, files) or check_overwritten(composed))
    found += check_listed_twice(files, composed)
    found += unread_in_files(files, composed.primary)
    found += check_groups_in_use(config) + check_folders(config) + _check_robot(config, composed.asset_roots)
    errors += [error for error in found if not follows_from(error, hidden)]
    return _placed(blame_mounts(_first_causes(errors), composed, files), composed, files)


def _first_causes(errors: Sequence[ConfigError]) -> list[ConfigError]:
    """Leave out what only follows from keys that nothing reads, unless it would run foreign code.

    That is what is told of their inside, and of a key that is missing because it is misspelled beside.
    """
    unread = [error for error in errors if isinstance(error, UnreadKey)]
    inside = tuple(f"{error.key}." for error in unread)
    meant = {dotted((*split_path(str(error.key))[:-1], error.nearest)) for error in unread if error.nearest}
    return [
        error
        for error in errors
        if isinstance(error, NotAllowed)
        or not (str(error.key).startswith(inside) or (isinstance(error, MissingValue) and error.key in meant))
    ]


def follows_from(error: ConfigError, lost: Collection[str]) -> bool:
    """Return whether an error speaks of a key whose content is not known: it may be no mistake at all.

    Args:
        error: the error.
        lost: keys whose content is not known; one that starts with a dot is a part of keys, wherever it stands; an
            empty one stands for all.
    """
    key = error.key or ""
    if isinstance(error, UnknownName) and is_at_or_below(error.named, lost):
        return True
    if isinstance(error, AbsentKey) and "" in lost:
        return True
    return is_at_or_below(key, lost) or (
        isinstance(error, MissingValue) and any(name.startswith(f"{key}.") for name in lost)
    )


def is_at_or_below(key: str, places: Collection[str]) -> bool:
    """Return whether a key is one of the places or below one; a place that starts with a dot may stand anywhere."""
    return any(f"{place}." in f".{key}." if place.startswith(".") else _below(key, place) for place in places)


def _below(key: str, place: str) -> bool:
    return f"{key}.".startswith(f"{place}.")


def _check_robot(config: Mapping[str, Any], asset_roots: Sequence[Path]) -> list[ConfigError]:
    """Hold names against the robot; nothing is said where the sections that name it are wrong themselves."""
    robot, scene = at(config, "env.robot"), at(config, "env.scene")
    if not isinstance(robot, Mapping) or not isinstance(scene, Mapping):
        return []
    if section_errors("env.robot", {name: robot[name] for name in ("asset", "base") if name in robot}, _Asset):
        return []
    try:
        names = read_names({"robot": robot, "scene": scene}, asset_roots)
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
    errors = section_errors("", config, root)
    for path in schema.OPTIONS:
        options = schema.options_of(path)
        node = at(config, path)
        if options is not None and isinstance(node, Mapping) and schema.is_open(root, path):
            errors += section_errors(path, node, options)
    errors += _check_observation_groups(config)
    errors += check_sections(config)
    errors += check_nested_targets(config)
    errors += check_links(config) + _check_silences(config)
    groups, num_envs = list(section_at(config, "env.observations")), at(config, "env.num_envs")
    errors += recorded_errors(at(config, "recording.env_ids"), num_envs) + check_drawn(config)
    return errors + check_agent(config.get("agent"), groups, num_envs)


def require_valid(composed: Composed) -> None:
    """Raise one ConfigError that tells every mistake ``check`` finds; several stand one a line."""
    errors = check(composed)
    if errors:
        raise_all(errors)


def _placed(errors: list[ConfigError], composed: Composed, files: Sequence[MountedFile]) -> list[ConfigError]:
    """Say where each value came from, and leave out what was found twice: one line may stand at several keys."""
    seen: dict[tuple[str | None, ...], ConfigError] = {}
    for error in errors:
        if error.where is None and error.key is not None:
            emptied = emptied_by(composed, error.key) if isinstance(error, MissingValue) else None
            error.where = emptied or composed.provenance.where(error.key)
        if error.where is None and isinstance(error, MissingValue):  # of what nobody has begun the task is the place
            error.where = next((show_file(file.file) for file in reversed(files) if file.group == "task"), None)
        place = str(error.key).rpartition(".")[2] if error.where and override_of(error) is None else error.key
        seen.setdefault((place, error.where, error.message), error)
    return list(seen.values())


def _check_silences(config: Mapping[str, Any]) -> list[ConfigError]:
    silences = section_at(config, "check.silence")
    return [
        ConfigError(
            "there is no such rule",
            key=f"check.silence.{name}",
            expected="a rule of `wheelleg check --list`",
            nearest=nearest_name(str(name), schema.PHYSICS_RULES),
        )
        for name in silences
        if name not in schema.PHYSICS_RULES
    ] + [
        ConfigError("a silence has no reason", key=f"check.silence.{name}", expected="why the finding is accepted")
        for name, reason in silences.items()
        if isinstance(reason, str) and not reason.strip()
    ]


def _check_observation_groups(config: Mapping[str, Any]) -> list[ConfigError]:
    groups = section_at(config, "env.observations")
    errors: list[ConfigError] = []
    for name, group in groups.items():
        path = f"env.observations.{name}"
        if isinstance(group, Mapping) and "terms" not in group and (near := _nearest_group(groups, name)):
            message = "there are settings for this group, and no terms are mounted in it"
            errors.append(ConfigError(message, key=path, expected="settings for " + ", ".join(groups), nearest=near))
        elif isinstance(group, Mapping):
            errors += section_errors(path, group, ObservationGroup)
        else:
            errors += value_errors(path, group, Section)
    return errors


def _nearest_group(groups: Mapping[str, Any], name: Any) -> str | None:
    """Return the observation group with terms whose name is most like one without."""
    return nearest_name(str(name), [str(n) for n, g in groups.items() if isinstance(g, Mapping) and "terms" in g])
