"""Convert exceptions of Hydra and OmegaConf to ConfigErrors with key, place, expected value, and nearest name."""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterator, Sequence
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import yaml
from hydra.core.config_loader import ConfigLoader
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.errors import ConfigCompositionException, HydraException, MissingConfigException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from wheelleg_exp.config import tree_lookup as lookup
from wheelleg_exp.config.composing.provenance import Composition, ReadFiles
from wheelleg_exp.config.config_errors import AbsentKey
from wheelleg_exp.config.key_slots import is_settable
from wheelleg_exp.errors import ConfigError, nearest_name, not_one_of
from wheelleg_exp.paths import show_file
from wheelleg_exp.terms.key_syntax import Keys, dotted, split_path

# Hydra and OmegaConf raise `COMPOSING_ERRORS` for invalid configs, such as RecursionError for cyclic defaults lists.
COMPOSING_ERRORS = (HydraException, OmegaConfBaseException, ValueError, RecursionError, AssertionError)
_IN_FILE = re.compile(r"^In '?([^':]+)'?:")


class NowhereMounted(AbsentKey):
    """A defaults list overrides the option of a config group, but no defaults list selects an option of this group."""


def where_of(override: Override) -> str:
    """Return the text that names an override in error messages, such as ``override seed=1``."""
    return f"override {override.input_line}"


def option_problems(loader: Composition, override: Override) -> list[ConfigError]:
    """Return the errors of an override that selects an option, or a config group, that does not exist."""
    group, value, key, where = override.key_or_group, override.value(), name_of(override), where_of(override)
    repository = loader.repository_used
    if isinstance(value, dict) or override.is_hydra_override():
        return []
    if not repository.group_exists(group):
        return [] if override.package is None else [_no_group(loader, group, where)]
    if override.is_delete():
        return []
    options = repository.get_group_options(group)
    if override.is_force_add() or not isinstance(value, (str, list)):
        expected = f"{key}=<option> or +{key}=<option>, one of " + ", ".join(options)
        return [ConfigError("a group takes the name of an option", key=key, where=where, expected=expected)]
    names = [str(name) for name in (value if isinstance(value, list) else [value]) if "${" not in str(name)]
    wrong = [name for name in names if name not in options and not repository.config_exists(f"{group}/{name}")]
    return [_no_option(key, name, options, where) for name in wrong]


def missing_option(loader: Composition, path: str, parent: str) -> ConfigError | None:
    """Return the error for an option without a file, selected by the config ``parent``; None for an optional entry."""
    group, _, name = path.rpartition("/")
    repository = loader.repository_used
    entries = lookup.defaults_entries(repository.loaded[parent].file) if parent in repository.loaded else []
    optional = [entry.key.partition("@")[0].lstrip("/") for entry in entries if entry.optional]
    if any(one.endswith(group) or group.startswith(f"{one}/") for one in optional):
        return None
    values = [(o, o.value()) for o in loader.overrides if o.key_or_group == group]
    chosen = (o for o, value in values if name in map(str, value if isinstance(value, list) else [value]))
    where = next(map(where_of, chosen), None) or place_of_option(repository, parent, path)
    if group and not repository.group_exists(group):
        return _no_group(loader, group, where)
    return _no_option(group or path, name, repository.get_group_options(group), where)


def _no_group(loader: Composition, group: str, where: str | None) -> ConfigError:
    return not_one_of(f"there is no config group '{group}'", group, loader.groups(), key=group, where=where)


def name_of(override: Override) -> str:
    """Return the group or key of an override, such as ``reward@env.rewards``, without ``+`` and ``~``."""
    return str(override.get_key_element()).lstrip("+~")


def _no_option(key: str, name: str, options: Sequence[str], where: str | None) -> ConfigError:
    if not options:
        return ConfigError(f"'{name}' is not an option", key=key, where=where, expected="a group with options")
    return not_one_of(f"'{name}' is not an option", name, options, key=key, where=where)


