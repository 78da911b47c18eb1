"""Find every mistake in a config without a simulation, and report all of them at once.

The function ``check`` returns the mistakes of a composed config; ``find_mistakes`` composes the config first. If a
broken file stops Hydra, ``find_mistakes`` treats this file as empty, so that it finds the other mistakes too.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from hydra._internal.config_repository import CachingConfigRepository
from hydra.core.default_element import GroupDefault, InputDefault
from hydra.core.override_parser.types import Override
from hydra.errors import MissingConfigException
from hydra.plugins.config_source import ConfigResult
from omegaconf import OmegaConf

from wheelleg_exp.config import schema
from wheelleg_exp.config.checking import check_defaults_lists as lists
from wheelleg_exp.config.checking import check_terms
from wheelleg_exp.config.checking.check_agent import check_agent
from wheelleg_exp.config.checking.check_robot_names import check_robot, read_names
from wheelleg_exp.config.composing.compose import Composed, compose, override_texts
from wheelleg_exp.config.composing.config_loader import Loader, Repository, package_header, package_meant, usual_header
from wheelleg_exp.config.composing.hydra_errors import DoesNotMerge, NowhereMounted
from wheelleg_exp.config.config_errors import AbsentKey, UnknownName, override_of, parts, raise_all
from wheelleg_exp.config.tree_lookup import at, section_at
from wheelleg_exp.constraints import Count
from wheelleg_exp.errors import ConfigError, MissingValue, UnreadKey, nearest_name
from wheelleg_exp.paths import show_file
from wheelleg_exp.rl.options import batch_errors
from wheelleg_exp.terms.config_sections import section_errors
from wheelleg_exp.terms.config_values import fits
from wheelleg_exp.terms.key_syntax import dotted, split_path
from wheelleg_exp.terms.term_binding import NotAllowed


@dataclass
class Leniency:
    """The config files and ``override`` entries that a ``TolerantLoader`` ignores because they contain mistakes.

    ``empty`` contains the names of config files that are treated as empty, such as ``reward/alive``. ``unused``
    contains config groups, such as ``reward@env.rewards``, whose ``override`` entries in defaults lists are ignored.
    ``failed`` names the last config file that Hydra could not load.
    """

    empty: set[str] = field(default_factory=set)
    unused: set[str] = field(default_factory=set)
    failed: str | None = None


class _TolerantRepository(Repository):
    def __init__(self, delegate: Any, leniency: Leniency) -> None:
        super().__init__(delegate)
        self._leniency = leniency

    def load_config(self, config_path: str) -> ConfigResult | None:
        if config_path in self._leniency.empty:
            found = self.files(config_path)
            header = {"package": package_header(found[0]) if found else None}
            return ConfigResult("wheelleg", config_path, OmegaConf.create({}), header, [])
        try:
            result = super().load_config(config_path)
        except ConfigError:
            self._leniency.failed = config_path
            raise
        if result is not None and result.defaults_list:
            # In a defaults list, a group name without a leading slash is relative to the folder of the config file.
            parent = config_path.rpartition("/")[0]
            result.defaults_list = [d for d in result.defaults_list if not self._is_unused(d, parent)]
        return result

    def _is_unused(self, default: InputDefault, parent: str) -> bool:
        if not isinstance(default, GroupDefault) or not default.override:
            return False
        group = (default.group or "").lstrip("/")
        names = {f"{name}@{default.package or ''}".rstrip("@") for name in (group, f"{parent}/{group}")}
        return bool(names & self._leniency.unused)


class TolerantLoader(Loader):
    """A Hydra config loader that can ignore broken config files, and wrong ``override`` entries in defaults lists."""

    def __init__(self, config_dirs: Sequence[Path], leniency: Leniency) -> None:
        super().__init__(config_dirs)
        self._leniency = leniency

    def _parse_overrides_and_create_caching_repo(
        self, config_name: str | None, overrides: list[str]
    ) -> tuple[list[Override], CachingConfigRepository]:
        parsed, _ = super()._parse_overrides_and_create_caching_repo(config_name, overrides)
        # The parent class's config repository contains the folders in ``hydra.searchpath``, so wrap this repository.
        self.repository_used = _TolerantRepository(self.repository_used.delegate, self._leniency)
        return parsed, self.repository_used


def check(composed: Composed) -> list[ConfigError]:
    """Return every mistake in a composed config that can be found without a simulation.

    ``check`` validates config keys, value types and ranges, manager terms, classes in the agent config, joint and body
    names, and config files. Each returned error contains the file and line, or the override, of the wrong value.
    """
    files = lists.mounted_files(composed)
    misplaced = lists.check_headers(composed, files)
    if misplaced:
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
    """Remove errors that another error causes, such as a missing ``weight`` if the config has a misspelled ``wieght``.

    Also remove errors below a key that no code reads, except errors about a ``_target_`` in a forbidden package.
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
    """Return whether an error can be caused by the missing values of the config keys in ``lost``.

    An entry of ``lost`` with a leading dot, such as ``.alive``, means the key ``alive`` in any config section. An empty
    text in ``lost`` means that the values of all config keys can be missing.
    """
    key = error.key or ""
    if isinstance(error, UnknownName) and is_at_or_below(error.named, lost):
        return True
    if isinstance(error, AbsentKey) and "" in lost:
        return True
    above = isinstance(error, MissingValue) and any(name.startswith(f"{key}.") for name in lost)
    return above or is_at_or_below(key, lost)


