"""Find every mistake in a config without a simulation, and report all of them at once."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Literal

from wheelleg_exp.config import schema
from wheelleg_exp.config.checking import check_defaults_lists as lists
from wheelleg_exp.config.checking import check_terms
from wheelleg_exp.config.checking.check_agent import check_agent
from wheelleg_exp.config.checking.check_robot_names import check_robot, read_names
from wheelleg_exp.config.composing.compose import Composed, compose_leniently
from wheelleg_exp.config.composing.config_loader import missing_headers, package_header
from wheelleg_exp.config.config_errors import follows_from, override_of, raise_all
from wheelleg_exp.config.tree_lookup import at, section_at
from wheelleg_exp.constraints import Count
from wheelleg_exp.errors import ConfigError, MissingValue, UnreadKey, nearest_name
from wheelleg_exp.paths import show_file
from wheelleg_exp.rendering.renderer import too_many
from wheelleg_exp.rl.options import batch_errors, read_agent
from wheelleg_exp.terms.config_sections import section_errors
from wheelleg_exp.terms.config_values import fits
from wheelleg_exp.terms.key_syntax import dotted, split_path
from wheelleg_exp.terms.term_binding import NotAllowed


def check(composed: Composed) -> list[ConfigError]:
    """Return every mistake in a composed config that can be found without a simulation.

    Each returned error contains the file and line, or the override, of the wrong value.
    """
    files = composed.loader.files
    # A config file needs no `# @package` line if a defaults list selects the file with `group@package`.
    needing = {f.config_path for f in files if f.package in (f.group.replace("/", "."), package_header(f.file))}
    if misplaced := [e for e in missing_headers(composed.loader.repository_used, ()) if e.key in needing]:
        # A config file at a wrong key causes many errors about other keys, so report only misplaced files.
        return misplaced
    config = lists.without_strays(composed.config, files)
    errors = [*lists.check_term_files(files), *lists.check_targets_of_files(config, files)]
    errors += lists.check_group_lists(composed, files)
    hidden = {str(error.key) for error in errors}
    found = check_tree(config, schema.Experiment)
    found += list(lists.check_order(composed, files)) or lists.check_overwritten(composed)
    found += [*lists.check_listed_twice(files, composed), *lists.check_merged_mappings(composed, files)]
    found += lists.unread_in_files(files, composed.primary)
    found += [*check_terms.check_groups_in_use(config), *check_terms.check_folders(config)]
    found += _check_robot(config, composed.asset_roots)
    errors += [error for error in found if not follows_from(error, hidden)]
    # Add the place of the wrong value (file and line, or override) to each config error, and remove repeated errors.
    errors = lists.blame_mounts(_first_causes(errors), composed, files)
    seen: dict[tuple[str | None, ...], ConfigError] = {}
    for error in errors:
        if error.where is None and error.key is not None:
            emptied = lists.emptied_by(composed, error.key) if isinstance(error, MissingValue) else None
            error.where = emptied or composed.provenance.where(error.key)
        # In the error for a missing config section, name the task's file, which should set the section.
        if error.where is None and isinstance(error, MissingValue):
            error.where = next((show_file(file.file) for file in reversed(files) if file.group == "task"), None)
        place = str(error.key).rpartition(".")[2] if error.where and override_of(error) is None else error.key
        seen.setdefault((place, error.where, error.message), error)
    return list(seen.values())


def _first_causes(errors: Sequence[ConfigError]) -> list[ConfigError]:
    """Remove errors that another one causes, such as a missing ``weight`` if the config has a misspelled ``wieght``."""
    unread = [error for error in errors if isinstance(error, UnreadKey)]
    inside = tuple(f"{error.key}." for error in unread)
    meant = {dotted((*split_path(str(error.key))[:-1], error.nearest)) for error in unread if error.nearest}
    return [
        error
        for error in errors
        if isinstance(error, NotAllowed)
        or not (str(error.key).startswith(inside) or (isinstance(error, MissingValue) and error.key in meant))
    ]


def _check_robot(config: Mapping[str, object], asset_roots: Sequence[Path]) -> list[ConfigError]:
    robot, scene = at(config, "env.robot"), at(config, "env.scene")
    if not isinstance(robot, Mapping) or not isinstance(scene, Mapping):
        return []
    base = robot.get("base", "auto")
    if not fits(robot.get("asset"), str) or not fits(base, Literal["auto", "floating", "fixed"]):
        return []
    try:
        names = read_names({"robot": robot, "scene": scene}, asset_roots)
    except ConfigError as error:
        return [error]
    return check_robot(config, names)


def check_tree(config: Mapping[str, object], root: type) -> list[ConfigError]:
    """Return the mistakes in a config tree, without file and line; ``root`` is the dataclass of the top-level keys."""
    unmounted = {str(error.key): error for error in _groups_without_terms(config)}
    errors = [e for e in section_errors("", config, root) if str(e.key).rpartition(".")[0] not in unmounted]
    errors += unmounted.values()
    errors += check_terms.check_sections(config)
    errors += check_terms.check_nested_targets(config)
    errors += [*check_terms.check_links(config), *check_terms.check_realism(config)]
    for name, reason in section_at(config, "check.silence").items():
        key = f"check.silence.{name}"
        if name not in schema.PHYSICS_RULES:
            expected, nearest = "a rule of `wheelleg check --list`", nearest_name(str(name), schema.PHYSICS_RULES)
            errors.append(ConfigError("there is no such rule", key=key, expected=expected, nearest=nearest))
        elif isinstance(reason, str) and not reason.strip():
            errors.append(ConfigError("a silenced rule has no reason", key=key, expected="why the finding is accepted"))
    groups, num_envs = list(section_at(config, "env.observations")), at(config, "env.num_envs")
    errors += check_terms.recorded_errors(at(config, "recording.env_ids"), num_envs)
    for name, node in section_at(config, "env.scene.sensors").items():
        most = node.get("max_num_envs") if isinstance(node, Mapping) else None
        if isinstance(num_envs, int) and isinstance(most, int):  # a camera, which renders at most this many
            errors += filter(None, [too_many(num_envs, most, f"env.scene.sensors.{name}")])
    errors += check_agent(config.get("agent"), groups)
    if fits(num_envs, Count) and not any(f"{error.key}.".startswith("agent.") for error in errors):
        errors += batch_errors(read_agent(section_at(config, "agent")), int(str(num_envs)))
    return sorted(errors, key=lambda error: f"{error.key}.".startswith("agent."))


def _groups_without_terms(config: Mapping[str, object]) -> Iterator[ConfigError]:
    """Yield an error for each observation group that has settings, no terms, and a name similar to another group's."""
    groups = section_at(config, "env.observations")
    with_terms = [str(n) for n, g in groups.items() if isinstance(g, Mapping) and "terms" in g]
    for name, group in groups.items():
        if isinstance(group, Mapping) and "terms" not in group and (near := nearest_name(str(name), with_terms)):
            key, expected = f"env.observations.{name}", "settings for " + ", ".join(groups)
            message = "there are settings for this group, and no terms are mounted in it"
            yield ConfigError(message, key=key, expected=expected, nearest=near)


def find_mistakes(
    overrides: Sequence[str] = (), *, primary: str = "train", config_dirs: Sequence[Path] = ()
) -> tuple[Composed | None, list[ConfigError]]:
    """Compose and check a config, and return the config (None if it has mistakes) and all mistakes.

    Overrides and files that Hydra cannot compose are left out; errors that these can cause are not returned.
    """
    composed, problems, lost = compose_leniently(overrides, primary, config_dirs)
    behind = [] if composed is None or "" in lost else check(composed)
    found = [*problems, *(error for error in behind if not follows_from(error, lost))]
    return (composed if not problems else None), list({str(error): error for error in found}.values())


def compose_valid(overrides: Sequence[str] = (), *, config_dirs: Sequence[Path] = ()) -> Composed:
    """Compose a config, check the config, and return the config. One ConfigError lists all mistakes in the config."""
    composed, mistakes = find_mistakes(overrides, config_dirs=config_dirs)
    if mistakes:
        raise_all(mistakes)
    assert composed is not None
    return composed