def place_of_option(repository: ReadFiles, parent: str, path: str) -> str | None:
    """Return the file and line at which a config's defaults list names the option ``path``, or None."""
    loaded = repository.loaded.get(parent)
    return show_file(loaded.file, _defaults_line(loaded.file, path)) if loaded is not None else None


def parent_of(repository: ReadFiles, path: str) -> str | None:
    """Return the name of the first config whose defaults list names the option ``path``, or None."""
    return next((name for name, loaded in repository.loaded.items() if _defaults_line(loaded.file, path)), None)


def _defaults_line(file: Path, path: str) -> int | None:
    group, _, name = path.rpartition("/")
    for item in lookup.defaults_items(file):
        is_mapping = isinstance(item, yaml.MappingNode)
        # An entry such as ``_self_`` has no key.
        pairs = [(str(key.value), value) for key, value in item.value] if is_mapping else [(None, item)]
        for key, value in pairs:
            if key is not None and key.split(" ")[-1].lstrip("/") == path:
                return value.start_mark.line + 1
            scalars = value.value if isinstance(value, yaml.SequenceNode) else [value]
            for scalar in scalars:
                mounted = key is None or key.split("@")[0].split(" ")[-1].lstrip("/").endswith(group.rsplit("/", 1)[-1])
                if mounted and str(scalar.value).lstrip("/") in (name, path):
                    return scalar.start_mark.line + 1
    return lookup.scalar_line(file, name, path, f"/{path}")


def defaults_problem(problem: Exception, loader: Composition, primary: str) -> ConfigError:
    """Return the error for an exception that Hydra raised while it collected the defaults lists of all files."""
    text, parsed = str(problem), loader.overrides
    if isinstance(problem, MissingConfigException):
        options = [name for name in loader.repository_used.get_group_options("") if not name.startswith("_")]
        return not_one_of("there is no such primary config", primary, options, key=primary)
    if isinstance(problem, RecursionError):
        return _circle(loader.repository_used, primary)
    lists = [o for o in parsed if o.package is None and isinstance(o.value(), list)]
    needed = [o for o in lists if "appears more than once" in text or f"${{{o.key_or_group}}}" in text]
    for listed in needed[:1]:
        key = listed.key_or_group
        options = loader.repository_used.get_group_options(key)
        expected = f"{key}=<one option>, one of {', '.join(options)}"
        return ConfigError("this group takes one option", key=key, where=where_of(listed), expected=expected)
    doubled = re.match(r"Multiple values for (\S+)\. |(\S+) appears more than once", text)
    if doubled:
        return _chosen_twice(doubled.group(1) or doubled.group(2), loader.repository_used, parsed)
    for loaded in loader.repository_used.loaded.values() if isinstance(problem, AssertionError) else ():
        for entry, following in itertools.pairwise(lookup.defaults_entries(loaded.file)):
            if entry.override and not following.override:
                message = "this override comes before other entries of its defaults list"
                expected = "overrides after all other entries, before _self_ at the end"
                place = show_file(loaded.file, entry.line)
                return ConfigError(message, key=entry.key.lstrip("/"), where=place, expected=expected)
    quoted = re.search(r"Could not (?:override|delete) '([^']+)'", text)
    key = quoted.group(1).split("=")[0] if quoted else None
    mounted = mounted_names(loader.repository_used)
    culprit = next((o for o in parsed if name_of(o) == key), None)
    where = where_of(culprit) if culprit else None
    parent = _IN_FILE.match(text.strip())
    if culprit is None and parent is not None:
        where = place_of_option(loader.repository_used, parent.group(1).strip(), key or "")
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
    expected = "one of " + ", ".join(mounted_group or mounted)
    nearest = nearest_name(key, mounted_group) or (mounted_group[0] if mounted_group else nearest_name(key, mounted))
    message = "no file mounts a group under this name"
    return NowhereMounted(message, key=key, where=where, expected=expected, nearest=nearest)


