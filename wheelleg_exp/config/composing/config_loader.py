"""Load config files with Hydra's loader, without global Hydra state, and record every file that was read.

Several config folders can have a file of the same name: the user's file replaces the stock file only if it says so.
A file whose siblings have a ``# @package`` line must have one, too.
"""

from __future__ import annotations

import functools
import re
import warnings
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
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
from hydra.core.config_search_path import ConfigSearchPath
from hydra.core.default_element import ResultDefault
from hydra.core.object_type import ObjectType
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.core.singleton import Singleton
from hydra.core.utils import JobRuntime, setup_globals
from hydra.errors import HydraException
from hydra.plugins.config_source import ConfigResult, ConfigSource
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf._utils import get_yaml_loader
from omegaconf.errors import OmegaConfBaseException

from wheelleg_exp.config.config_tree import file_text
from wheelleg_exp.errors import ConfigError, nearest_name
from wheelleg_exp.packages import config_folder, join_folder
from wheelleg_exp.paths import configs_dir, show_file
from wheelleg_exp.plain_data import Unreadable, yaml_tree

_MARK = re.compile(r"^\s*#\s*@\s*replaces\b[ :]*(.*?)\s*$", re.IGNORECASE)


def replaced_by(file: Path) -> tuple[str, int] | None:
    """Return the config in a file's ``# @replaces`` line, and the line's number; None without such a line."""
    try:
        lines = file_text(file).splitlines()
    except (OSError, UnicodeDecodeError):
        return None
    for number, line in enumerate(lines, 1):
        if line.strip() and not line.lstrip().startswith("#"):
            return None
        match = _MARK.match(line)
        if match is not None:
            return match.group(1), number
    return None


def chosen_file(config_path: str, files: Sequence[Path]) -> Path:
    """Return the file that is read for a config: the file with a ``# @replaces`` line, or the only file.

    Args:
        config_path: the config, such as ``reward/alive``.
        files: the files of that name along the search path, at least one.

    Raises:
        ConfigError: a file would never be read, several files replace one, or a file replaces nothing.
    """
    different = list({file.resolve(): file for file in reversed(files)}.values())[::-1]
    marks = {file: replaced_by(file) for file in different}
    for file, mark in marks.items():
        if mark is not None and mark[0] != config_path:
            raise _wrong_mark(config_path, file, mark)
    plain = [file for file in different if marks[file] is None]
    replacing = [file for file in different if marks[file] is not None]
    if len(plain) > 1:
        raise _hidden(config_path, plain)
    if len(replacing) > 1:
        raise _contested(config_path, replacing, marks)
    if not plain:
        raise _replaces_nothing(config_path, replacing[0], marks)
    return replacing[0] if replacing else files[0]


def _hidden(config_path: str, plain: Sequence[Path]) -> ConfigError:
    return ConfigError(
        f"this file is never read, because {show_file(plain[0])} has the same name",
        key=config_path,
        where=show_file(plain[1]),
        expected="a name that no stock config and no other config folder has, "
        f"or the line '# @replaces {config_path}' at its top, to replace the other file on purpose",
    )


def _contested(config_path: str, replacing: Sequence[Path], marks: dict[Path, tuple[str, int] | None]) -> ConfigError:
    return ConfigError(
        f"this file and {show_file(replacing[0])} both replace '{config_path}'",
        key=config_path,
        where=_place(replacing[1], marks[replacing[1]]),
        expected=f"one file that replaces '{config_path}'",
    )


def _replaces_nothing(config_path: str, file: Path, marks: dict[Path, tuple[str, int] | None]) -> ConfigError:
    return ConfigError(
        f"there is no other '{config_path}' that this file can replace",
        key=config_path,
        where=_place(file, marks[file]),
        expected="a file without that line, or with the name of the file that it replaces",
    )


def _wrong_mark(config_path: str, file: Path, mark: tuple[str, int]) -> ConfigError:
    return ConfigError(
        f"this file says that it replaces '{mark[0]}', but a file can only replace a file of its own name",
        key=config_path,
        where=_place(file, mark),
        expected=f"'# @replaces {config_path}'",
    )


