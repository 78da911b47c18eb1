"""Find every mistake in a config without a simulation, and report all of them at once."""

from __future__ import annotations

import copy
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Literal

from wheelleg_exp.config import schema
from wheelleg_exp.config import tree_lookup as lookup
from wheelleg_exp.config.checking import check_terms
from wheelleg_exp.config.checking.check_agent import check_agent
from wheelleg_exp.config.checking.check_robot_names import check_robot, read_names
from wheelleg_exp.config.composing.compose import Composed, compose_leniently, is_unread, unread_setting
from wheelleg_exp.config.composing.config_loader import missing_headers, package_header
from wheelleg_exp.config.composing.hydra_errors import place_of_option, where_of
from wheelleg_exp.config.composing.provenance import ConfigFile
from wheelleg_exp.config.config_errors import follows_from, override_of, raise_all
from wheelleg_exp.config.tree_lookup import at, defaults_entries, leaves, line_table, section_at, self_before_others
from wheelleg_exp.constraints import Count
from wheelleg_exp.errors import ConfigError, MissingValue, UnreadKey, nearest_name
from wheelleg_exp.paths import show_file
from wheelleg_exp.rendering.renderer import too_many
from wheelleg_exp.rl.options import batch_errors, read_agent
from wheelleg_exp.terms.config_sections import section_errors
from wheelleg_exp.terms.config_values import fits
from wheelleg_exp.terms.key_syntax import Keys, dotted, split_path
from wheelleg_exp.terms.term_binding import RESERVED, TARGET, NotAllowed, NotSelected, split_node


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
    # Leave out misplaced term parameters, such as ``env.rewards.weight`` outside of any reward term.
    config = copy.deepcopy(dict(composed.config))
    for file in files:
        section = at(config, file.package) if _is_term_list(file.package) and TARGET in file.content else None
        if isinstance(section, dict):
            for key in file.content:
                section.pop(key, None)
    errors = [*check_term_files(files), *check_targets_of_files(config, files)]
    errors += check_group_lists(composed, files)
    hidden = {str(error.key) for error in errors}
    found = check_tree(config, schema.Experiment)
    found += list(check_order(composed, files)) or check_overwritten(composed)
    found += [*check_listed_twice(files, composed), *check_merged_mappings(composed, files)]
    found += unread_in_files(files, composed.primary)
    found += [*check_terms.check_groups_in_use(config), *check_terms.check_folders(config)]
    found += _check_robot(config, composed.asset_roots)
    errors += [error for error in found if not follows_from(error, hidden)]
    # Add the place of the wrong value (file and line, or override) to each config error, and remove repeated errors.
    errors = blame_mounts(_first_causes(errors), composed, files)
    seen: dict[tuple[str | None, ...], ConfigError] = {}
    for error in errors:
        if error.where is None and error.key is not None:
            emptied = emptied_by(composed, error.key) if isinstance(error, MissingValue) else None
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
    groups, unmounted = section_at(config, "env.observations"), dict[str, ConfigError]()
    with_terms = [str(n) for n, g in groups.items() if isinstance(g, Mapping) and "terms" in g]
    for name, group in groups.items():
        if isinstance(group, Mapping) and "terms" not in group and (near := nearest_name(str(name), with_terms)):
            key, expected = f"env.observations.{name}", "settings for " + ", ".join(groups)
            message = "there are settings for this group, and no terms are mounted in it"
            unmounted[key] = ConfigError(message, key=key, expected=expected, nearest=near)
    errors = [e for e in section_errors("", config, root) if str(e.key).rpartition(".")[0] not in unmounted]
    errors += unmounted.values()
    errors += check_terms.check_sections(config)
    errors += check_terms.check_nested_targets(config)
    errors += [*check_terms.check_links(config), *check_terms.check_realism(config)]
    silences = [f"{section}.silence" for section in ("check", "env.robot")]
    for key, name, reason in ((f"{s}.{n}", n, why) for s in silences for n, why in section_at(config, s).items()):
        if name not in schema.PHYSICS_RULES:
            expected, nearest = "a rule of `wheelleg check --list`", nearest_name(str(name), schema.PHYSICS_RULES)
            errors.append(ConfigError("there is no such rule", key=key, expected=expected, nearest=nearest))
        elif isinstance(reason, str) and not reason.strip():
            errors.append(ConfigError("a silenced rule has no reason", key=key, expected="why the finding is accepted"))
    num_envs = at(config, "env.num_envs")
    errors += check_terms.recorded_errors(at(config, "recording.env_ids"), num_envs)
    for name, node in section_at(config, "env.scene.sensors").items():
        most = node.get("max_num_envs") if isinstance(node, Mapping) else None
        if isinstance(num_envs, int) and isinstance(most, int):  # a camera, which renders at most this many
            errors += filter(None, [too_many(num_envs, most, f"env.scene.sensors.{name}")])
    errors += check_agent(config.get("agent"), list(groups))
    if fits(num_envs, Count) and not any(f"{error.key}.".startswith("agent.") for error in errors):
        errors += batch_errors(read_agent(section_at(config, "agent")), int(str(num_envs)))
    return sorted(errors, key=lambda error: f"{error.key}.".startswith("agent."))


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


