"""Explaining what is wrong with groups, options and defaults lists."""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import yaml
from hydra.core.override_parser.types import Override
from hydra.errors import MissingConfigException

from wheelleg_exp.config.composing.loader import Loader, Repository
from wheelleg_exp.config.tree import DefaultsEntry, defaults_entries, defaults_items, scalar_line, show_file
from wheelleg_exp.errors import ConfigError, nearest_name

IN_FILE = re.compile(r"^In '?([^':]+)'?:")


class NowhereMounted(ConfigError):
    """A defaults list overrides a group that no file mounts under that name."""


def where_of(override: Override) -> str:
    """Return the place of an error that an override made."""
    return f"override {override.input_line}"


def option_problems(loader: Loader, parsed: Sequence[Override]) -> list[ConfigError]:
    """Find overrides of groups that name no group, or no option of it."""
    repository = loader.repository_used
    groups = loader.groups()
    problems = []
    for override in parsed:
        group = override.key_or_group
        if isinstance(override.value(), dict) or override.is_hydra_override():
            continue
        if repository.group_exists(group):
            problems += _value_problems(repository, override)
        elif override.package is not None:
            problems.append(_no_group(group, groups, where_of(override)))
    return problems


def _no_group(group: str, groups: Iterable[str], where: str | None) -> ConfigError:
    names = list(groups)
    return ConfigError(
        f"there is no config group '{group}'",
        key=group,
        where=where,
        expected="one of " + ", ".join(names),
        nearest=nearest_name(group, names),
    )


def _value_problems(repository: Repository, override: Override) -> list[ConfigError]:
    value = override.value()
    if override.is_delete():
        return []
    if override.is_force_add() or not isinstance(value, (str, list)):
        return [_no_name(repository, override)]
    elements = value if isinstance(value, list) else [value]
    options = repository.get_group_options(override.key_or_group)
    wrong = [
        str(e)
        for e in elements
        if str(e) not in options and not repository.config_exists(f"{override.key_or_group}/{e}")
    ]
    return [_no_option(override.get_key_element().lstrip("+~"), name, options, where_of(override)) for name in wrong]


def _no_name(repository: Repository, override: Override) -> ConfigError:
    """Return the error for a group that is given something else than the name of an option."""
    key = override.get_key_element().lstrip("+~")
    options = repository.get_group_options(override.key_or_group)
    return ConfigError(
        "a group takes the name of an option",
        key=key,
        where=where_of(override),
        expected=f"{key}=<option> or +{key}=<option>, one of " + ", ".join(options),
    )


def _no_option(key: str, name: str, options: Sequence[str], where: str | None) -> ConfigError:
    return ConfigError(
        f"'{name}' is not an option",
        key=key,
        where=where,
        expected="one of " + ", ".join(options) if options else "a group with options",
        nearest=nearest_name(name, options),
    )


def missing_option(
    error: MissingConfigException, loader: Loader, primary: str, parsed: Sequence[Override]
) -> ConfigError:
    """Explain a config that a defaults list names and that is not there."""
    path = (error.missing_cfg_file or "").removesuffix(".yaml")
    repository = loader.repository_used
    group, _, name = path.rpartition("/")
    if path == primary:
        options = [name for name in repository.get_group_options("") if not name.startswith("_")]
        return ConfigError(
            "there is no such primary config", key=primary, expected="one of " + ", ".join(options),
            nearest=nearest_name(primary, options),
        )  # fmt: skip
    where = _override_with(parsed, group, name) or _place_in_defaults(repository, str(error), path)
    if group and not repository.group_exists(group):
        return _no_group(group, loader.groups(), where)
    return _no_option(group or path, name, repository.get_group_options(group), where)


def _override_with(parsed: Sequence[Override], group: str, name: str) -> str | None:
    for override in parsed:
        value = override.value()
        elements = value if isinstance(value, list) else [value]
        if override.key_or_group == group and name in [str(e) for e in elements]:
            return where_of(override)
    return None


def _place_in_defaults(repository: Repository, message: str, path: str) -> str | None:
    """Return the line of the defaults list, in the file that a message speaks of, that names ``path``."""
    match = IN_FILE.match(message.strip())
    return place_of_option(repository, match.group(1).strip(), path) if match else None


def place_of_option(repository: Repository, parent: str, path: str) -> str | None:
    """Return the line of a config's defaults list that names ``path``; None when the config is not read."""
    loaded = repository.loaded.get(parent)
    return show_file(loaded.file, _defaults_line(loaded.file, path)) if loaded is not None else None


def _defaults_line(file: Path, path: str) -> int | None:
    group, _, name = path.rpartition("/")
    for key, value in _defaults_entries(file):
        if key is not None and key.split(" ")[-1].lstrip("/") == path:
            return value.start_mark.line + 1
        scalars = value.value if isinstance(value, yaml.SequenceNode) else [value]
        for scalar in scalars:
            mounted = key is None or key.split("@")[0].split(" ")[-1].lstrip("/").endswith(group.rsplit("/", 1)[-1])
            if mounted and str(scalar.value).lstrip("/") in (name, path):
                return scalar.start_mark.line + 1
    return scalar_line(file, name, path, f"/{path}")


