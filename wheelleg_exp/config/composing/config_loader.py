"""Load config files with Hydra's loader, without global Hydra state, and record every file that was read.

If config files in two folders have the same name, one file needs a ``# @replaces`` line to replace the other file. If
most files of a config group have a ``# @package`` line, every file of the group must have one.
"""

from __future__ import annotations

import functools
import re
import warnings
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml
from hydra import version
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra._internal.config_repository import CachingConfigRepository, IConfigRepository
from hydra._internal.defaults_list import DefaultsList, create_defaults_list
from hydra._internal.utils import create_config_search_path
from hydra.core.default_element import ResultDefault
from hydra.core.object_type import ObjectType
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.core.singleton import Singleton
from hydra.core.utils import JobRuntime, setup_globals
from hydra.errors import HydraException
from hydra.plugins.config_source import ConfigResult, ConfigSource
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf, flag_override
from omegaconf._utils import get_yaml_loader
from omegaconf.errors import OmegaConfBaseException

from wheelleg_exp.config.tree_lookup import file_text
from wheelleg_exp.errors import ConfigError, nearest_name
from wheelleg_exp.packages import config_folder, join_folder
from wheelleg_exp.paths import configs_dir, show_file
from wheelleg_exp.plain_data import Unreadable, yaml_tree

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
# Hydra and OmegaConf raise `COMPOSING_ERRORS` for invalid configs, such as RecursionError for cyclic defaults lists.
COMPOSING_ERRORS = (HydraException, OmegaConfBaseException, ValueError, RecursionError, AssertionError)
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


@dataclass(frozen=True)
class LoadedFile:
    """One config file: its path, and its content without the defaults list."""

    file: Path
    content: dict[Any, Any]


class Repository(CachingConfigRepository):
    """A Hydra config repository that keeps each file's content, and raises errors for mistakes that Hydra ignores."""

    def __init__(self, delegate: IConfigRepository) -> None:
        super().__init__(delegate)
        self.loaded: dict[str, LoadedFile] = {}
        self._seen: set[str] = set()

    def load_config(self, config_path: str) -> ConfigResult | None:
        """Load one config. For an invalid config file, the loader raises a ConfigError with the file and line."""
        if config_path not in self._seen:
            self._seen.add(config_path)
            if self._is_file(config_path):
                file = chosen_file(config_path, self.files(config_path))
                result = _load(self._read, config_path, file)
                lines = file.read_text(encoding="utf-8").splitlines()
                marked = [number for number, line in enumerate(lines, 1) if _PACKAGE_LINE.match(line)]
                first = next((number for number, line in enumerate(lines, 1) if line.strip()), 0)
                wrong = [number for number in marked if number != first or not _HEADER.match(lines[number - 1])]
                if wrong:
                    key, where = lines[wrong[0] - 1].strip(), show_file(file, wrong[0])
                    expected = "one '# @package some.path' as the first line of the file"
                    message = "the file's '# @package' line has no effect"
                    raise ConfigError(message, key=key, where=where, expected=expected)
                content = OmegaConf.to_container(result.config, resolve=False)
                # Copy each file's content, because Hydra changes the config objects while it composes the config.
                self.loaded[config_path] = LoadedFile(file, dict(content) if isinstance(content, dict) else {})
                self.cache[f"config_path={config_path}"] = result
        return super().load_config(config_path)

    def files(self, config_path: str) -> list[Path]:
        """Return the files of one name, such as ``reward/alive.yaml``, in all config folders; Hydra reads the first."""
        name = ConfigSource._normalize_file_name(config_path)
        folders = [Path(s.path) for s in self.get_sources() if s.scheme() == "file"]
        return [folder / name for folder in folders if (folder / name).is_file()]

    def _is_file(self, config_path: str) -> bool:
        source = next((s for s in self.get_sources() if s.is_config(config_path)), None)
        if source is None or source.scheme() != "file":
            return False
        if not self.files(config_path):
            raise ConfigError("the config path is not a regular file", key=config_path, where=source.path)
        return True

    def _read(self, config_path: str, file: Path) -> ConfigResult:
        """Read a config file like Hydra, but with the faster parser libyaml."""
        text = file.read_text(encoding="utf-8")
        yaml_tree(text)
        content = yaml.load(text, Loader=_yaml_loader())
        if content is not None and not isinstance(content, (dict, str)):
            where, expected = show_file(file, 1), "'key: value' lines"
            message = "the config file does not contain a mapping"
            raise ConfigError(message, key=config_path, where=where, expected=expected)
        name = ConfigSource._normalize_file_name(config_path)
        source = next(s for s in self.get_sources() if s.scheme() == "file" and Path(s.path) / name == file)
        config, header = OmegaConf.create(content or {}), ConfigSource._get_header_dict(text[:512])
        result = ConfigResult(source.provider, f"file://{source.path}", config, header)
        listed = self.delegate._extract_defaults_list(config_path, config)
        result.defaults_list = self.delegate._create_defaults_list(config_path, listed)
        return result