_OBSERVATION_GROUP = re.compile(r"env\.observations\.[^.]+")


def mount_place(composed: Composed, mounted: ConfigFile) -> str:
    """Return the place that selects a config file: an override, or the file and line of a defaults list."""
    for override in reversed(composed.loader.overrides):
        value = override.value()
        names = value if isinstance(value, list) else [value]
        fits = override.package in (None, mounted.package)
        if override.key_or_group == mounted.group and fits and mounted.name in [str(name) for name in names]:
            return where_of(override)
    repository = composed.loader.repository_used
    return place_of_option(repository, mounted.parent, mounted.config_path) or show_file(mounted.file, 1)


def check_term_files(files: Sequence[ConfigFile]) -> list[ConfigError]:
    """Find config files such as ``reward/alive.yaml`` that do not contain a term with the file's name (``alive``)."""
    errors = {}
    for file in files:
        if not _is_term_list(file.package) or file.name in file.content or file.file in errors:
            continue
        lines, names = line_table(file.file), [str(key) for key in file.content]
        if not names:
            message = f"this file is empty, and does not contain the term '{file.name}'"
        elif TARGET in file.content:
            message = f"this file does not contain the key '{file.name}'; its settings are at the top level"
        else:
            message = f"this file contains the term '{names[0]}', not '{file.name}'"
        expected = f"'{file.name}:' at the top, and the term's settings below it"
        where = show_file(file.file, min((lines.get((name,), 1) for name in names), default=1))
        key, nearest = f"{file.package}.{file.name}", file.name if nearest_name(file.name, names) else None
        errors[file.file] = ConfigError(message, key=key, where=where, expected=expected, nearest=nearest)
    return list(errors.values())


def check_targets_of_files(config: Mapping[str, object], files: Sequence[ConfigFile]) -> Iterator[ConfigError]:
    """Find terms, such as rewards, that have a config file but no ``_target_`` in the composed config."""
    for file in files:
        term = section_at(config, file.package).get(file.name) if _is_term_list(file.package) else None
        if file.name in file.content and isinstance(term, Mapping) and TARGET not in term:
            key, lines = f"{file.package}.{file.name}", line_table(file.file)
            try:
                split_node("rewards", key, term)
            except NotSelected:
                message, expected = "this file's term has no _target_", "_target_: package.module.name"
                where = show_file(file.file, lines.get((file.name,), 1))
                yield ConfigError(message, key=key, where=where, expected=expected)
            except ConfigError:
                continue  # The module check_terms reports a misspelled ``_target_``.