def _place(file: Path, mark: tuple[str, int] | None) -> str:
    return show_file(file, mark[1] if mark is not None else None)


VERSION_BASE = "1.3"
# The exceptions that Hydra and OmegaConf raise for a wrong config. Values that do not merge raise the last three.
COMPOSING_ERRORS = (HydraException, OmegaConfBaseException, ValueError, RecursionError, AssertionError)
_HEADER = re.compile(r"^\s*#+\s*@package +\S+\s*$")
_PACKAGE_LINE = re.compile(r"^\s*#+\s*@\s*package\b", re.IGNORECASE)


@contextmanager
def hydra_globals() -> Iterator[None]:
    """Set Hydra's global state (version base, job name) inside the block, and restore the previous state after it."""
    kinds = (version.VersionBase, JobRuntime)
    before = {kind: Singleton._instances.pop(kind, None) for kind in kinds}
    try:
        version.setbase(VERSION_BASE)
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
    """A caching repository that stores the plain content of each file, and rejects mistakes that Hydra ignores."""

    def __init__(self, delegate: IConfigRepository) -> None:
        super().__init__(delegate)
        self.loaded: dict[str, LoadedFile] = {}
        self._seen: set[str] = set()

    def load_config(self, config_path: str) -> ConfigResult | None:
        """Load one config; a broken file raises ConfigError with its place."""
        if config_path not in self._seen:
            self._seen.add(config_path)
            if self._is_file(config_path):
                file = chosen_file(config_path, self.files(config_path))
                result = _load(self._read, config_path, file)
                _require_package_header(file)
                content = OmegaConf.to_container(result.config, resolve=False)
                # Hydra edits the config objects while it composes, so the content is copied now.
                self.loaded[config_path] = LoadedFile(file, dict(content) if isinstance(content, dict) else {})
                self.cache[f"config_path={config_path}"] = result
        return super().load_config(config_path)

    def files(self, config_path: str) -> list[Path]:
        """Return the files of this name along the search path. Hydra reads the first one."""
        name = ConfigSource._normalize_file_name(config_path)
        folders = [Path(s.path) for s in self.get_sources() if s.scheme() == "file"]
        return [folder / name for folder in folders if (folder / name).is_file()]

    def _is_file(self, config_path: str) -> bool:
        source = next((s for s in self.get_sources() if s.is_config(config_path)), None)
        if source is None or source.scheme() != "file":
            return False
        if not self.files(config_path):
            raise ConfigError("is not a regular file", key=config_path, where=source.path)
        return True

    def _read(self, config_path: str, file: Path) -> ConfigResult:
        """Read a file like Hydra's own source of files, but with libyaml."""
        text = file.read_text(encoding="utf-8")
        yaml_tree(text)
        content = yaml.load(text, Loader=_yaml_loader())
        if content is not None and not isinstance(content, (dict, str)):
            where, expected = show_file(file, 1), "'key: value' lines"
            raise ConfigError("the file does not contain a mapping", key=config_path, where=where, expected=expected)
        name = ConfigSource._normalize_file_name(config_path)
        source = next(s for s in self.get_sources() if s.scheme() == "file" and Path(s.path) / name == file)
        config, header = OmegaConf.create(content or {}), ConfigSource._get_header_dict(text[:512])
        result = ConfigResult(source.provider, f"file://{source.path}", config, header)
        listed = self.delegate._extract_defaults_list(config_path, config)
        result.defaults_list = self.delegate._create_defaults_list(config_path, listed)
        return result


@functools.cache
def _yaml_loader() -> Any:
    """Return OmegaConf's YAML loader, with libyaml's parser if it is installed: that is many times as fast."""
    loader = get_yaml_loader()
    fast = getattr(yaml, "CSafeLoader", None)
    return loader if fast is None else type("Loader", (fast, loader), {})