def _chosen_twice(key: str, repository: ReadFiles, parsed: Sequence[Override]) -> ConfigError:
    message = "an option of this group is selected already"
    culprit = next((o for o in parsed if o.is_add() and name_of(o) == key), None)
    if culprit is not None:
        expected = f"{key}=<option> without the plus sign"
        return ConfigError(message, key=key, where=where_of(culprit), expected=expected)
    # Find the defaults list that selects an option of the config group ``key`` without the word ``override``.
    places = [(file, e) for file, e in _entries(repository) if e.key.lstrip("/") == key and not e.override]
    where = show_file(places[0][0], places[0][1].line) if places else None
    option = str(places[0][1].value) if places else "<option>"
    return ConfigError(message, key=key, where=where, expected=f"- override /{key}: {option}, after the other entries")


def _entries(repository: ReadFiles) -> Iterator[tuple[Path, lookup.DefaultsEntry]]:
    """Yield each entry of the defaults lists of all config files except the primary config, with the entry's file."""
    for path, loaded in repository.loaded.items():
        if "/" in path:
            yield from ((loaded.file, entry) for entry in lookup.defaults_entries(loaded.file))


def mounted_names(repository: ReadFiles) -> list[str]:
    """Return the names of the config groups that files select, such as ``reward@env.rewards``."""
    entries = (entry for loaded in repository.loaded.values() for entry in lookup.defaults_entries(loaded.file))
    return list(dict.fromkeys(entry.key.lstrip("/") for entry in entries if not entry.override))


def flat(error: BaseException) -> str:
    """Return an error message of Hydra or OmegaConf as one line of text, without internal details."""
    lines = [line.strip() for line in str(error).strip().splitlines()]
    shown = [line for line in lines if line and not line.startswith(("full_key:", "object_type=", "See https"))]
    return " ".join(shown) or type(error).__name__


_FORMS = "key=value, +key=value, ++key=value or ~key"


def merge_problem(problem: Exception, repository: ReadFiles) -> ConfigError:
    """Return the error for a config file that Hydra cannot merge with the files before it in the defaults lists."""
    text = str(problem)
    match, full = _IN_FILE.match(text), re.search(r"full_key: (\S+)", text)
    key = full.group(1) if full else None
    loaded = repository.loaded.get(match.group(1)) if match else None
    line = lookup.scalar_line(loaded.file, key.rsplit(".", 1)[-1]) if loaded and key else None
    message = f"does not merge: {flat(ValueError(text.split('composing config:', 1)[-1]))}"
    return ConfigError(message, key=key, where=show_file(loaded.file, line) if loaded else None)


def _circle(used: ReadFiles, primary: str) -> ConfigError:
    below: dict[str, set[str]] = {}
    for path, loaded in used.loaded.items():
        folder = path.rpartition("/")[0]
        names = [str(item.value) for item in lookup.defaults_items(loaded.file) if isinstance(item, yaml.ScalarNode)]
        below[path] = {f"{folder}/{name}".lstrip("/") for name in names if name != "_self_"}
    message, expected = "the defaults lists form a cycle", "defaults lists without a cycle"
    try:
        TopologicalSorter(below).prepare()
    except CycleError as error:
        # ``CycleError`` lists a cycle of config files in reverse order: each file selects the file before it.
        path, other = error.args[1][1], error.args[1][0]
        file = used.loaded[path].file
        where = show_file(file, lookup.scalar_line(file, other.rpartition("/")[2]))
        message += f": {' -> '.join(reversed(error.args[1]))}"
        return ConfigError(message, key=path, where=where, expected=expected)
    return ConfigError(message, key=primary, expected=expected)


def spaced(overrides: Sequence[str]) -> ConfigError | None:
    """Find an override that the shell has split at spaces: ``key = value``."""
    for index, text in enumerate(overrides):
        before, after = overrides[:index][-1:], overrides[index + 1 :][:1]
        cut = ([*before] if text.startswith("=") else []) + [text] + ([*after] if text.endswith("=") else [])
        if len(cut) > 1 and not any("=" in word.strip("=") for word in cut):
            typed = " ".join(cut)
            expected = f"{''.join(cut)}, without spaces"
            return ConfigError("these are several words", key=typed, where=f"override {typed}", expected=expected)
    return None


