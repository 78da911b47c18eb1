"""Compose config files with Hydra's loader, without global Hydra state, and note every mistake instead of the first.

Equally named files need a ``# @replaces`` line. If most files of a group have a ``# @package`` line, all need it.
"""

from __future__ import annotations

import copy
import functools
import re
import warnings
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import yaml
from hydra import version
from hydra._internal.config_loader_impl import ConfigLoaderImpl, get_overrides_dirname
from hydra._internal.config_repository import CachingConfigRepository, IConfigRepository
from hydra._internal.utils import create_config_search_path
from hydra.core.default_element import GroupDefault, ResultDefault
from hydra.core.object_type import ObjectType
from hydra.core.override_parser.types import Override
from hydra.core.singleton import Singleton
from hydra.core.utils import JobRuntime, setup_globals
from hydra.errors import HydraException
from hydra.plugins.config_source import ConfigResult, ConfigSource
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf, flag_override, open_dict
from omegaconf._utils import get_yaml_loader

from wheelleg_exp.config.composing import hydra_errors
from wheelleg_exp.config.composing.hydra_errors import COMPOSING_ERRORS, NowhereMounted, where_of
from wheelleg_exp.config.composing.provenance import MISSING, ConfigFile, Provenance
from wheelleg_exp.config.composing.sized_values import register
from wheelleg_exp.config.config_errors import follows_from
from wheelleg_exp.config.tree_lookup import file_text, yaml_node
from wheelleg_exp.errors import ConfigError, nearest_name
from wheelleg_exp.packages import config_folder, join_folder
from wheelleg_exp.paths import configs_dir, show_file
from wheelleg_exp.plain_data import Unreadable
from wheelleg_exp.terms.key_syntax import split_path

_MARK = re.compile(r"^\s*#\s*@\s*replaces\b[ :]*(.*?)\s*$", re.IGNORECASE)


def _lines_of(file: Path) -> list[str]:
    try:
        return file_text(file).splitlines()
    except (OSError, UnicodeDecodeError):
        return []


def replaced_by(file: Path) -> tuple[str, int] | None:
    """Return the config that a file replaces by a line ``# @replaces reward/alive``, and the line's number."""
    for number, line in enumerate(_lines_of(file), 1):
        if line.strip() and not line.lstrip().startswith("#"):
            return None
        match = _MARK.match(line)
        if match is not None:
            return match.group(1), number
    return None


def chosen_file(config_path: str, files: Sequence[Path]) -> Path:
    """Return the file to read for a config such as ``reward/alive``, if several folders contain a file of that name.

    A file with the line ``# @replaces reward/alive`` has priority over files of the same name in other config folders.
    Raise ConfigError for a wrong or repeated ``# @replaces`` line, and for two equally named files without this line.
    """
    different = list({file.resolve(): file for file in reversed(files)}.values())[::-1]
    marks = {file: replaced_by(file) for file in different}
    line = f"'# @replaces {config_path}'"

    def wrong(file: Path, message: str, expected: str) -> ConfigError:
        mark = marks[file]
        where = show_file(file, mark[1] if mark is not None else None)
        return ConfigError(message, key=config_path, where=where, expected=expected)

    for file, mark in marks.items():
        if mark is not None and mark[0] != config_path:
            message = f"this file says that it replaces '{mark[0]}', but a file can only replace a file of its own name"
            raise wrong(file, message, line)
    plain = [file for file in different if marks[file] is None]
    replacing = [file for file in different if marks[file] is not None]
    if len(plain) > 1:
        expected = "a name that no stock config and no other config folder has, "
        expected += f"or the line {line} at its top, to replace the other file on purpose"
        raise wrong(plain[1], f"this file is never read, because {show_file(plain[0])} has the same name", expected)
    if len(replacing) > 1:
        message = f"this file and {show_file(replacing[0])} both replace '{config_path}'"
        raise wrong(replacing[1], message, f"one file that replaces '{config_path}'")
    if not plain:
        message = f"there is no other '{config_path}' that this file can replace"
        raise wrong(replacing[0], message, "a file without that line, or with the name of the file that it replaces")
    return replacing[0] if replacing else files[0]