def _load(load: Callable[[str, Path], ConfigResult], config_path: str, file: Path) -> ConfigResult:
    try:
        return load(config_path, file)
    except Unreadable as error:
        raise ConfigError(
            f"the file is not valid YAML: {error.problem}", key=config_path, where=show_file(file, error.line)
        ) from error
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        line = mark.line + 1 if mark is not None else None
        raise ConfigError(
            f"the file is not valid YAML: {error.problem or error.context}",
            key=config_path,
            where=show_file(file, line),
        ) from error
    except ConfigError:
        raise
    except Exception as error:  # a value that contradicts its YAML tag can raise anything
        line = _line_of_message(file, str(error))
        raise ConfigError(
            f"the file cannot be read: {_one_line(str(error))}", key=config_path, where=show_file(file, line)
        ) from error


def _one_line(text: str) -> str:
    return " ".join(text.split())


def _line_of_message(file: Path, message: str) -> int | None:
    """Return the line that contains a text quoted in the message; None if no line or several lines contain it."""
    quoted = re.findall(r"'([^']+)'|\"([^\"]+)\"", message)
    try:
        lines = file.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError):
        return None
    for pair in quoted:
        text = pair[0] or pair[1]
        hits = [i for i, line in enumerate(lines, 1) if text in line]
        if len(hits) == 1:
            return hits[0]
    return None


def _require_package_header(file: Path) -> None:
    """Reject a ``# @package`` line that Hydra would treat as an ordinary comment."""
    lines = file.read_text(encoding="utf-8").splitlines()
    marked = [number for number, line in enumerate(lines, 1) if _PACKAGE_LINE.match(line)]
    wrong = [number for number in marked if number != _header_line(lines)]
    if wrong:
        raise ConfigError(
            "this package line has no effect",
            key=lines[wrong[0] - 1].strip(),
            where=show_file(file, wrong[0]),
            expected="one '# @package some.path' as the first line of the file",
        )


def _header_line(lines: Sequence[str]) -> int | None:
    """Return the number of the line that Hydra reads as the package header."""
    for number, line in enumerate(lines, 1):
        if _HEADER.match(line):
            return number
        if line.strip():
            return None
    return None


def _require_available(repository: Repository) -> None:
    for source in repository.get_sources():
        if not source.available():
            raise ConfigError(
                f"there is no '{source.path}'",
                key="hydra.searchpath",
                where=source.provider,
                expected="a config folder",
            )


class Loader(ConfigLoaderImpl):
    """Hydra's loader for the stock configs and the user's config folders.

    Attributes:
        repository_used: the repository of the last ``load``.
        merged: the files that the last ``load`` merged, in that order.
    """

    repository_used: Repository
    merged: Sequence[ResultDefault]

    def __init__(self, config_dirs: Sequence[Path] = ()) -> None:
        super().__init__(search_path(config_dirs))

    def _parse_overrides_and_create_caching_repo(
        self, config_name: str | None, overrides: list[str]
    ) -> tuple[list[Override], CachingConfigRepository]:
        parsed = OverridesParser.create().parse_overrides(overrides=overrides)
        self.repository_used = Repository(self.repository)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)
            self._process_config_searchpath(config_name, parsed, self.repository_used)
        _require_available(self.repository_used)
        return parsed, self.repository_used

    def _compose_config_from_defaults_list(self, defaults: list[ResultDefault], repo: IConfigRepository) -> DictConfig:
        self.merged = defaults
        return super()._compose_config_from_defaults_list(defaults, repo)

    def load(self, primary: str, overrides: Sequence[str]) -> DictConfig:
        """Compose like Hydra's compose API. The result also contains the ``hydra`` node."""
        return self.load_configuration(primary, list(overrides), RunMode.RUN, from_shell=False)

    def defaults(self, primary: str, parsed: Sequence[Override]) -> DefaultsList:
        """Return the defaults list, from the files that the last ``load`` read."""
        return create_defaults_list(
            repo=self.repository_used,
            config_name=primary,
            overrides_list=list(parsed),
            prepend_hydra=True,
            skip_missing=False,
        )

    def groups(self) -> list[str]:
        """Return every config group of the search path, nested ones as ``a/b``, without Hydra's own."""
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
        """Return the options of a group."""
        return self.repository.get_group_options(group, ObjectType.CONFIG)


