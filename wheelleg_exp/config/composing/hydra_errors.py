"""Translate the exceptions of Hydra and OmegaConf into ConfigErrors: key, place, expected value, and nearest name."""

from __future__ import annotations

import copy
import itertools
import re
from collections.abc import Iterable, Iterator, Sequence
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import yaml
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.errors import (
    ConfigCompositionException,
    HydraException,
    MissingConfigException,
)
from omegaconf import DictConfig, OmegaConf

from wheelleg_exp.config.composing.config_loader import COMPOSING_ERRORS, Loader, Repository, missing_headers
from wheelleg_exp.config.config_errors import AbsentKey, join
from wheelleg_exp.config.config_tree import DefaultsEntry, at, defaults_entries, defaults_items, node_paths, scalar_line
from wheelleg_exp.config.explaining.key_documentation import KEYS
from wheelleg_exp.errors import ConfigError, nearest_name
from wheelleg_exp.paths import show_file
from wheelleg_exp.terms.key_syntax import Keys, dotted, split_path

IN_FILE = re.compile(r"^In '?([^':]+)'?:")


class NowhereMounted(ConfigError):
    """A defaults list overrides a group that no file mounts under that name."""


def where_of(override: Override) -> str:
    """Return the place of an error in an override."""
    return f"override {override.input_line}"


def option_problems(loader: Loader, parsed: Sequence[Override]) -> list[ConfigError]:
    """Find overrides of groups that name an unknown group, or an unknown option of a group."""
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
    """Return the error for an override that sets a group to a value that is not a name."""
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
    """Return the error for a config that is missing, although a defaults list or an override names it."""
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
    """Return the line that names ``path`` in the defaults list of the file that Hydra's message names."""
    match = IN_FILE.match(message.strip())
    return place_of_option(repository, match.group(1).strip(), path) if match else None


def place_of_option(repository: Repository, parent: str, path: str) -> str | None:
    """Return the line that names ``path`` in a config's defaults list; None if the config was not read."""
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
    """Return the error for a failure in the defaults list, such as an override of a group that no file mounts."""
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
    mounted = mounted_names(loader.repository_used)
    culprit = next((o for o in parsed if o.get_key_element().lstrip("+~") == key), None)
    where = where_of(culprit) if culprit else _place_in_defaults(loader.repository_used, text, key or "")
    if key is None:
        return ConfigError(flat(problem), where=where)
    if culprit is not None and culprit.is_delete() and key in mounted:
        option = str(culprit.value() or "<term>")
        expected = f"the remaining list, {key}=[...], or the term by its key: ~{key.split('@')[-1]}.{option}"
        return ConfigError("an option of a list cannot be removed by itself", key=key, where=where, expected=expected)
    if culprit is None and key not in mounted and key.partition("/")[2] in mounted:
        name = key.partition("/")[2]
        message = "the group's name lacks its leading slash, so Hydra searches it below the file's own group"
        places = [(file, entry) for file, entry in _entries(loader.repository_used) if entry.key == name]
        where = show_file(places[0][0], places[0][1].line) if places else where
        return NowhereMounted(message, key=key, where=where, expected=f"- override /{name}: ...")
    mounted_group = [m for m in mounted if m.split("@")[0] == key.split("@")[0]]
    return NowhereMounted(
        "no file mounts a group under this name",
        key=key,
        where=where,
        expected="one of " + ", ".join(mounted_group or mounted),
        nearest=nearest_name(key, mounted_group) or (mounted_group[0] if mounted_group else nearest_name(key, mounted)),
    )


def _chosen_twice(key: str, repository: Repository, parsed: Sequence[Override]) -> ConfigError:
    message = "an option of this group is selected already"
    culprit = next((o for o in parsed if o.is_add() and o.get_key_element().lstrip("+") == key), None)
    if culprit is not None:
        expected = f"{key}=<option> without the plus sign"
        return ConfigError(message, key=key, where=where_of(culprit), expected=expected)
    # Files are read before their parents. The primary config is left out, because its selections can be overridden.
    places = [(file, e) for file, e in _entries(repository) if e.key.lstrip("/") == key and not e.override]
    where = show_file(places[0][0], places[0][1].line) if places else None
    option = str(places[0][1].value) if places else "<option>"
    return ConfigError(message, key=key, where=where, expected=f"- override /{key}: {option}, after the other entries")