_VERSION_BASE = "1.3"
_HEADER = re.compile(r"^\s*#+\s*@package +(\S+)\s*$")
_PACKAGE_LINE = re.compile(r"^\s*#+\s*@\s*package\b", re.IGNORECASE)
_MEANT = re.compile(r"^\s*#+\s*@\s*package[ :]+(\S+)\s*$", re.MULTILINE | re.IGNORECASE)


@contextmanager
def hydra_globals() -> Iterator[None]:
    """Set Hydra's global state (version base and job name) inside the ``with`` block; then restore the old state."""
    kinds = (version.VersionBase, JobRuntime)
    before = {kind: Singleton._instances.pop(kind, None) for kind in kinds}
    try:
        version.setbase(_VERSION_BASE)
        JobRuntime().set("name", "wheelleg")
        setup_globals()
        yield
    finally:
        for kind, instance in before.items():
            if instance is None:
                Singleton._instances.pop(kind, None)
            else:
                Singleton._instances[kind] = instance


class Repository(CachingConfigRepository):
    """A Hydra config repository that passes the mistakes of files to ``note``, and continues with empty configs.

    ``loaded`` contains the files that were read, and ``missing`` the names, such as ``reward/alive``, without a file.
    """

    def __init__(self, delegate: IConfigRepository, note: Callable[[ConfigError, str], None]) -> None:
        super().__init__(delegate)
        self.loaded: dict[str, ConfigFile] = {}
        self.missing: set[str] = set()
        self._note = note

    def load_config(self, config_path: str) -> ConfigResult:
        """Load one config; if its file is missing or invalid, return an empty config with the file's package."""
        key = f"config_path={config_path}"
        if key not in self.cache:
            header: dict[str, str | None] = {"package": None}
            try:
                source = next((s for s in self.get_sources() if s.is_config(config_path)), None)
                if source is not None and source.scheme() == "file":
                    if not self.files(config_path):
                        message = "the config path is not a regular file"
                        raise ConfigError(message, key=config_path, where=source.path)
                    self.cache[key] = self._load_file(config_path)
            except ConfigError as error:
                header["package"] = package_header(self.files(config_path)[0]) if self.files(config_path) else None
                self._note(error, config_path)
                self.cache[key] = ConfigResult("wheelleg", config_path, OmegaConf.create({}), header, [])
            if super().load_config(config_path) is None:
                self.missing.add(config_path)
                self.cache[key] = ConfigResult("wheelleg", config_path, OmegaConf.create({}), header, [])
        return self.cache[key]

    def leave_out(self, name: str) -> bool:
        """Ignore ``override`` entries for a group, such as ``reward@env.rewards``; return whether there are any."""
        found = False
        for key, result in self.cache.items():
            # In a defaults list, a group name without a leading slash is relative to the folder of the config file.
            folder = key.partition("=")[2].rpartition("/")[0]
            for default in list(result.defaults_list or ()):
                if isinstance(default, GroupDefault) and default.override:
                    group, package = str(default.group).lstrip("/"), f"@{default.package}" if default.package else ""
                    if name in (f"{group}{package}", f"{folder}/{group}{package}"):
                        result.defaults_list.remove(default)
                        found = True
        return found

    def files(self, config_path: str) -> list[Path]:
        """Return the files of one name, such as ``reward/alive.yaml``, in all config folders; Hydra reads the first."""
        name = ConfigSource._normalize_file_name(config_path)
        folders = [Path(s.path) for s in self.get_sources() if s.scheme() == "file"]
        return [folder / name for folder in folders if (folder / name).is_file()]

    def _load_file(self, config_path: str) -> ConfigResult:
        file = chosen_file(config_path, self.files(config_path))
        try:
            return self._read(config_path, file)
        except Unreadable as error:
            cause: Exception = error
            line, problem = error.line, f"the file is not valid YAML: {error.problem}"
        except yaml.MarkedYAMLError as error:
            mark = error.problem_mark or error.context_mark
            line = mark.line + 1 if mark is not None else None
            cause, problem = error, f"the file is not valid YAML: {error.problem or error.context}"
        except ConfigError:
            raise
        except Exception as error:  # A value that contradicts its tag, such as `!!int text`, can raise any exception.
            line = _line_of_message(file, str(error))
            cause, problem = error, "the file cannot be read: " + " ".join(str(error).split())
        raise ConfigError(problem, key=config_path, where=show_file(file, line)) from cause

    def _read(self, config_path: str, file: Path) -> ConfigResult:
        """Read a config file like Hydra, but with the faster parser libyaml, and add it to ``loaded``."""
        yaml_node(file)
        text = file.read_text(encoding="utf-8")
        content = yaml.load(text, Loader=_yaml_loader())
        if content is None:
            content = {}
        elif isinstance(content, str):
            content = {content: None}
        if not isinstance(content, dict):
            where, expected = show_file(file, 1), "'key: value' lines"
            message = "the config file does not contain a mapping"
            raise ConfigError(message, key=config_path, where=where, expected=expected)
        name = ConfigSource._normalize_file_name(config_path)
        source = next(s for s in self.get_sources() if s.scheme() == "file" and Path(s.path) / name == file)
        config, header = OmegaConf.create(content), ConfigSource._get_header_dict(text[:512])
        result = ConfigResult(source.provider, f"file://{source.path}", config, header)
        listed = self.delegate._extract_defaults_list(config_path, config)
        result.defaults_list = self.delegate._create_defaults_list(config_path, listed)
        lines = text.splitlines()
        first = next((number for number, line in enumerate(lines, 1) if line.strip()), 0)
        for number, line in enumerate(lines, 1):
            if _PACKAGE_LINE.match(line) and (number != first or not _HEADER.match(line)):
                key, where = line.strip(), show_file(file, number)
                expected = "one '# @package some.path' as the first line of the file"
                raise ConfigError("the file's '# @package' line has no effect", key=key, where=where, expected=expected)
        self.loaded[config_path] = ConfigFile(config_path, file, {k: v for k, v in content.items() if k != "defaults"})
        return result


