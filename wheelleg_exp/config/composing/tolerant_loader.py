"""A loader that goes on past what is wrong, so that the mistakes behind a broken file are found as well."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from hydra._internal.config_repository import CachingConfigRepository
from hydra.core.default_element import GroupDefault, InputDefault
from hydra.core.override_parser.types import Override
from hydra.plugins.config_source import ConfigResult
from omegaconf import OmegaConf

from wheelleg_exp.config.composing.headers import package_header
from wheelleg_exp.config.composing.loader import Loader, Repository
from wheelleg_exp.errors import ConfigError


@dataclass
class Leniency:
    """What is passed over.

    Attributes:
        empty: config paths that count as empty files.
        unused: ``group@package`` of the overrides in defaults lists that are left out.
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
        """Load a config as Hydra asks for it; one that is broken counts as empty."""
        if config_path in self._leniency.empty:
            header = {"package": self._package(config_path)}
            return ConfigResult("wheelleg", config_path, OmegaConf.create({}), header, [])
        try:
            result = super().load_config(config_path)
        except ConfigError:
            self._leniency.failed = config_path
            raise
        if result is not None and result.defaults_list:
            parent = config_path.rpartition("/")[0]  # what a name without a slash stands below
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
    """Loads like ``Loader``, but for what its leniency passes over."""

    def __init__(self, config_dirs: Sequence[Path], leniency: Leniency) -> None:
        super().__init__(config_dirs)
        self._leniency = leniency

    def _parse_overrides_and_create_caching_repo(
        self, config_name: str | None, overrides: list[str]
    ) -> tuple[list[Override], CachingConfigRepository]:
        parsed, _ = super()._parse_overrides_and_create_caching_repo(config_name, overrides)
        # The repository behind knows the search path by now.
        self.repository_used = _TolerantRepository(self.repository_used.delegate, self._leniency)
        return parsed, self.repository_used
