"""Composing a config: files and overrides in, one plain tree out, with the place of every leaf."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from wheelleg_exp.config.checking.diagnose import explain, nearest_path
from wheelleg_exp.config.composing.hydra_keys import unread_overrides
from wheelleg_exp.config.composing.loader import COMPOSING_ERRORS, Loader, hydra_globals, require_folder
from wheelleg_exp.config.composing.mounts import Mount, find_mounts
from wheelleg_exp.config.composing.provenance import MISSING, Provenance, trace
from wheelleg_exp.config.problems import Mistakes, UnknownName, join, raise_all
from wheelleg_exp.config.tree import dotted, leaves, node_paths
from wheelleg_exp.errors import ConfigError, MissingValue, WheellegError
from wheelleg_exp.terms.binding import drop_removed


@dataclass(frozen=True)
class Composed:
    """A composed config.

    Attributes:
        config: the resolved tree as plain mappings. Removed (null) terms are gone from the term sections, and
            every term section is there, if only empty.
        raw: the same as OmegaConf has it, ``${...}`` unresolved and null terms kept; read-only.
        overrides: the overrides as typed.
        primary: name of the primary config.
        config_dirs: the user's config folders, absolute.
        removed_terms: paths of the terms that were set to null.
        hydra: Hydra's own node.
        loader: the loader that has composed it.
        parsed: the overrides, parsed.
    """

    config: dict[str, Any]
    raw: DictConfig
    overrides: list[str]
    primary: str
    config_dirs: tuple[Path, ...]
    removed_terms: tuple[str, ...]
    hydra: DictConfig = field(repr=False)
    loader: Loader = field(repr=False)
    parsed: list[Override] = field(repr=False)

    @cached_property
    def provenance(self) -> Provenance:
        """Where each leaf comes from, worked out when it is first asked for."""
        return trace(self.loader, self.primary, self.parsed)

    @cached_property
    def mounts(self) -> list[Mount]:
        """The groups that the composition mounts, without Hydra's own, found when they are first asked for."""
        return find_mounts(self.loader, self.parsed)

    @cached_property
    def raw_tree(self) -> dict[str, Any]:
        """The raw tree as plain mappings, for reading."""
        tree = OmegaConf.to_container(self.raw, resolve=False)
        return {str(key): node for key, node in tree.items()} if isinstance(tree, dict) else {}

    @contextmanager
    def placing(self) -> Iterator[None]:
        """Give errors that leave the body, each of several, the place in the config that their key comes from."""
        try:
            yield
        except Mistakes as error:
            for part in error.errors:
                self._place(part)
            raise join(error.errors) from error
        except WheellegError as error:
            self._place(error)
            raise

    def _place(self, error: WheellegError) -> None:
        is_section = isinstance(self.config.get(error.key or ""), Mapping)  # a whole section comes from many places
        if error.where is None and error.key is not None and not is_section:
            error.where = self.provenance.where(error.key)

    @property
    def files(self) -> list[Path]:
        """The files that were read, stock and the user's, in order of reading."""
        return [loaded.file for loaded in self.loader.repository_used.loaded.values()]

    @property
    def asset_roots(self) -> tuple[Path, ...]:
        """The folders in which a user's own assets are looked up, for ``paths.find_asset``."""
        return tuple(root for d in self.config_dirs for root in (d.parent / "assets", d.parent))

    def hydra_files(self) -> dict[str, str]:
        """Return the texts of Hydra's three files, by name: config.yaml, hydra.yaml and overrides.yaml."""
        return {
            "config.yaml": OmegaConf.to_yaml(self.raw),
            "hydra.yaml": OmegaConf.to_yaml(OmegaConf.create({"hydra": self.hydra})),
            "overrides.yaml": OmegaConf.to_yaml(OmegaConf.create(self.overrides)),
        }