@functools.cache
def _yaml_loader() -> type[yaml.SafeLoader]:
    """Return OmegaConf's YAML loader with libyaml's parser, if libyaml is installed, because libyaml is much faster."""
    loader = get_yaml_loader()
    fast = getattr(yaml, "CSafeLoader", None)
    return loader if fast is None else type("Loader", (fast, loader), {})


def _line_of_message(file: Path, message: str) -> int | None:
    """Return the number of the only line that contains a text quoted in an error message, or None."""
    lines = _lines_of(file)
    for pair in re.findall(r"'([^']+)'|\"([^\"]+)\"", message):
        hits = [number for number, line in enumerate(lines, 1) if (pair[0] or pair[1]) in line]
        if len(hits) == 1:
            return hits[0]
    return None


class Loader(ConfigLoaderImpl):
    """A Hydra config loader that notes each mistake, continues without it, and records the source of each value.

    ``lost`` contains the keys whose values are unknown because of the noted ``problems``: ``.alive`` means the key
    ``alive`` in any section, and an empty text means all keys. ``files`` are the merged files in Hydra's order.
    """

    repository_used: Repository

    def __init__(self, config_dirs: Sequence[Path] = ()) -> None:
        register()
        path = create_config_search_path(str(configs_dir()))
        schema = path.get_path().pop()
        for folder in map(config_folder, config_dirs):
            join_folder(folder)  # Configs can use Python code of the user project that contains the config folder.
            path.append("config-dir", f"file://{folder}")
        path.append(schema.provider, schema.path)
        super().__init__(path)
        self.problems: list[ConfigError] = []
        self.lost: list[str] = []
        self.overrides: list[Override] = []
        self.files: list[ConfigFile] = []
        self.provenance = Provenance()

    def load(self, primary: str, overrides: Sequence[str]) -> DictConfig:
        """Compose the primary config with overrides; the result has a node ``hydra`` with Hydra's own settings."""
        return self.load_configuration(primary, list(overrides), RunMode.RUN, from_shell=False)

    def load_configuration(
        self,
        config_name: str,
        overrides: list[str],
        run_mode: RunMode,
        from_shell: bool = True,
        validate_sweep_overrides: bool = True,
    ) -> DictConfig:
        """Compose a config as Hydra does, but continue after a mistake; ConfigError if nothing can be composed."""
        self.repository_used = Repository(self.repository, self._note_file)
        if problem := hydra_errors.spaced(overrides):
            self.note(problem)
            raise problem
        self.overrides = []
        for text in overrides:
            try:
                self.overrides.append(hydra_errors.parse_override(text))
            except ConfigError as error:
                self.note(error)
        for override in self.overrides if run_mode is RunMode.RUN else ():
            self._reject(override, [hydra_errors.sweep_problem(override)] if override.is_sweep_override() else [])
        self._search(config_name)
        for override in [o for o in self.overrides if not o.is_sweep_override()]:
            self._reject(override, hydra_errors.option_problems(self, override))
        while True:
            try:
                cfg = super().load_configuration(config_name, [], run_mode, from_shell, validate_sweep_overrides)
                break
            except COMPOSING_ERRORS as error:
                # Hydra has found a mistake in the defaults lists, and has merged nothing yet.
                self._leave_out(hydra_errors.defaults_problem(error, self, config_name), error)
        cfg = self._apply(cfg)
        with open_dict(cfg.hydra):
            own = [override for override in self.overrides if not override.is_hydra_override()]
            cfg.hydra.overrides.task = [override.input_line for override in own]
            cfg.hydra.overrides.hydra = [o.input_line for o in self.overrides if o.is_hydra_override()]
            cfg.hydra.job.override_dirname = get_overrides_dirname(own, **cfg.hydra.job.config.override_dirname)
        return cfg

    def note(self, problem: ConfigError, *lost: str) -> None:
        """Note a mistake, unless an earlier one can be its cause, and the config keys whose values it hides."""
        if not follows_from(problem, self.lost):
            self.problems.append(problem)
        self.lost += lost

    def _note_file(self, problem: ConfigError, config_path: str) -> None:
        group, _, name = config_path.rpartition("/")
        files = self.repository_used.files(config_path)
        # Use the key in the ``# @package`` line even if Hydra ignores the line.
        meant = _MEANT.search("\n".join(_lines_of(files[0]))) if files else None
        package = meant.group(1) if meant else usual_header(self.repository_used, group)
        places = [f".{name}"] if package is None else ["" if package == "_global_" else package]
        # If the user wrote ``aliv``, for example, do not report that ``alive`` is missing.
        self.note(problem, *places, group, *([f".{problem.nearest}"] if problem.nearest else []))

    def _note_missing(self, config_path: str, parent: str) -> None:
        if problem := hydra_errors.missing_option(self, config_path, parent):
            self._note_file(problem, config_path)

    def _reject(self, override: Override, problems: Iterable[ConfigError]) -> None:
        for problem in problems:
            self.note(problem)
            self.overrides = [other for other in self.overrides if other is not override]

    def _search(self, config_name: str) -> None:
        """Add the folders of ``hydra.searchpath`` to the search path."""
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", UserWarning)
                self._process_config_searchpath(config_name, self.overrides, self.repository_used)
        except HydraException as error:
            self.note(ConfigError(hydra_errors.flat(error), key=config_name))
        for source in self.repository_used.get_sources():
            if not source.available():
                message, key = f"there is no folder '{source.path}'", "hydra.searchpath"
                self.note(ConfigError(message, key=key, where=source.provider, expected="a config folder"))

    def _leave_out(self, problem: ConfigError, cause: Exception) -> None:
        """Note a mistake in the defaults lists, and remove the override or the entry that causes it."""
        problem.__cause__ = cause
        self._require_headers()
        left = [override for override in self.overrides if where_of(override) != problem.where]
        unused = isinstance(problem, NowhereMounted) and self.repository_used.leave_out(str(problem.key))
        is_last = len(left) == len(self.overrides) and not unused
        for path in self.repository_used.missing if is_last else ():
            if parent := hydra_errors.parent_of(self.repository_used, path):
                self._note_missing(path, parent)
        self.note(problem)
        if is_last:
            raise problem
        self.overrides = left

    def _require_headers(self) -> None:
        """Raise ConfigError for wrong ``# @package`` lines, which can cause any mistake that is found after merging."""
        mounts = [*hydra_errors.mounted_names(self.repository_used), *map(hydra_errors.name_of, self.overrides)]
        misplaced = missing_headers(self.repository_used, {name.split("@")[0] for name in mounts if "@" in name})
        self.problems += misplaced
        for problem in misplaced:
            raise problem

    def _parse_overrides_and_create_caching_repo(
        self, config_name: str | None, overrides: list[str]
    ) -> tuple[list[Override], CachingConfigRepository]:
        # Hydra applies only the overrides that select options; ``_apply`` applies the overrides of values.
        if config_name is None:
            parsed: tuple[list[Override], CachingConfigRepository]
            parsed = super()._parse_overrides_and_create_caching_repo(config_name, overrides)
            return parsed
        single = [override for override in self.overrides if not override.is_sweep_override()]
        return [override for override in single if self._selects(override)], self.repository_used

    def _selects(self, override: Override) -> bool:
        is_group = self.repository_used.group_exists(override.key_or_group)
        return is_group and not isinstance(override.value(), dict)

    def _compose_config_from_defaults_list(self, defaults: list[ResultDefault], repo: Repository) -> DictConfig:
        present = []
        for default in defaults:
            path, parent, package = str(default.config_path), default.parent or "", default.package or ""
            if path not in repo.missing:
                present.append(default)
            else:
                self._note_missing(path, parent)
            if path in repo.loaded and not path.startswith("hydra/"):
                self.files.append(replace(repo.loaded[path], package=package, parent=parent))
        compose = super()._compose_config_from_defaults_list
        try:
            config = self._merged(present, repo)
        except COMPOSING_ERRORS:
            try:
                config = compose(present, repo)  # Hydra's own method raises an error that names the invalid file.
            except COMPOSING_ERRORS as error:
                problem = hydra_errors.merge_problem(error, repo)
                self.note(problem)
                raise problem from error
        for file in self.files:
            self.provenance.record_file(file)
        return config

    def _merged(self, defaults: Sequence[ResultDefault], repo: Repository) -> DictConfig:
        """Merge config files as nested dicts, because OmegaConf visits the whole config tree after each merged file.

        Hydra merges its own settings, which come first. Raise ValueError if Hydra must merge all files.
        """
        tree: dict[Any, Any] = {}
        settings: list[DictConfig] = []
        for default in defaults:
            path = str(default.config_path)
            if path not in repo.loaded or path.startswith("hydra/"):
                settings.append(super()._compose_config_from_defaults_list([default], repo))
                if tree or set(settings[-1]) - {"hydra"}:  # a file that is not a local file, or has a mistake
                    raise ValueError(f"'{path}' must be merged in its place")
                continue
            content: dict[Any, Any] = dict(repo.loaded[path].content)
            for key in reversed(split_path(default.package or "")):
                content = {key: content}
            if "hydra" in content and not default.primary:
                raise ValueError(f"'{path}' changes Hydra's settings")
            _merge(tree, content)
        first, *others = settings
        with flag_override(first, "no_deepcopy_set_nodes", True):
            first.merge_with(*others, OmegaConf.create(tree))
        return first

    def _apply(self, cfg: DictConfig) -> DictConfig:
        """Apply the overrides of values one by one, and return the changed config."""
        for override in [o for o in self.overrides if not o.is_sweep_override() and not self._selects(o)]:
            text, keys, value = str(override.input_line), split_path(override.key_or_group), override.value()
            above = self.provenance.above(keys)
            in_list = above is not None and isinstance(above.value, list)
            # Even a rejected override can change the config: Hydra replaces a value above the key by an empty mapping.
            before = copy.deepcopy(cfg) if (above and not in_list) or isinstance(value, dict) else cfg
            try:
                ConfigLoaderImpl._apply_overrides_to_config([override], cfg)
            except COMPOSING_ERRORS as error:
                cfg, problem = before, hydra_errors.override_problem(error, override, before, self.groups())
                problem.__cause__ = error
                if not follows_from(problem, self.lost):
                    self._require_headers()
                self._reject(override, [problem])
                continue
            if above is not None and in_list:
                changed = OmegaConf.select(cfg, above.path)
                self.provenance.record_override(text, above.keys, OmegaConf.to_container(changed, resolve=False))
            elif override.is_delete():
                self.provenance.record_deletion(text, keys)
            else:
                self.provenance.record_override(text, keys, value)
        return cfg

    def groups(self) -> list[str]:
        """Return the names of all config groups except Hydra's own config groups; a nested group is named ``a/b``."""
        found: list[str] = []
        waiting = [""]
        while waiting:
            parent = waiting.pop(0)
            for name in self.repository.get_group_options(parent, ObjectType.GROUP):
                group = f"{parent}/{name}" if parent else name
                if group != "hydra" and not name.startswith((".", "__")):
                    found.append(group)
                    waiting.append(group)
        return sorted(found)

    def options(self, group: str) -> list[str]:
        found: list[str] = self.repository.get_group_options(group, ObjectType.CONFIG)
        return found