def check_group_lists(composed: Composed, files: Sequence[ConfigFile]) -> list[ConfigError]:
    """Find terms that are directly in an observation group, instead of below the group's key ``terms``."""
    terms = [file for file in files if TARGET in section_at(file.content, (file.name,))]
    astray = [file for file in terms if _OBSERVATION_GROUP.fullmatch(file.package)]
    return [
        ConfigError(
            f"terms are mounted at '{file.package}', which is not a list of terms",
            key=file.package,
            where=mount_place(composed, file),
            expected=f"/{file.group}@{file.package}.terms: [...]",
            nearest=f"{file.group}@{file.package}.terms",
        )
        for file in {file.package: file for file in reversed(astray)}.values()
    ]


def _is_term_list(package: str) -> bool:
    keys = package.split(".")
    if keys[0] != "env" or len(keys) < 2 or keys[1] not in RESERVED:
        return False
    return len(keys) == 4 and keys[3] == "terms" if keys[1] == "observations" else len(keys) == 2


def blame_mounts(errors: Sequence[ConfigError], composed: Composed, files: Sequence[ConfigFile]) -> list[ConfigError]:
    """For config files at a key that no code reads, add to the error the override or the line that selected the file.

    If a term's file is at a wrong key, remove the additional error that the term has no ``_target_``.
    """
    astray: set[str] = set()
    for error in errors:
        key = error.key if isinstance(error, UnreadKey) else None
        brought = [file for file in files if key and f"{file.package}.".startswith(f"{key}.")]
        own = {file.file for file in brought}
        # If other sources also set this key, the config files are not the cause.
        if brought and all(source.file in own for source in composed.provenance.below(str(key))):
            error.where = mount_place(composed, brought[0])
            error.message = f"nothing reads the options of '{brought[0].group}' here"
            packages = {file.package for file in files if file.group == brought[0].group} - {brought[0].package}
            sections = [f"env.{name}" for name in RESERVED if name.startswith(brought[0].group.split("/")[0])]
            usual = [*sorted(packages), *sections]
            error.nearest = f"{brought[0].group}@{usual[0]}" if usual else error.nearest
            astray |= {file.name for file in brought}
    return [e for e in errors if not (isinstance(e, NotSelected) and str(e.key).rpartition(".")[2] in astray)]


def emptied_by(composed: Composed, key: str) -> str | None:
    """Return the override that removed everything at ``key``: an empty list of options, or a deleted group."""
    for override in composed.loader.overrides:
        empty = override.value() == [] and override.package == key
        empty = empty or (override.is_delete() and override.key_or_group == key)
        group = override.is_delete() and composed.loader.repository_used.group_exists(override.key_or_group)
        if empty or (group and not composed.provenance.below(key)):
            return where_of(override)
    return None


def check_listed_twice(files: Sequence[ConfigFile], composed: Composed) -> Iterator[ConfigError]:
    """Find terms that are selected twice: by one defaults list, or by a config file and the file that it extends.

    If Hydra merged a term's file again, the file would overwrite later settings of the term. If a config file sets a
    term to null, a later defaults list can select the term again.
    """
    seen: dict[tuple[str, str], int] = {}
    for index, file in enumerate(files):
        place, key = (file.package, file.config_path), f"{file.package}.{file.name}"
        again = _is_term_list(file.package) and place in seen
        if again and not any(_sets_null(other, key) for other in files[seen[place] : index]):
            mounts = [mount for mount in composed.mounts if (mount.group, mount.package) == (file.group, file.package)]
            choices = [choice for mount in mounts for choice in mount.choices]
            where = mount_place(composed, file)
            for choice in reversed(choices):
                if file.name in map(str, choice.value if isinstance(choice.value, list) else [choice.value]):
                    where = choice.where
                    break
            yield ConfigError("the term is listed twice", key=key, where=where, expected="each term once")
        seen[place] = index


def _sets_null(file: ConfigFile, key: str) -> bool:
    below = key.removeprefix(f"{file.package}.") if file.package else key
    *above, name = below.split(".")
    node = section_at(file.content, tuple(above))
    return name in node and node[name] is None