def compose(
    overrides: Sequence[str] = (),
    *,
    primary: str = "train",
    config_dirs: Sequence[Path] = (),
    loader: Callable[[Sequence[Path]], Loader] = Loader,
    launching: bool = False,
) -> Composed:
    """Compose the primary config with overrides, as Hydra does.

    Args:
        overrides: Hydra overrides, such as ``task=walk`` or ``env.rewards.alive.weight=2``.
        primary: name of the primary config.
        config_dirs: the user's config folders, searched after the stock configs.
        loader: makes the loader from the folders.
        launching: whether the overrides may be those of a sweep's launcher.

    Raises:
        ConfigError: anything that is wrong with the files, the overrides or the interpolations.
    """
    texts = override_texts(overrides)
    unread = [] if launching else unread_overrides(texts)
    if unread:
        raise_all(unread)
    folders = tuple(require_folder(folder) for folder in config_dirs)
    with hydra_globals():
        used = loader(folders)
        try:
            raw = used.load(primary, texts)
        except ConfigError:
            raise
        except COMPOSING_ERRORS as error:
            raise explain(error, used, primary, texts) from error
        parsed = OverridesParser.create().parse_overrides(texts)
    OmegaConf.set_struct(raw, False)
    hydra = raw.pop("hydra")
    OmegaConf.set_readonly(raw, True)
    config = _resolve(raw, lambda: trace(used, primary, parsed))
    removed = drop_removed(config)
    return Composed(config, raw, texts, primary, folders, removed, hydra, used, parsed)


def override_texts(overrides: Sequence[str]) -> list[str]:
    """Return overrides as a list; a single text is one override, not a sequence of letters."""
    return [overrides] if isinstance(overrides, str) else [str(text) for text in overrides]


def _resolve(raw: DictConfig, provenance: Any) -> dict[str, Any]:
    """Return the resolved plain tree; one ConfigError tells all missing values and bad interpolations."""
    try:
        resolved = OmegaConf.to_container(raw, resolve=True, throw_on_missing=True)
    except OmegaConfBaseException as error:
        places = provenance()
        raise_all(_unresolved(raw, places) or [ConfigError(_flat(error), key=_full_key(error))], error)
    return {str(key): value for key, value in resolved.items()} if isinstance(resolved, dict) else {}


def _unresolved(raw: DictConfig, places: Provenance) -> list[ConfigError]:
    errors: list[ConfigError] = []
    for keys, value in leaves(OmegaConf.to_container(raw, resolve=False)):
        path = dotted(keys)
        if value == MISSING or (isinstance(value, list) and MISSING in value):
            errors.append(MissingValue(key=path, where=places.where(path), expected=f"{path}=<value>"))
        elif "${" in str(value):
            message = _interpolation_message(raw, path)
            if message is not None:
                errors.append(_dangling(raw, message, path, places.where(path)))
    return errors


def _interpolation_message(raw: DictConfig, path: str) -> str | None:
    try:
        value = OmegaConf.select(raw, path, throw_on_missing=True)
        if OmegaConf.is_config(value):
            OmegaConf.to_container(value, resolve=True, throw_on_missing=True)
    except OmegaConfBaseException as error:
        return _flat(error)
    return None


def _dangling(raw: DictConfig, message: str, path: str, where: str | None) -> ConfigError:
    """Return the error of an interpolation; of one to a key that is not there with the key that may be meant."""
    missing = re.match(r"Interpolation key '([^']+)' not found", message)
    if missing is None:
        return ConfigError(message, key=path, where=where)
    paths = [dotted(keys) for keys in node_paths(OmegaConf.to_container(raw, resolve=False))]
    error = UnknownName(message, key=path, where=where, nearest=nearest_path(missing[1], paths))
    error.named = missing[1]
    return error


def _flat(error: Exception) -> str:
    lines = str(error).strip().splitlines()
    kept = [line.strip() for line in lines if not line.strip().startswith(("full_key:", "object_type="))]
    return re.sub(r'^\w+ raised while resolving interpolation: "?(.*?)"?$', r"\1", " ".join(kept))


def _full_key(error: OmegaConfBaseException) -> str | None:
    return str(error.full_key) if error.full_key else None