def parse_override(text: str, loader: ConfigLoader | None = None) -> Override:
    """Parse an override; raise ConfigError for a text that is not an override. ``glob(...)`` needs the ``loader``."""
    try:
        override = OverridesParser.create().parse_override(text)
        override.config_loader = loader
    except HydraException as error:
        reason = str(error).splitlines()[0].partition(" expecting ")[0]
    else:
        if override.key_or_group:
            return override
        reason = "there is no key"
    element = re.match(r"([^=\[]*)\[(\d+)\]=(.*)", text)
    expected = f"{element[1]}.{element[2]}={element[3]}" if element else _FORMS
    key, equals, value = text.partition("=")
    if not equals and ":" in key:
        expected = key.replace(":", "=", 1).replace("= ", "=")
    if equals and re.search(r"[*?^$\\|(]", value) and not re.search(r"[\"']", value):
        expected = f"""quotes around text with such characters, inside quotes of the shell: "{key}=['...']\""""
    raise ConfigError(f"not an override: {reason}", key=text, where=f"override {text}", expected=expected)


def sweep_problem(override: Override) -> ConfigError:
    """Return the error for an override with several values in a command that composes one config."""
    key = override.key_or_group
    text = str(override.input_line).split("=", 1)[-1]
    forms = "; -m (--multirun) trains each of several"
    forms += "" if "(" in text else f"; a list is written {key}=[{text}], text with commas {key}='{text}'"
    return ConfigError("several values for one run", key=key, where=where_of(override), expected=f"one value{forms}")


def override_problem(problem: Exception, override: Override, cfg: DictConfig, groups: Sequence[str]) -> ConfigError:
    """Return the error for an override that Hydra cannot apply to the config ``cfg``."""
    key, where = override.key_or_group, where_of(override)
    # Suggest Hydra's own settings only for an override of a Hydra setting.
    plain = OmegaConf.to_container(cfg, resolve=False)
    tree = plain if isinstance(plain, dict) else {}
    shown = {str(name): node for name, node in tree.items() if (name == "hydra") == override.is_hydra_override()}
    existing = split_path(key) in set(lookup.node_paths(shown))
    if existing and override.is_add():
        expected = str(override.input_line).lstrip("+") + " without the plus sign"
        return ConfigError("the key has a value already", key=key, where=where, expected=expected)
    if existing and override.is_delete() and lookup.at(shown, split_path(key)) is None:
        expected = f"nothing to remove: 'wheelleg explain task=... {key}' shows where it is set to null"
        return ConfigError("the key is null already", key=key, where=where, expected=expected)
    if existing and override.is_delete():
        return ConfigError(flat(problem), key=key, where=where, expected=f"~{key} without a value")
    strange = re.search(r"Key '(.+?)' is not in struct", str(problem.__cause__ or problem))
    if existing and strange:
        part, names = strange.group(1), [str(known) for known in lookup.section_at(shown, key)]
        full = dotted([*split_path(key), part])
        known = f"one of {', '.join(names)}; " if names else ""
        expected, nearest = f"{known}+{full}=value adds one, ++{key}={{...}} merges", nearest_name(part, names)
        return AbsentKey("there is no such key", key=full, where=where, expected=expected, nearest=nearest)
    if existing or not isinstance(problem, ConfigCompositionException) or "Error merging" in str(problem):
        return ConfigError(flat(problem.__cause__ or problem), key=key, where=where)
    # Suggest `+key=value` for a valid config key that no config file sets.
    if not override.is_delete() and is_settable(shown, split_path(key)):
        expected = "+" + str(override.input_line).lstrip("+")
        return AbsentKey("no file of the task sets this key", key=key, where=where, expected=expected)
    top = None if split_path(key)[0] in shown else nearest_name(key, [*shown, *groups])
    nearest = top or nearest_path(key, [dotted(path) for path in lookup.node_paths(shown)])
    expected = _expected_at(shown, key, groups)
    return AbsentKey("there is no such key", key=key, where=where, expected=expected, nearest=nearest)


def _expected_at(tree: dict[str, object], path: str, groups: Sequence[str]) -> str:
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
    """Return the existing config path that is most similar to ``path``."""
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
