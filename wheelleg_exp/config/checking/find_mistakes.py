"""Find every mistake in a config without a simulation, and report all of them at once.

``check`` returns the mistakes of a config that Hydra has composed. ``find_mistakes`` composes the config first.
When Hydra stops at a broken file, it composes again with that file counted as empty, so that it also finds the
mistakes after the broken file.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
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
from wheelleg_exp.config.checking.check_agent import check_agent
from wheelleg_exp.config.checking.check_defaults_lists import (
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
    unread_in_files,
    without_strays,
)
from wheelleg_exp.config.checking.check_robot_names import check_robot, read_names
from wheelleg_exp.config.checking.check_terms import (
    check_drawn,
    check_folders,
    check_groups_in_use,
    check_links,
    check_nested_targets,
    check_sections,
    recorded_errors,
)
from wheelleg_exp.config.composing.compose import Composed, compose, override_texts
from wheelleg_exp.config.composing.config_loader import Loader, Repository, package_header, package_meant, usual_header
from wheelleg_exp.config.composing.hydra_errors import DoesNotMerge, NowhereMounted
from wheelleg_exp.config.config_errors import AbsentKey, UnknownName, override_of, parts, raise_all
from wheelleg_exp.config.config_tree import at, section_at
from wheelleg_exp.errors import ConfigError, MissingValue, UnreadKey, nearest_name
from wheelleg_exp.paths import show_file
from wheelleg_exp.terms.config_sections import ObservationGroup, Section, section_errors
from wheelleg_exp.terms.config_values import value_errors
from wheelleg_exp.terms.key_syntax import dotted, split_path
from wheelleg_exp.terms.term_binding import NotAllowed


@dataclass
class Leniency:
    """The files and overrides that the tolerant loader ignores.

    Attributes:
        empty: config paths that count as empty files.
        unused: ``group@package`` of ignored overrides in defaults lists.
        failed: the config path whose loading failed last.
    """

    empty: set[str] = field(default_factory=set)
    unused: set[str] = field(default_factory=set)
    failed: str | None = None


class _TolerantRepository(Repository):
    def __init__(self, delegate: Any, leniency: Leniency) -> None:
        super().__init__(delegate)
        self._leniency = leniency

    def load_config(self, config_path: str) -> ConfigResult | None:
        """Load a config for Hydra. A config path in ``Leniency.empty`` counts as an empty file."""
        if config_path in self._leniency.empty:
            header = {"package": self._package(config_path)}
            return ConfigResult("wheelleg", config_path, OmegaConf.create({}), header, [])
        try:
            result = super().load_config(config_path)
        except ConfigError:
            self._leniency.failed = config_path
            raise
        if result is not None and result.defaults_list:
            parent = config_path.rpartition("/")[0]  # a group without a leading slash is relative to this folder
            result.defaults_list = [d for d in result.defaults_list if not self._is_unused(d, parent)]
        return result

    def _package(self, config_path: str) -> str | None:
        found = self.files(config_path)
        return package_header(found[0]) if found else None

    def _is_unused(self, default: InputDefault, parent: str) -> bool:
        if not isinstance(default, GroupDefault) or not default.override:
            return False
        group = (default.group or "").lstrip("/")
        names = {f"{name}@{default.package or ''}".rstrip("@") for name in (group, f"{parent}/{group}")}
        return bool(names & self._leniency.unused)


class TolerantLoader(Loader):
    """A ``Loader`` that ignores the files and overrides of its ``Leniency``."""

    def __init__(self, config_dirs: Sequence[Path], leniency: Leniency) -> None:
        super().__init__(config_dirs)
        self._leniency = leniency

    def _parse_overrides_and_create_caching_repo(
        self, config_name: str | None, overrides: list[str]
    ) -> tuple[list[Override], CachingConfigRepository]:
        parsed, _ = super()._parse_overrides_and_create_caching_repo(config_name, overrides)
        # The parent's method has completed the search path of the repository, which is reused here.
        self.repository_used = _TolerantRepository(self.repository_used.delegate, self._leniency)
        return parsed, self.repository_used


def check(composed: Composed) -> list[ConfigError]:
    """Return every mistake that can be found without a simulation.

    The checks cover: keys, types and ranges of the fixed part; each term's target, which must be allowed, and its
    parameters; settings for terms that are not selected; the agent's classes and observation groups; the names of
    joints, bodies and terms; the files' package lines, their terms and their order. Each error contains the file
    and line, or the override, that the value came from.
    """
    files = mounted_files(composed)
    misplaced = check_headers(composed, files)
    if misplaced:  # otherwise every key at the wrong place would be reported, too
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
    """Leave out errors that only follow from a key that nothing reads.

    These are errors inside such a key, and a missing key if the unread key is its misspelling. A target that is not
    allowed is always reported.
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
    """Return whether an error is about a key whose content is unknown, and so can be a consequence of that.

    Args:
        error: the error.
        lost: keys with unknown content. One that starts with a dot is a part of a key at any place; an empty one means
            every key.
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
    """Return whether a key is one of the places or below one. A place with a leading dot matches at any depth."""
    return any(
        f"{place}." in f".{key}." if place.startswith(".") else f"{key}.".startswith(f"{place}.") for place in places
    )


def _check_robot(config: Mapping[str, Any], asset_roots: Sequence[Path]) -> list[ConfigError]:
    """Check names against the robot. If the sections that select the robot have mistakes, skip the check."""
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
    """The keys of ``env.robot`` that are needed to read the robot's names."""

    asset: str
    base: Literal["auto", "floating", "fixed"] = "auto"