def is_at_or_below(key: str, places: Collection[str]) -> bool:
    """Return whether a config key equals, or is below, a key in ``places``; ``.alive`` means ``alive`` at any depth."""
    return any(f"{p}." in f".{key}." if p.startswith(".") else f"{key}.".startswith(f"{p}.") for p in places)


def _check_robot(config: Mapping[str, Any], asset_roots: Sequence[Path]) -> list[ConfigError]:
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


def check_tree(config: Mapping[str, Any], root: type) -> list[ConfigError]:
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
    errors += check_terms.check_drawn(config)
    errors += check_agent(config.get("agent"), groups)
    if fits(num_envs, Count) and not any(f"{error.key}.".startswith("agent.") for error in errors):
        errors += batch_errors(config["agent"], num_envs)
    return errors


def require_valid(composed: Composed) -> None:
    """Raise one ConfigError that lists every mistake that ``check`` finds."""
    errors = check(composed)
    if errors:
        raise_all(errors)


def _groups_without_terms(config: Mapping[str, Any]) -> Iterator[ConfigError]:
    """Yield an error for each observation group that has settings, no terms, and a name similar to another group's."""
    groups = section_at(config, "env.observations")
    with_terms = [str(n) for n, g in groups.items() if isinstance(g, Mapping) and "terms" in g]
    for name, group in groups.items():
        if isinstance(group, Mapping) and "terms" not in group and (near := nearest_name(str(name), with_terms)):
            key, expected = f"env.observations.{name}", "settings for " + ", ".join(groups)
            message = "there are settings for this group, and no terms are mounted in it"
            yield ConfigError(message, key=key, expected=expected, nearest=near)


_MOST_ATTEMPTS = 50