def search_path(config_dirs: Sequence[Path]) -> ConfigSearchPath:
    """Return Hydra's search path: the stock configs, then each of the user's folders.

    The packages that a folder's project declares become allowed packages for targets.
    """
    path = create_config_search_path(str(configs_dir()))
    schema = path.get_path().pop()
    for folder in map(require_folder, config_dirs):
        join_folder(folder)
        path.append("config-dir", f"file://{folder}")
    path.append(schema.provider, schema.path)
    return path


def require_folder(folder: Path) -> Path:
    """Return the absolute path of a config folder; raise ConfigError if it does not exist."""
    return config_folder(folder)


_PACKAGE_HEADER = re.compile(r"^\s*#+\s*@package +(\S+)\s*$")
_MEANT = re.compile(r"^\s*#+\s*@\s*package[ :]+(\S+)\s*$", re.MULTILINE | re.IGNORECASE)
# The only package that a task can have, even when there is no other task.
_ALWAYS = {"task": "_global_"}


def package_header(file: Path) -> str | None:
    """Return the package in a file's first line; None without a package line."""
    try:
        lines = file_text(file).splitlines()
    except (OSError, UnicodeDecodeError):
        return None
    first = next((line for line in lines if line.strip()), "")
    match = _PACKAGE_HEADER.match(first)
    return match.group(1) if match else None


def package_meant(file: Path) -> str | None:
    """Return the package in any package line of a file, even where Hydra ignores the line; None without one."""
    try:
        match = _MEANT.search(file_text(file))
    except (OSError, UnicodeDecodeError):
        return None
    return match.group(1) if match else None


def usual_header(repository: Repository, group: str, without: Path | None = None) -> str | None:
    """Return the package in the package lines of at least half of a group's files; None without such a package."""
    if group in _ALWAYS:
        return _ALWAYS[group]
    folders = [Path(s.path) / group for s in repository.get_sources() if s.scheme() == "file"]
    files = [file for folder in folders for file in sorted(folder.glob("*.yaml")) if file != without]
    headers = [package_header(file) for file in files]
    named = Counter(header for header in headers if header is not None).most_common(1)
    # The file that lacks its package line is one of these files, so not all of them have to agree.
    return named[0][0] if named and named[0][1] * 2 >= len(headers) else None


def _misspelled_headers(repository: Repository) -> list[ConfigError]:
    """Find package lines that are nearly equal to the usual line of their group."""
    problems = []
    for config_path, loaded in repository.loaded.items():
        group, header = config_path.rpartition("/")[0], package_header(loaded.file)
        if not group or not header or group.startswith("hydra"):
            continue
        usual = usual_header(repository, group, loaded.file)
        if usual and header != usual and nearest_name(header, [usual]):
            line = f"# @package {usual}"
            message = f"this file's package line names '{header}', but nothing reads that key"
            where = show_file(loaded.file, 1)
            problems.append(ConfigError(message, key=config_path, where=where, expected=f"'{line}'", nearest=line))
    return problems


def missing_headers(repository: Repository, mounted: Iterable[str]) -> list[ConfigError]:
    """Find files that lack the usual package line of their group, or whose line is nearly equal to it.

    Args:
        repository: the repository that has loaded the files.
        mounted: groups that a defaults list or an override mounts at an explicit package. Their files need no line.
    """
    explicit = set(mounted)
    problems = _misspelled_headers(repository)
    for config_path, loaded in repository.loaded.items():
        group = config_path.rpartition("/")[0]
        if not group or group in explicit or group.startswith("hydra") or package_header(loaded.file):
            continue
        usual = usual_header(repository, group)
        if usual is not None:
            problems.append(
                ConfigError(
                    "this file has no package line, so its keys would be put below its group's name",
                    key=config_path,
                    where=show_file(loaded.file, 1),
                    expected=f"'# @package {usual}' as the first line of the file",
                )
            )
    return problems
