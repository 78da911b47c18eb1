"""Turning what Hydra raises into one ConfigError: key, place, what was expected, nearest name."""

from __future__ import annotations

import copy
import re
from collections.abc import Sequence
from graphlib import CycleError, TopologicalSorter

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

from wheelleg_exp.config.checking.diagnose_groups import (
    IN_FILE,
    defaults_problem,
    flat,
    missing_option,
    mounts,
    option_problems,
    where_of,
)
from wheelleg_exp.config.composing.headers import missing_headers
from wheelleg_exp.config.composing.loader import COMPOSING_ERRORS, Loader, Repository
from wheelleg_exp.config.explaining.fixed_keys import KEYS
from wheelleg_exp.config.problems import AbsentKey, join
from wheelleg_exp.config.tree import Keys, at, defaults_items, dotted, node_paths, scalar_line, show_file, split_path
from wheelleg_exp.errors import ConfigError, nearest_name

_FORMS = "key=value, +key=value, ++key=value or ~key"


class DoesNotMerge(ConfigError):
    """The file at ``config_path``, as Hydra names it, does not merge with those before it."""

    config_path: str | None = None


def explain(error: Exception, loader: Loader, primary: str, overrides: Sequence[str]) -> ConfigError:
    """Return the ConfigError for what went wrong while composing.

    Args:
        error: what Hydra raised.
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
    """Tell of a file whose defaults list leads back to it, as far as files of one folder name each other."""
    below: dict[str, set[str]] = {}
    for path, loaded in used.loaded.items():
        folder = path.rpartition("/")[0]
        names = [str(item.value) for item in defaults_items(loaded.file) if isinstance(item, yaml.ScalarNode)]
        below[path] = {f"{folder}/{name}".lstrip("/") for name in names if name != "_self_"}
    message, expected = "the defaults lists lead back to themselves", "no circle of defaults"
    try:
        TopologicalSorter(below).prepare()
    except CycleError as error:
        path, other = error.args[1][1], error.args[1][0]  # each is named by the next
        file = used.loaded[path].file
        where = show_file(file, scalar_line(file, other.rpartition("/")[2]))
        return ConfigError(
            f"{message}: {' -> '.join(reversed(error.args[1]))}", key=path, where=where, expected=expected
        )
    return ConfigError(message, key=primary, expected=expected)


def _spaced(overrides: Sequence[str]) -> ConfigError | None:
    """Find an override that blanks have cut into several words: ``key = value``."""
    for index, text in enumerate(overrides):
        before, after = overrides[:index][-1:], overrides[index + 1 :][:1]
        cut = ([*before] if text.startswith("=") else []) + [text] + ([*after] if text.endswith("=") else [])
        if len(cut) > 1 and not any("=" in word.strip("=") for word in cut):
            said = " ".join(cut)
            expected = f"{''.join(cut)}, without blanks"
            return ConfigError("this is several words", key=said, where=f"override {said}", expected=expected)
    return None


def unreadable(text: str) -> ConfigError | None:
    """Return what is wrong with the form of an override; None when it can be read."""
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
        expected = f"""text with such signs in quotes, twice on the command line: "{key}=['...']\""""
    return ConfigError(f"not an override: {reason}", key=text, where=f"override {text}", expected=expected)


def _sweep(override: Override) -> ConfigError:
    key = override.key_or_group
    text = str(override.input_line).split("=", 1)[-1]
    forms = "; -m (--multirun) trains each of several"
    forms += "" if "(" in text else f"; a list is written {key}=[{text}], text with commas {key}='{text}'"
    return ConfigError("several values for one run", key=key, where=where_of(override), expected=f"one value{forms}")


def _by_stage(error: Exception, loader: Loader, primary: str, parsed: Sequence[Override]) -> ConfigError:
    """Compose again step by step, to see which one fails."""
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
        before = copy.deepcopy(cfg)  # one that fails may leave an empty mapping where null was
        try:
            ConfigLoaderImpl._apply_overrides_to_config([override], cfg)
        except COMPOSING_ERRORS as problem:
            problems.append(_override_problem(problem, override, before, loader.groups()))
    return join(problems) if problems else ConfigError(flat(error), key=primary)


def _mounted_groups(repository: Repository, parsed: Sequence[Override]) -> set[str]:
    """Return the groups that something mounts at a package of its own."""
    names = [*mounts(repository), *(o.get_key_element().lstrip("+~") for o in parsed)]
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
    """Explain an override that cannot be applied."""
    key = override.key_or_group
    # Hydra's own keys are shown to those who ask for them.
    shown = {name: node for name, node in _plain(cfg).items() if (name == "hydra") == override.is_hydra_override()}
    existing = _existing(shown, key)
    if existing and override.is_add():
        plain = str(override.input_line).lstrip("+")
        return ConfigError(
            "there is a value already",
            key=key,
            where=where_of(override),
            expected=f"{plain} without the plus sign",
        )
    if existing and override.is_delete() and at(shown, split_path(key)) is None:
        expected = f"nothing to remove: 'wheelleg explain task=... {key}' names who set it so"
        return ConfigError("is null already", key=key, where=where_of(override), expected=expected)
    if existing and override.is_delete():
        return ConfigError(flat(problem), key=key, where=where_of(override), expected=f"~{key} without a value")
    strange = re.search(r"Key '(.+?)' is not in struct", str(problem.__cause__ or problem))
    if existing and strange:
        return _unknown_part(shown, override, strange.group(1))
    if existing or not isinstance(problem, ConfigCompositionException) or "Error merging" in str(problem):
        return ConfigError(flat(problem.__cause__ or problem), key=key, where=where_of(override))
    if (
        key in KEYS and not override.is_delete() and at(shown, split_path(key)[:-1]) is not None
    ):  # optional, and not set by any file
        plain = str(override.input_line).lstrip("+")
        return AbsentKey("no file of the task sets it", key=key, where=where_of(override), expected=f"+{plain}")
    top = None if split_path(key)[0] in shown else nearest_name(key, [*shown, *groups])
    return AbsentKey(
        "there is no such key",
        key=key,
        where=where_of(override),
        expected=_expected_at(shown, key, groups),
        nearest=top or nearest_path(key, [dotted(path) for path in node_paths(shown)]),
    )


def _unknown_part(tree: dict[str, object], override: Override, name: str) -> ConfigError:
    """Explain a mapping that would bring a key which is not there."""
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
    """Say which keys there are where the path leaves the tree."""
    node: object = tree
    walked: list[str] = []
    for part in split_path(path):
        if not isinstance(node, dict) or part not in node:
            break
        walked.append(part)
        node = node[part]
    place = dotted(walked)
    if node is None:
        return f"'{place}' to be a mapping; it is null: 'wheelleg explain task=... {place}' names who set it so"
    if not isinstance(node, dict):
        return f"'{place}' to be a mapping; it is a single value"
    names = ", ".join(str(name) for name in node)
    if not walked:
        return f"one of {names}, or a group: {', '.join(groups)}"
    return f"one of {names} in {place}" if names else f"nothing: {place} is empty; +{path}=value adds a key"


def nearest_path(path: str, paths: Sequence[str]) -> str | None:
    """Return the existing path most like ``path``: key by key first, then by the whole text."""
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