def _defaults_entries(file: Path) -> list[tuple[str | None, yaml.Node]]:
    """Return the ``(key, value)`` pairs of a file's defaults list; plain entries have no key."""
    entries: list[tuple[str | None, yaml.Node]] = []
    for item in defaults_items(file):
        if isinstance(item, yaml.MappingNode):
            entries += [(str(key.value), value) for key, value in item.value]
        else:
            entries.append((None, item))
    return entries


def defaults_problem(problem: Exception, loader: Loader, parsed: Sequence[Override]) -> ConfigError:
    """Explain a failure in the defaults list, such as an override of a group that no file mounts there."""
    text = str(problem)
    listed = next((o for o in parsed if o.package is None and isinstance(o.value(), list)), None)
    if "appears more than once" in text and listed is not None:
        expected = f"{listed.key_or_group}=<one option>"
        return ConfigError(
            "this group takes one option", key=listed.key_or_group, where=where_of(listed), expected=expected
        )
    doubled = re.match(r"Multiple values for (\S+)\. |(\S+) appears more than once", text)
    if doubled:
        return _chosen_twice(doubled.group(1) or doubled.group(2), loader.repository_used, parsed)
    early = _early_override(loader.repository_used) if isinstance(problem, AssertionError) else None
    if early is not None:
        return early
    quoted = re.search(r"Could not (?:override|delete) '([^']+)'", text)
    key = quoted.group(1).split("=")[0] if quoted else None
    mounted = mounts(loader.repository_used)
    culprit = next((o for o in parsed if o.get_key_element().lstrip("+~") == key), None)
    where = where_of(culprit) if culprit else _place_in_defaults(loader.repository_used, text, key or "")
    if key is None:
        return ConfigError(flat(problem), where=where)
    if culprit is not None and culprit.is_delete() and key in mounted:
        option, kept = str(culprit.value() or "<term>"), f"{key}=[...]"
        expected = f"the list that is left, {kept}, or the term by its key: ~{key.split('@')[-1]}.{option}"
        return ConfigError("an option of a list cannot be taken out by itself", key=key, where=where, expected=expected)
    if culprit is None and key not in mounted and key.partition("/")[2] in mounted:
        name = key.partition("/")[2]
        message = "the group's name lacks its slash, and is looked for below the file's own group"
        places = [(file, entry) for file, entry in _entries(loader.repository_used) if entry.key == name]
        where = show_file(places[0][0], places[0][1].line) if places else where
        return NowhereMounted(message, key=key, where=where, expected=f"- override /{name}: ...")
    mounted_group = [m for m in mounted if m.split("@")[0] == key.split("@")[0]]
    return NowhereMounted(
        "this group is mounted nowhere under this name",
        key=key,
        where=where,
        expected="one of " + ", ".join(mounted_group or mounted),
        nearest=nearest_name(key, mounted_group) or (mounted_group[0] if mounted_group else nearest_name(key, mounted)),
    )


def _chosen_twice(key: str, repository: Repository, parsed: Sequence[Override]) -> ConfigError:
    message = "an option of this group is chosen already"
    culprit = next((o for o in parsed if o.is_add() and o.get_key_element().lstrip("+") == key), None)
    if culprit is not None:
        expected = f"{key}=<option> without the plus sign"
        return ConfigError(message, key=key, where=where_of(culprit), expected=expected)
    # A file is read before those that it builds on; what the primary config chooses is meant to be overridden.
    places = [(file, e) for file, e in _entries(repository) if e.key.lstrip("/") == key and not e.override]
    where = show_file(places[0][0], places[0][1].line) if places else None
    option = str(places[0][1].value) if places else "<option>"
    return ConfigError(message, key=key, where=where, expected=f"- override /{key}: {option}, behind the other entries")


def _entries(repository: Repository) -> Iterator[tuple[Path, DefaultsEntry]]:
    """Yield the entries of the defaults lists of all files but the primary config."""
    for path, loaded in repository.loaded.items():
        if "/" in path:
            yield from ((loaded.file, entry) for entry in defaults_entries(loaded.file))


def _early_override(repository: Repository) -> ConfigError | None:
    """Find an override that stands before other entries of its defaults list."""
    for loaded in repository.loaded.values():
        entries = defaults_entries(loaded.file)
        for entry, following in itertools.pairwise(entries):
            if entry.override and not following.override:
                return ConfigError(
                    "this override stands before other entries of its defaults list",
                    key=entry.key.lstrip("/"),
                    where=show_file(loaded.file, entry.line),
                    expected="overrides behind all other entries, before _self_ at the end",
                )
    return None


def mounts(repository: Repository) -> list[str]:
    """Return the names under which the files read so far mount groups, such as ``reward@env.rewards``."""
    names: dict[str, None] = {}
    for loaded in repository.loaded.values():
        for key, _ in _defaults_entries(loaded.file):
            if key is not None and not key.startswith("override "):
                names[key.split(" ")[-1].lstrip("/")] = None
    return list(names)


def flat(error: BaseException) -> str:
    """Return a message of Hydra's or OmegaConf's on one line, without their own details."""
    lines = [line.strip() for line in str(error).strip().splitlines()]
    kept = [line for line in lines if line and not line.startswith(("full_key:", "object_type=", "See https"))]
    return " ".join(kept) or type(error).__name__