def check_overwritten(composed: Composed) -> list[ConfigError]:
    """Find values of a config file that are lost because the file's defaults list names other files after ``_self_``.

    The primary config is skipped.
    """
    loaded = composed.loader.repository_used.loaded
    early = {item.file for name, item in loaded.items() if name != composed.primary and self_before_others(item.file)}
    return [
        ConfigError(
            f"{hidden.value!r} is lost: {source.where} overwrites it, because _self_ is before it in the defaults",
            key=hidden.path,
            where=hidden.where,
            expected="_self_ at the end of the defaults list",
        )
        for source in composed.provenance.values()
        for hidden in source.shadowed
        if source.file is not None and hidden.file in early and hidden.value != source.value
    ]


def check_merged_mappings(composed: Composed, files: Sequence[ConfigFile]) -> Iterator[ConfigError]:
    """Find empty mappings, which change nothing, and keys without a value, which remove mappings of earlier files."""
    earlier: list[Keys] = []
    found = [(split_path(o.key_or_group), o.value(), where_of(o)) for o in composed.loader.overrides if o.value() == {}]
    empty = [(keys, value, where, section_at(composed.config, keys)) for keys, value, where in found]
    for file in files:
        package, lines = split_path(file.package), lookup.file_text(file.file).splitlines()
        for keys, value in leaves(file.content):
            line = line_table(file.file).get(keys, 1)
            if keys and (value == {} or (value is None and re.match(r"[^#]*:\s*(#.*)?$", lines[line - 1]))):
                path, depth = (*package, *keys), len(package) + len(keys)
                names = dict.fromkeys(key[depth] for key in earlier if key[:depth] == path and len(key) > depth)
                empty.append((path, value, show_file(file.file, line), names))
        earlier += [(*package, *keys) for keys in lookup.node_paths(file.content)]
    for path, value, where, inside in (entry for entry in empty if entry[-1]):
        what = (
            "the key has no value, and removes" if value is None else "an empty mapping changes nothing: it merges with"
        )
        expected = "null, which removes all of them, or a value for each unwanted key"
        yield ConfigError(f"{what} {', '.join(inside)}", key=dotted(path), where=where, expected=expected)


def check_order(composed: Composed, files: Sequence[ConfigFile]) -> Iterator[ConfigError]:
    """Find defaults lists that order terms, such as rewards, differently from the composed config.

    A term gets an earlier position if another file sets a parameter of the term before Hydra merges the term's file.
    """
    by_package: dict[str, list[ConfigFile]] = {}
    for file in files:
        if _is_term_list(file.package):
            by_package.setdefault(file.package, []).append(file)
    for package, members in by_package.items():
        wanted = list(dict.fromkeys(file.name for file in members if file.name in file.content))
        present = [name for name in section_at(composed.config, package) if name in wanted]
        kept = [name for name in wanted if name in present]
        if present != kept:
            early = next(name for name, other in zip(present, kept, strict=True) if name != other)
            member = next(file for file in members if file.name == early)
            sources = composed.provenance.below(f"{package}.{early}")
            first = sources[0].shadowed[0] if sources and sources[0].shadowed else sources[0]
            setters = [s for source in sources for s in (source, *source.shadowed) if s.file != member.file]
            message = f"the order of the terms is not that of the list: it is {', '.join(present)}, because '{early}' "
            message += "is set before it is listed"
            expected = f"{', '.join(kept)}, the order of the list: put _self_ last, or set '{early}' after it is listed"
            where = (setters[0] if setters else first).where
            yield ConfigError(message, key=package, where=where, expected=expected)


def unread_in_files(files: Sequence[ConfigFile], primary: str) -> Iterator[ConfigError]:
    """Yield an error for each Hydra setting that a config file sets without effect; skip the primary config."""
    for mounted in files:
        if mounted.config_path == primary:
            continue
        lines = line_table(mounted.file)
        package = split_path(mounted.package) if mounted.package else ()
        found = [(dotted((*package, *keys)), lines.get(keys)) for keys, _ in leaves(mounted.content)]
        found += [(entry.key.lstrip("/"), entry.line) for entry in defaults_entries(mounted.file)]
        yield from (unread_setting(key, show_file(mounted.file, line)) for key, line in found if is_unread(key))