def _entries(repository: Repository) -> Iterator[tuple[Path, DefaultsEntry]]:
    """Yield the entries of all files' defaults lists, without the primary config."""
    for path, loaded in repository.loaded.items():
        if "/" in path:
            yield from ((loaded.file, entry) for entry in defaults_entries(loaded.file))


def _early_override(repository: Repository) -> ConfigError | None:
    """Find an override that comes before other entries of its defaults list."""
    for loaded in repository.loaded.values():
        entries = defaults_entries(loaded.file)
        for entry, following in itertools.pairwise(entries):
            if entry.override and not following.override:
                return ConfigError(
                    "this override comes before other entries of its defaults list",
                    key=entry.key.lstrip("/"),
                    where=show_file(loaded.file, entry.line),
                    expected="overrides after all other entries, before _self_ at the end",
                )
    return None


def mounted_names(repository: Repository) -> list[str]:
    """Return the names of the groups that the loaded files mount, such as ``reward@env.rewards``."""
    names: dict[str, None] = {}
    for loaded in repository.loaded.values():
        for key, _ in _defaults_entries(loaded.file):
            if key is not None and not key.startswith("override "):
                names[key.split(" ")[-1].lstrip("/")] = None
    return list(names)


def flat(error: BaseException) -> str:
    """Return a message of Hydra or OmegaConf on one line, without their internal details."""
    lines = [line.strip() for line in str(error).strip().splitlines()]
    shown = [line for line in lines if line and not line.startswith(("full_key:", "object_type=", "See https"))]
    return " ".join(shown) or type(error).__name__


_FORMS = "key=value, +key=value, ++key=value or ~key"


class DoesNotMerge(ConfigError):
    """The file at ``config_path``, as Hydra names it, does not merge with the files before it."""

    config_path: str | None = None


def translate(error: Exception, loader: Loader, primary: str, overrides: Sequence[str]) -> ConfigError:
    """Return the ConfigError for an exception of Hydra or OmegaConf.

    Args:
        error: the exception.
        loader: the loader that was composing.
        primary: name of the primary config.
        overrides: the overrides as typed.
    """
    spaced = _spaced(overrides)
    if spaced is not None:
        return spaced
    found = [problem for problem in map(unreadable, overrides) if problem is not None]
    if found:
        return join(found)
    parsed = OverridesParser.create().parse_overrides(list(overrides))
    found = [_sweep(o) for o in parsed if o.is_sweep_override()] or option_problems(loader, parsed)
    if found:
        return join(found)
    if isinstance(error, MissingConfigException):
        return missing_option(error, loader, primary, parsed)
    if isinstance(error, RecursionError):
        return _circle(loader.repository_used, primary)
    return _by_stage(error, loader, primary, parsed)


def _circle(used: Repository, primary: str) -> ConfigError:
    """Return the error for a cycle of defaults lists. The files of the cycle are found if they are in one folder."""
    below: dict[str, set[str]] = {}
    for path, loaded in used.loaded.items():
        folder = path.rpartition("/")[0]
        names = [str(item.value) for item in defaults_items(loaded.file) if isinstance(item, yaml.ScalarNode)]
        below[path] = {f"{folder}/{name}".lstrip("/") for name in names if name != "_self_"}
    message, expected = "the defaults lists form a cycle", "defaults lists without a cycle"
    try:
        TopologicalSorter(below).prepare()
    except CycleError as error:
        path, other = error.args[1][1], error.args[1][0]  # each file names the one before it
        file = used.loaded[path].file
        where = show_file(file, scalar_line(file, other.rpartition("/")[2]))
        return ConfigError(
            f"{message}: {' -> '.join(reversed(error.args[1]))}", key=path, where=where, expected=expected
        )
    return ConfigError(message, key=primary, expected=expected)