@functools.cache
def _yaml_loader() -> Any:
    """Return OmegaConf's YAML loader with libyaml's parser, if libyaml is installed, because libyaml is much faster."""
    loader = get_yaml_loader()
    fast = getattr(yaml, "CSafeLoader", None)
    return loader if fast is None else type("Loader", (fast, loader), {})


def _load(load: Callable[[str, Path], ConfigResult], config_path: str, file: Path) -> ConfigResult:
    try:
        return load(config_path, file)
    except Unreadable as error:
        cause: Exception = error
        line, problem = error.line, f"the file is not valid YAML: {error.problem}"
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        line = mark.line + 1 if mark is not None else None
        cause, problem = error, f"the file is not valid YAML: {error.problem or error.context}"
    except ConfigError:
        raise
    except Exception as error:  # A YAML value that contradicts its tag, such as `!!int text`, can raise any exception.
        line = _line_of_message(file, str(error))
        cause, problem = error, "the file cannot be read: " + " ".join(str(error).split())
    raise ConfigError(problem, key=config_path, where=show_file(file, line)) from cause


def _line_of_message(file: Path, message: str) -> int | None:
    """Return the number of the only line that contains a text quoted in an error message, or None."""
    lines = _lines_of(file)
    for pair in re.findall(r"'([^']+)'|\"([^\"]+)\"", message):
        hits = [number for number, line in enumerate(lines, 1) if (pair[0] or pair[1]) in line]
        if len(hits) == 1:
            return hits[0]
    return None


class Loader(ConfigLoaderImpl):
    """A Hydra config loader that keeps the defaults list of the last composed config in ``merged``."""

    repository_used: Repository
    merged: Sequence[ResultDefault]

    def __init__(self, config_dirs: Sequence[Path] = ()) -> None:
        path = create_config_search_path(str(configs_dir()))
        schema = path.get_path().pop()
        for folder in map(config_folder, config_dirs):
            join_folder(folder)  # Configs can use Python code of the user project that contains the config folder.
            path.append("config-dir", f"file://{folder}")
        path.append(schema.provider, schema.path)
        super().__init__(path)

    def _parse_overrides_and_create_caching_repo(
        self, config_name: str | None, overrides: list[str]
    ) -> tuple[list[Override], CachingConfigRepository]:
        parsed = OverridesParser.create().parse_overrides(overrides=overrides)
        self.repository_used = Repository(self.repository)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)
            self._process_config_searchpath(config_name, parsed, self.repository_used)
        for source in self.repository_used.get_sources():
            if not source.available():
                message, key = f"there is no folder '{source.path}'", "hydra.searchpath"
                raise ConfigError(message, key=key, where=source.provider, expected="a config folder")
        return parsed, self.repository_used

    def _compose_config_from_defaults_list(self, defaults: list[ResultDefault], repo: IConfigRepository) -> DictConfig:
        self.merged = defaults
        compose = super()._compose_config_from_defaults_list
        first, *others = [compose([default], repo) for default in defaults]
        try:
            # Merge all files at once, because OmegaConf visits the whole config tree after each merge.
            with flag_override(first, "no_deepcopy_set_nodes", True):
                first.merge_with(*others)
        except OmegaConfBaseException:
            return compose(defaults, repo)  # Hydra's own method raises an error that names the invalid file.
        return first

    def load(self, primary: str, overrides: Sequence[str]) -> DictConfig:
        """Compose the primary config with overrides; the result has a node ``hydra`` with Hydra's own settings."""
        return self.load_configuration(primary, list(overrides), RunMode.RUN, from_shell=False)

    def defaults(self, primary: str, parsed: Sequence[Override]) -> DefaultsList:
        """Return the defaults list that Hydra computes from a primary config and overrides, with all selected files."""
        return create_defaults_list(self.repository_used, primary, list(parsed), prepend_hydra=True, skip_missing=False)

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
        """Return the names of the options of a config group."""
        return self.repository.get_group_options(group, ObjectType.CONFIG)


# A file of the config group ``task`` needs the line ``# @package _global_``, even if the group has no other file.
_ALWAYS = {"task": "_global_"}


def package_header(file: Path) -> str | None:
    """Return the config key in the ``# @package`` line at the top of a file; None without this line."""
    match = _HEADER.match(next((line for line in _lines_of(file) if line.strip()), ""))
    return match.group(1) if match else None


def package_meant(file: Path) -> str | None:
    """Return the config key in a file's ``# @package`` line, even if Hydra ignores the line; else None."""
    match = _MEANT.search("\n".join(_lines_of(file)))
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
