"""Hydra's config loader, kept to itself: it touches no global Hydra state, and remembers what it read."""

from __future__ import annotations

import functools
import re
import warnings
from collections.abc import Callable, Iterator, Sequence
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

from wheelleg_exp.config.composing.replacing import chosen_file
from wheelleg_exp.config.tree import show_file
from wheelleg_exp.errors import ConfigError
from wheelleg_exp.packages import config_folder, join_folder
from wheelleg_exp.paths import configs_dir
from wheelleg_exp.reading import Unreadable, yaml_tree

VERSION_BASE = "1.3"
# What composing a wrong config raises: beside their own errors, those that values which do not merge lead to.
COMPOSING_ERRORS = (HydraException, OmegaConfBaseException, ValueError, RecursionError, AssertionError)
_HEADER = re.compile(r"^\s*#+\s*@package +\S+\s*$")
_PACKAGE_LINE = re.compile(r"^\s*#+\s*@\s*package\b", re.IGNORECASE)


@contextmanager
def hydra_globals() -> Iterator[None]:
    """Set what Hydra keeps in globals (version base, job name) and put the old values back afterwards."""
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
    """One config file: where it is, and its content without the defaults list."""

    file: Path
    content: dict[Any, Any]


class Repository(CachingConfigRepository):
    """A caching repository that keeps the plain content of each file and refuses what Hydra passes over."""

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
        """Return the files of this name along the search path, the one that Hydra takes first."""
        name = ConfigSource._normalize_file_name(config_path)
        folders = [Path(s.path) for s in self.get_sources() if s.scheme() == "file"]
        return [folder / name for folder in folders if (folder / name).is_file()]

    def _is_file(self, config_path: str) -> bool:
        source = next((s for s in self.get_sources() if s.is_config(config_path)), None)
        if source is None or source.scheme() != "file":
            return False
        if not self.files(config_path):
            raise ConfigError("is no ordinary file", key=config_path, where=source.path)
        return True

    def _read(self, config_path: str, file: Path) -> ConfigResult:
        """Read a file as Hydra's own source of files does, by libyaml."""
        text = file.read_text(encoding="utf-8")
        yaml_tree(text)
        content = yaml.load(text, Loader=_yaml_loader())
        if content is not None and not isinstance(content, (dict, str)):
            where, expected = show_file(file, 1), "'key: value' lines"
            raise ConfigError("the file holds no mapping", key=config_path, where=where, expected=expected)
        name = ConfigSource._normalize_file_name(config_path)
        source = next(s for s in self.get_sources() if s.scheme() == "file" and Path(s.path) / name == file)
        config, header = OmegaConf.create(content or {}), ConfigSource._get_header_dict(text[:512])
        result = ConfigResult(source.provider, f"file://{source.path}", config, header)
        listed = self.delegate._extract_defaults_list(config_path, config)
        result.defaults_list = self.delegate._create_defaults_list(config_path, listed)
        return result


@functools.cache
def _yaml_loader() -> Any:
    """Return OmegaConf's loader of YAML over libyaml's parser, where that is there: it is many times as fast."""
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
    except Exception as error:  # a value that is not what its tag says fails in any way
        line = _line_of_message(file, str(error))
        raise ConfigError(
            f"the file cannot be read: {_flat(str(error))}", key=config_path, where=show_file(file, line)
        ) from error


def _flat(text: str) -> str:
    return " ".join(text.split())


def _line_of_message(file: Path, message: str) -> int | None:
    """Return the line that holds the text which a message quotes, when there is just one."""
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
    """Refuse a ``# @package`` line that Hydra would take for an ordinary comment."""
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
    """Hydra's loader over the stock configs and the user's config folders.

    Attributes:
        repository_used: what the last ``load`` read its files from.
        merged: the files that it merged, in that order.
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
        """Compose like Hydra's compose API; the result holds the ``hydra`` node as well."""
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

    The packages that a folder's project declares join the ones that configs may call.
    """
    path = create_config_search_path(str(configs_dir()))
    schema = path.get_path().pop()
    for folder in map(require_folder, config_dirs):
        join_folder(folder)
        path.append("config-dir", f"file://{folder}")
    path.append(schema.provider, schema.path)
    return path


def require_folder(folder: Path) -> Path:
    """Return the absolute path of a config folder; raises ConfigError when there is none."""
    return config_folder(folder)