def _merge(tree: dict[Any, Any], content: Mapping[Any, Any]) -> None:
    """Merge nested dicts by OmegaConf's rules: a list replaces a list, and ``???`` replaces nothing."""
    for key, value in content.items():
        old = tree.get(key)
        is_reference = isinstance(old, str) and "${" in old
        is_other = isinstance(old, (dict, list)) and isinstance(value, (dict, list)) and type(old) is not type(value)
        if is_other or (is_reference and (isinstance(value, dict) or value == MISSING)):
            raise ValueError(f"'{key}' can only be merged by OmegaConf")
        if isinstance(value, dict):
            if not isinstance(old, dict):
                old = tree[key] = {}
            _merge(old, value)
        elif key not in tree or value != MISSING:
            tree[key] = value


# A file of the config group ``task`` needs the line ``# @package _global_``, even if the group has no other file.
_ALWAYS = {"task": "_global_"}


def package_header(file: Path) -> str | None:
    """Return the config key in the ``# @package`` line at the top of a file; None without this line."""
    match = _HEADER.match(next((line for line in _lines_of(file) if line.strip()), ""))
    return match.group(1) if match else None


def usual_header(repository: Repository, group: str, without: Path | None = None) -> str | None:
    """Return the config key in the ``# @package`` lines of at least half of a group's files, or None."""
    if group in _ALWAYS:
        return _ALWAYS[group]
    folders = [Path(s.path) / group for s in repository.get_sources() if s.scheme() == "file"]
    files = [file for folder in folders for file in sorted(folder.glob("*.yaml")) if file != without]
    headers = [package_header(file) for file in files]
    named = Counter(header for header in headers if header is not None).most_common(1)
    # If at least half of a config group's files have the same `# @package` line, all files of the group need this line.
    return named[0][0] if named and named[0][1] * 2 >= len(headers) else None


def missing_headers(repository: Repository, explicit: Collection[str]) -> list[ConfigError]:
    """Find config files whose ``# @package`` line is misspelled, or missing although most files of the group have one.

    A file that a defaults list selects as ``reward@env.rewards: alive`` needs no ``# @package`` line. ``explicit``
    contains config groups that are selected with a key, such as ``reward`` in ``reward@env.rewards``.
    """
    misspelled, missing = [], []
    for config_path, loaded in repository.loaded.items():
        group, header = config_path.rpartition("/")[0], package_header(loaded.file)
        if not group or group.startswith("hydra"):
            continue
        usual, where = usual_header(repository, group, loaded.file if header else None), show_file(loaded.file, 1)
        line = f"# @package {usual}"
        if usual and header and header != usual and nearest_name(header, [usual]):
            message = f"this file's package line names '{header}', but nothing reads that key"
            misspelled.append(ConfigError(message, key=config_path, where=where, expected=f"'{line}'", nearest=line))
        elif usual is not None and not header and group not in explicit:
            message = "this file has no package line, so its keys would be put below its group's name"
            expected = f"'{line}' as the first line of the file"
            missing.append(ConfigError(message, key=config_path, where=where, expected=expected))
    return misspelled + missing