def _spaced(overrides: Sequence[str]) -> ConfigError | None:
    """Find an override that the shell has split at spaces: ``key = value``."""
    for index, text in enumerate(overrides):
        before, after = overrides[:index][-1:], overrides[index + 1 :][:1]
        cut = ([*before] if text.startswith("=") else []) + [text] + ([*after] if text.endswith("=") else [])
        if len(cut) > 1 and not any("=" in word.strip("=") for word in cut):
            typed = " ".join(cut)
            expected = f"{''.join(cut)}, without spaces"
            return ConfigError("these are several words", key=typed, where=f"override {typed}", expected=expected)
    return None


def unreadable(text: str) -> ConfigError | None:
    """Return the error for an override that cannot be parsed; None if it can be parsed."""
    try:
        override = OverridesParser.create().parse_override(text)
    except HydraException as error:
        reason = str(error).splitlines()[0].partition(" expecting ")[0]
    else:
        if override.key_or_group:
            return None
        reason = "there is no key"
    element = re.match(r"([^=\[]*)\[(\d+)\]=(.*)", text)
    expected = f"{element[1]}.{element[2]}={element[3]}" if element else _FORMS
    key, equals, value = text.partition("=")
    if not equals and ":" in key:
        expected = key.replace(":", "=", 1).replace("= ", "=")
    if equals and re.search(r"[*?^$\\|(]", value) and not re.search(r"[\"']", value):
        expected = f"""quotes around text with such characters, inside quotes of the shell: "{key}=['...']\""""
    return ConfigError(f"not an override: {reason}", key=text, where=f"override {text}", expected=expected)


def _sweep(override: Override) -> ConfigError:
    key = override.key_or_group
    text = str(override.input_line).split("=", 1)[-1]
    forms = "; -m (--multirun) trains each of several"
    forms += "" if "(" in text else f"; a list is written {key}=[{text}], text with commas {key}='{text}'"
    return ConfigError("several values for one run", key=key, where=where_of(override), expected=f"one value{forms}")


def _by_stage(error: Exception, loader: Loader, primary: str, parsed: Sequence[Override]) -> ConfigError:
    """Compose again step by step, and return the error of the step that fails."""
    misplaced = missing_headers(loader.repository_used, _mounted_groups(loader.repository_used, parsed))
    if misplaced:
        return join(misplaced)
    try:
        defaults = loader.defaults(primary, parsed)
    except COMPOSING_ERRORS as problem:
        return defaults_problem(problem, loader, parsed)
    try:
        cfg = loader._compose_config_from_defaults_list(defaults.defaults, loader.repository_used)
    except COMPOSING_ERRORS as problem:
        return _merge_problem(problem, loader.repository_used)
    OmegaConf.set_struct(cfg, True)
    problems = []
    for override in defaults.config_overrides:
        before = copy.deepcopy(cfg)  # a failed override can replace null by an empty mapping
        try:
            ConfigLoaderImpl._apply_overrides_to_config([override], cfg)
        except COMPOSING_ERRORS as problem:
            problems.append(_override_problem(problem, override, before, loader.groups()))
    return join(problems) if problems else ConfigError(flat(error), key=primary)


def _mounted_groups(repository: Repository, parsed: Sequence[Override]) -> set[str]:
    """Return the groups that a file or an override mounts at an explicit package."""
    names = [*mounted_names(repository), *(o.get_key_element().lstrip("+~") for o in parsed)]
    return {name.split("@")[0] for name in names if "@" in name}


def _merge_problem(problem: Exception, repository: Repository) -> ConfigError:
    text = str(problem)
    match = IN_FILE.match(text)
    loaded = repository.loaded.get(match.group(1)) if match else None
    body = text.split("composing config:", 1)[-1]
    key = re.search(r"full_key: (\S+)", text)
    line = scalar_line(loaded.file, key.group(1).rsplit(".", 1)[-1]) if loaded and key else None
    error = DoesNotMerge(
        f"does not merge: {flat(ValueError(body))}",
        key=key.group(1) if key else None,
        where=show_file(loaded.file, line) if loaded else None,
    )
    error.config_path = match.group(1) if match else None
    return error