def check_tree(config: Mapping[str, Any], root: type) -> list[ConfigError]:
    """Return every mistake in a plain tree, without places. ``root`` is the dataclass of the tree's top level."""
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
    """Raise one ConfigError with every mistake that ``check`` finds, one per line."""
    errors = check(composed)
    if errors:
        raise_all(errors)


def _placed(errors: list[ConfigError], composed: Composed, files: Sequence[MountedFile]) -> list[ConfigError]:
    """Add the place of each value, and leave out repeated errors: one line of a file can set several keys."""
    seen: dict[tuple[str | None, ...], ConfigError] = {}
    for error in errors:
        if error.where is None and error.key is not None:
            emptied = emptied_by(composed, error.key) if isinstance(error, MissingValue) else None
            error.where = emptied or composed.provenance.where(error.key)
        if error.where is None and isinstance(error, MissingValue):  # a whole section is missing: name the task's file
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
        ConfigError(
            "a silenced rule has no reason", key=f"check.silence.{name}", expected="why the finding is accepted"
        )
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
    """Return the observation group with terms whose name is most similar to ``name``."""
    return nearest_name(str(name), [str(n) for n, g in groups.items() if isinstance(g, Mapping) and "terms" in g])


_MOST_ATTEMPTS = 50


@dataclass
class _Search:
    """A search that removes each mistake that stops Hydra, until the config composes."""

    overrides: list[str]
    primary: str
    folders: tuple[Path, ...]
    found: list[ConfigError] = field(default_factory=list)
    lost: list[str] = field(default_factory=list)  # keys whose content is unknown, because their file was ignored
    leniency: Leniency = field(default_factory=Leniency)
    loader: TolerantLoader | None = None

    def compose(self) -> Composed | None:
        """Compose, remove what fails, and repeat, until composing succeeds or nothing more can be removed."""
        for _ in range(_MOST_ATTEMPTS):
            try:
                return compose(self.overrides, primary=self.primary, config_dirs=self.folders, loader=self._make_loader)
            except ConfigError as error:
                self.found += [part for part in parts(error) if not self.follows(part)]
                if not self._take_out(error):
                    return None
        return None

    def _make_loader(self, folders: Sequence[Path]) -> TolerantLoader:
        self.loader = TolerantLoader(folders, self.leniency)
        return self.loader

    def _take_out(self, error: ConfigError) -> bool:
        """Remove the override, file or value that caused the error; return False if the cause is unknown."""
        blamed = {override_of(part) for part in parts(error)} - {None}
        kept = [text for text in self.overrides if text not in blamed]
        if len(kept) < len(self.overrides):
            self.overrides = kept
            return True
        if blamed:  # the error names several words that are not one override
            return False
        return self._empty_file(error) or self._skip_default(error) or self._null_values(error)

    def _empty_file(self, error: ConfigError) -> bool:
        """Treat a broken or missing file as empty."""
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
        if error.nearest:  # settings for the option that was meant are not mistakes
            self.lost.append(f".{error.nearest}")
        return True

    def _places(self, path: str) -> list[str]:
        """Return the keys that a file would have set; "" means every key."""
        group, _, name = path.rpartition("/")
        if self.loader is None:
            return [""]
        files = self.loader.repository_used.files(path)
        package = (package_meant(files[0]) if files else None) or usual_header(self.loader.repository_used, group)
        if package is not None:
            return ["" if package == "_global_" else package, group]
        return [f".{name}", group]

    def follows(self, error: ConfigError) -> bool:
        """Return whether an error only follows from something that was removed."""
        return follows_from(error, self.lost)

    def _skip_default(self, error: ConfigError) -> bool:
        """Ignore an ``override`` in a defaults list that overrides nothing."""
        if error.key is None or not isinstance(error, NowhereMounted) or error.key in self.leniency.unused:
            return False
        self.leniency.unused.add(error.key)
        return True

    def _null_values(self, error: ConfigError) -> bool:
        """Set values to null that are missing or cannot be resolved."""
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
    """Compose and check a config, and return it with all mistakes. Without mistakes it equals ``compose``'s result.

    A mistake that stops Hydra (a wrong override, a broken or missing file, a missing value) is removed, and the
    remaining config is checked. Mistakes that only follow from the removal are left out.

    Args:
        overrides: Hydra overrides.
        primary: name of the primary config.
        config_dirs: the user's config folders.

    Returns:
        The config, or None if Hydra could not compose it; and the mistakes, first those that stop Hydra.
    """
    search = _Search(override_texts(overrides), primary, tuple(config_dirs))
    composed = search.compose()
    behind = [] if composed is None or "" in search.lost else check(composed)
    mistakes = _once([*search.found, *(error for error in behind if not search.follows(error))])
    return (composed if not search.found else None), mistakes


def compose_valid(overrides: Sequence[str] = (), *, config_dirs: Sequence[Path] = ()) -> Composed:
    """Compose and check a config, and return it.

    Raises:
        ConfigError: every mistake in the config, if there is any.
    """
    composed, mistakes = find_mistakes(overrides, config_dirs=config_dirs)
    if mistakes:
        raise_all(mistakes)
    assert composed is not None
    return composed


def _once(errors: Sequence[ConfigError]) -> list[ConfigError]:
    return list({str(error): error for error in errors}.values())