@dataclass
class _Search:
    """A search for all mistakes of a config: compose, remove the mistake that stops Hydra, and repeat."""

    overrides: list[str]
    primary: str
    folders: tuple[Path, ...]
    found: list[ConfigError] = field(default_factory=list)
    # Hydra could not determine the values of the config keys in ``lost``, because of an invalid file or value.
    lost: list[str] = field(default_factory=list)
    leniency: Leniency = field(default_factory=Leniency)
    loader: TolerantLoader | None = None

    def compose(self) -> Composed | None:
        """Compose a config without files, overrides, and values that Hydra rejects; return None if this fails, too."""
        for _ in range(_MOST_ATTEMPTS):
            try:
                return compose(self.overrides, primary=self.primary, config_dirs=self.folders, loader=self._make_loader)
            except ConfigError as error:
                self.found += [part for part in parts(error) if not follows_from(part, self.lost)]
                if not self._take_out(error):
                    return None
        return None

    def _make_loader(self, folders: Sequence[Path]) -> TolerantLoader:
        self.loader = TolerantLoader(folders, self.leniency)
        return self.loader

    def _take_out(self, error: ConfigError) -> bool:
        """Remove the override, file, or value that caused an error; return False if nothing was removed."""
        blamed = {override_of(part) for part in parts(error)} - {None}
        kept = [text for text in self.overrides if text not in blamed]
        if len(kept) < len(self.overrides):
            self.overrides = kept
            return True
        if blamed:
            return False  # The shell splits `key = value` into three words, so ``overrides`` lacks the whole text.
        return self._empty_file(error) or self._skip_default(error) or self._null_values(error)

    def _empty_file(self, error: ConfigError) -> bool:
        cause = error.__cause__
        path, self.leniency.failed = self.leniency.failed, None
        if isinstance(cause, MissingConfigException):
            path = (cause.missing_cfg_file or "").removesuffix(".yaml")
        elif path is None and isinstance(error, DoesNotMerge):
            path = error.config_path
        if not path or path == self.primary or path in self.leniency.empty:
            return False
        self.leniency.empty.add(path)
        self.lost += self._places(path)
        if error.nearest:  # If the user wrote ``aliv``, for example, do not report that ``alive`` is missing.
            self.lost.append(f".{error.nearest}")
        return True

    def _places(self, path: str) -> list[str]:
        """Return the config keys that a missing or invalid config file could set; an empty text means all keys."""
        group, _, name = path.rpartition("/")
        if self.loader is None:
            return [""]
        files = self.loader.repository_used.files(path)
        package = (package_meant(files[0]) if files else None) or usual_header(self.loader.repository_used, group)
        if package is not None:
            return ["" if package == "_global_" else package, group]
        return [f".{name}", group]

    def _skip_default(self, error: ConfigError) -> bool:
        if error.key is None or not isinstance(error, NowhereMounted) or error.key in self.leniency.unused:
            return False
        self.leniency.unused.add(error.key)
        return True

    def _null_values(self, error: ConfigError) -> bool:
        keys = [part.key for part in parts(error) if part.key and part.where]
        plain = [key for key in keys if "[" not in key and key not in self.lost]
        if not plain or len(plain) < len(keys):
            return False
        self.lost += plain
        self.overrides = [*self.overrides, *(f"++{key}=null" for key in plain)]
        return True


def find_mistakes(
    overrides: Sequence[str] = (), *, primary: str = "train", config_dirs: Sequence[Path] = ()
) -> tuple[Composed | None, list[ConfigError]]:
    """Compose and check a config, and return the config (None if Hydra cannot compose it) and all mistakes.

    ``find_mistakes`` ignores overrides and files that Hydra cannot compose, and checks the remaining config. An
    error is not returned if an ignored override or config file can be the cause of the error.
    """
    search = _Search(override_texts(overrides), primary, tuple(config_dirs))
    composed = search.compose()
    behind = [] if composed is None or "" in search.lost else check(composed)
    found = [*search.found, *(error for error in behind if not follows_from(error, search.lost))]
    mistakes = list({str(error): error for error in found}.values())
    return (composed if not search.found else None), mistakes


def compose_valid(overrides: Sequence[str] = (), *, config_dirs: Sequence[Path] = ()) -> Composed:
    """Compose a config, check the config, and return the config. One ConfigError lists all mistakes in the config."""
    composed, mistakes = find_mistakes(overrides, config_dirs=config_dirs)
    if mistakes:
        raise_all(mistakes)
    assert composed is not None
    return composed