def _override_problem(problem: Exception, override: Override, cfg: DictConfig, groups: Sequence[str]) -> ConfigError:
    """Return the error for an override that cannot be applied."""
    key = override.key_or_group
    # Hydra's own keys are listed only for an override of such a key.
    shown = {name: node for name, node in _plain(cfg).items() if (name == "hydra") == override.is_hydra_override()}
    existing = _existing(shown, key)
    if existing and override.is_add():
        plain = str(override.input_line).lstrip("+")
        expected = f"{plain} without the plus sign"
        return ConfigError("the key has a value already", key=key, where=where_of(override), expected=expected)
    if existing and override.is_delete() and at(shown, split_path(key)) is None:
        expected = f"nothing to remove: 'wheelleg explain task=... {key}' shows where it is set to null"
        return ConfigError("is null already", key=key, where=where_of(override), expected=expected)
    if existing and override.is_delete():
        return ConfigError(flat(problem), key=key, where=where_of(override), expected=f"~{key} without a value")
    strange = re.search(r"Key '(.+?)' is not in struct", str(problem.__cause__ or problem))
    if existing and strange:
        return _unknown_part(shown, override, strange.group(1))
    if existing or not isinstance(problem, ConfigCompositionException) or "Error merging" in str(problem):
        return ConfigError(flat(problem.__cause__ or problem), key=key, where=where_of(override))
    # KEYS contains optional keys that no file has to set.
    if key in KEYS and not override.is_delete() and at(shown, split_path(key)[:-1]) is not None:
        plain = str(override.input_line).lstrip("+")
        return AbsentKey("no file of the task sets this key", key=key, where=where_of(override), expected=f"+{plain}")
    top = None if split_path(key)[0] in shown else nearest_name(key, [*shown, *groups])
    return AbsentKey(
        "there is no such key",
        key=key,
        where=where_of(override),
        expected=_expected_at(shown, key, groups),
        nearest=top or nearest_path(key, [dotted(path) for path in node_paths(shown)]),
    )


def _unknown_part(tree: dict[str, object], override: Override, name: str) -> ConfigError:
    """Return the error for an override whose mapping contains a key that does not exist."""
    key = override.key_or_group
    node: object = tree
    for part in split_path(key):
        node = node[part] if isinstance(node, dict) and part in node else {}
    names = [str(known) for known in node] if isinstance(node, dict) else []
    full = dotted([*split_path(key), name])
    known = f"one of {', '.join(names)}; " if names else ""
    expected = f"{known}+{full}=value adds one, ++{key}={{...}} merges"
    return AbsentKey("there is no such key", key=full, where=where_of(override), expected=expected,
                       nearest=nearest_name(name, names))  # fmt: skip


def _plain(cfg: DictConfig) -> dict[str, object]:
    plain = OmegaConf.to_container(cfg, resolve=False)
    return {str(name): node for name, node in plain.items()} if isinstance(plain, dict) else {}


def _existing(tree: dict[str, object], key: str) -> bool:
    return split_path(key) in set(node_paths(tree))


def _expected_at(tree: dict[str, object], path: str, groups: Sequence[str]) -> str:
    """Return the text that lists the existing keys at the place where the path leaves the tree."""
    node: object = tree
    walked: list[str] = []
    for part in split_path(path):
        if not isinstance(node, dict) or part not in node:
            break
        walked.append(part)
        node = node[part]
    place = dotted(walked)
    if node is None:
        return f"'{place}' to be a mapping; it is null: 'wheelleg explain task=... {place}' shows where it is set"
    if not isinstance(node, dict):
        return f"'{place}' to be a mapping; it is a single value"
    names = ", ".join(str(name) for name in node)
    if not walked:
        return f"one of {names}, or a group: {', '.join(groups)}"
    return f"one of {names} in {place}" if names else f"nothing: {place} is empty; +{path}=value adds a key"


def nearest_path(path: str, paths: Sequence[str]) -> str | None:
    """Return the existing path that is most similar to ``path``: key by key first, then by the whole text."""
    known = [split_path(p) for p in paths]
    found: Keys = ()
    for part in split_path(path):
        here = {k[len(found)]: None for k in known if len(k) > len(found) and k[: len(found)] == found}
        name = part if part in here else nearest_name(part, here)
        if name is None:
            whole = nearest_name(path, [p for p in paths if p.count(".") >= path.count(".")])
            return whole or next((p for p in paths if p.endswith(f".{path}")), None)
        found = (*found, name)
    return dotted(found)
