"""Compose a config from files and overrides into one plain tree, and apply overrides to a recorded config.

Every leaf of a composed config has a place: the file and line, or the override, that set it. Overrides of Hydra's
own settings that have no effect here are errors.
"""

from __future__ import annotations

import copy
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

from wheelleg_exp.config.composing.config_loader import COMPOSING_ERRORS, Loader, hydra_globals, require_folder
from wheelleg_exp.config.composing.hydra_errors import flat, nearest_path, translate, unreadable
from wheelleg_exp.config.composing.provenance import MISSING, Mount, Provenance, find_mounts, trace
from wheelleg_exp.config.config_errors import Mistakes, UnknownName, join, parts, raise_all
from wheelleg_exp.config.config_tree import leaves, node_paths
from wheelleg_exp.errors import ConfigError, MissingValue, UnreadKey, WheellegError
from wheelleg_exp.terms.key_syntax import dotted, split_path
from wheelleg_exp.terms.term_binding import drop_removed

_KEY = re.compile(r"[+~]*(hydra(?:[./][^=@]*)?)(?=[=@]|$)")
_READ = re.compile(r"hydra(/launcher|/sweeper|\.(searchpath|launcher\.n_jobs|sweeper\.params)(\..+)?)$")
_OF_SWEEPS = ("launcher", "sweeper")
_INSTEAD = {
    "run": "run.root=DIR, below which run directories are made, and run.name=NAME",
    "job": "run.name=NAME for the run directory's name",
    "output_subdir": "run.root=DIR; Hydra's files are in .hydra of the run directory",
    "sweep": "run.root; every job has its own run directory there",
    "mode": "-m (--multirun) alone",
    "launcher": "hydra.launcher.n_jobs, how many jobs run at once",
    "sweeper": "hydra.sweeper.params, overrides by key",
    "verbose": "--debug, which shows the traceback of an error",
}
_ANY_SETTING = "a key of the config; of Hydra's settings, only hydra.searchpath and, with -m, the launcher's are read"


def is_unread(key: str) -> bool:
    """Return whether a key, a group or an override is one of Hydra's own settings that nothing reads."""
    found = _KEY.match(key)
    return found is not None and not _READ.match(found[1])


def unread_setting(key: str, where: str, expected: str | None = None) -> ConfigError:
    """Return the error for one of Hydra's own settings that nothing reads, with the setting to use instead."""
    instead = expected or _INSTEAD.get(_name(key), _ANY_SETTING)
    return UnreadKey("nothing reads this", key=key, where=where, expected=instead)


def unread_overrides(overrides: Sequence[str]) -> list[ConfigError]:
    """Return an error for each override that sets one of Hydra's own settings without effect on a single run."""
    errors = []
    for text in overrides:
        found = _KEY.match(text)
        key, where = found[1] if found else "", f"override {text}"
        if _name(key) in _OF_SWEEPS:
            expected = "-m (--multirun) in addition, or neither"
            message = "this is a setting of a sweep, and this is one run"
            errors.append(ConfigError(message, key=key, where=where, expected=expected))
        elif is_unread(text):
            errors.append(unread_setting(key, where))
    return errors


def _name(key: str) -> str:
    """Return the section of ``hydra`` that a key or a group belongs to, such as ``run``."""
    return re.split(r"[./]", key, maxsplit=2)[1] if re.match(r"hydra[./]", key) else ""


@dataclass(frozen=True)
class Composed:
    """A composed config.

    Attributes:
        config: the resolved tree as plain mappings. Null terms are removed from the term sections. Every term section
            exists, but can be empty.
        raw: the tree as an OmegaConf config, with ``${...}`` unresolved and null terms; read-only.
        overrides: the overrides as typed.
        primary: name of the primary config.
        config_dirs: the user's config folders, absolute.
        removed_terms: paths of the terms that were set to null.
        hydra: Hydra's own node.
        loader: the loader that has composed the config.
        parsed: the parsed overrides.
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
        """The source of each leaf, computed on first use."""
        return trace(self.loader, self.primary, self.parsed)

    @cached_property
    def mounts(self) -> list[Mount]:
        """The mounted groups, without Hydra's own, computed on first use."""
        return find_mounts(self.loader, self.parsed)

    @cached_property
    def raw_tree(self) -> dict[str, Any]:
        """The raw tree as plain mappings, to be read only."""
        tree = OmegaConf.to_container(self.raw, resolve=False)
        return {str(key): node for key, node in tree.items()} if isinstance(tree, dict) else {}

    @contextmanager
    def placing(self) -> Iterator[None]:
        """Add the place of its key to every error that leaves the block."""
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
        is_section = isinstance(self.config.get(error.key or ""), Mapping)  # a whole section has no single place
        if error.where is None and error.key is not None and not is_section:
            error.where = self.provenance.where(error.key)

    @property
    def files(self) -> list[Path]:
        """The stock files and user files that were read, in that order."""
        return [loaded.file for loaded in self.loader.repository_used.loaded.values()]

    @property
    def asset_roots(self) -> tuple[Path, ...]:
        """The folders in which ``paths.find_asset`` searches the user's assets."""
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
            raise translate(error, used, primary, texts) from error
        parsed = OverridesParser.create().parse_overrides(texts)
    OmegaConf.set_struct(raw, False)
    hydra = raw.pop("hydra")
    OmegaConf.set_readonly(raw, True)
    config = _resolve(raw, lambda: trace(used, primary, parsed))
    removed = drop_removed(config)
    return Composed(config, raw, texts, primary, folders, removed, hydra, used, parsed)


def override_texts(overrides: Sequence[str]) -> list[str]:
    """Return overrides as a list. A single text is one override, not a sequence of letters."""
    return [overrides] if isinstance(overrides, str) else [str(text) for text in overrides]


def _resolve(raw: DictConfig, provenance: Any) -> dict[str, Any]:
    """Return the resolved plain tree, or raise one ConfigError with all missing values and bad interpolations."""
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
    """Return the error for a bad interpolation. If its key does not exist, the error contains the nearest key."""
    missing = re.match(r"Interpolation key '([^']+)' not found", message)
    if missing is None:
        return ConfigError(message, key=path, where=where)
    paths = [dotted(keys) for keys in node_paths(OmegaConf.to_container(raw, resolve=False))]
    error = UnknownName(message, key=path, where=where, nearest=nearest_path(missing[1], paths))
    error.named = missing[1]
    return error


def _flat(error: Exception) -> str:
    return re.sub(r'^\w+ raised while resolving interpolation: "?(.*?)"?$', r"\1", flat(error))


def _full_key(error: OmegaConfBaseException) -> str | None:
    return str(error.full_key) if error.full_key else None


_ANOTHER_VALUE = "another value"


def apply_overrides(tree: Mapping[str, Any], overrides: Sequence[str]) -> dict[str, Any]:
    """Return a copy of ``tree`` with overrides applied: ``key=value``, ``+key=value``, ``++key=value``, ``~key``.

    Groups cannot be selected here, because nothing is composed. A null term is removed, as in a composed config.

    Raises:
        ConfigError: an override cannot be parsed, names a missing key, or is one of Hydra's own settings.
    """
    changed = copy.deepcopy(dict(tree))
    for text in overrides:
        _apply(changed, _parse(text), text)
    if overrides:  # without overrides, a recorded tree stays unchanged
        drop_removed(changed)
    return changed


def require_read(
    recorded: Mapping[str, Any],
    overrides: Sequence[str],
    read: Callable[[Mapping[str, Any]], Any],
    instead: Mapping[str, str],
) -> None:
    """Raise ConfigError for all overrides that nothing reads.

    An override is read if its value, or any other value of its key, changes the result of ``read``. An override that
    repeats the current value is therefore accepted.

    Args:
        recorded: the tree before the overrides.
        overrides: the overrides, which must be valid for ``apply_overrides``.
        read: returns the part of a tree that is read, comparable with ``==``.
        instead: the text for the expected value of a key and the keys below it; ``""`` applies to all other keys.
    """
    errors: list[ConfigError] = []
    tree: Mapping[str, Any] = recorded
    for text in overrides:
        keys, after = split_path(_parse(text).key_or_group), apply_overrides(tree, [text])
        other = apply_overrides(after, [])
        parent = _parent(other, keys, text)
        old = parent.get(keys[-1], _ANOTHER_VALUE)
        parent[keys[-1]] = (
            {**(old or {}), _ANOTHER_VALUE: None} if old is None or isinstance(old, Mapping) else _ANOTHER_VALUE
        )
        if read(after) == read(tree) == read(other):
            key = dotted(keys)
            expected = next(what for name, what in instead.items() if not name or f"{key}.".startswith(f"{name}."))
            message = "this command ignores the key"
            errors.append(UnreadKey(message, key=key, where=f"override {text}", expected=expected))
        tree = after
    if errors:
        raise_all(errors)


@contextmanager
def placing(overrides: Sequence[str]) -> Iterator[None]:
    """Add the override of its key to every ConfigError without a place that leaves the block."""
    try:
        yield
    except ConfigError as error:
        for part in parts(error):
            part.where = part.where or _setter(str(part.key), overrides)
        raise join(parts(error)) from error


def _setter(key: str, overrides: Sequence[str]) -> str | None:
    for text in reversed(overrides):
        own = _parse(text).key_or_group
        if f"{key}.".startswith(f"{own}.") or f"{own}.".startswith(f"{key}."):
            return f"override {text}"
    return None


def _parse(text: str) -> Override:
    problem = unreadable(text)
    if problem is not None:
        raise problem
    override = OverridesParser.create().parse_override(text)
    if override.is_sweep_override():
        raise ConfigError("a sweep is not possible here", key=text, where=f"override {text}", expected="one value")
    return override


def _apply(tree: dict[str, Any], override: Override, text: str) -> None:
    keys = split_path(override.key_or_group)
    if keys[0] == "hydra":
        raise unread_setting(dotted(keys), f"override {text}", "a key of the run's parameters")
    parent = _parent(tree, keys, text)
    if override.is_delete():
        _require_present(tree, parent, keys, text)
        del parent[keys[-1]]
        return
    if not override.is_add() and not override.is_force_add():
        _require_present(tree, parent, keys, text)
    parent[keys[-1]] = override.value()


def _parent(tree: dict[str, Any], keys: Sequence[str], text: str) -> dict[str, Any]:
    node = tree
    for depth, key in enumerate(keys[:-1], start=1):
        if not isinstance(node.get(key), dict):
            raise _unknown(tree, keys[:depth], text)
        node = node[key]
    return node


def _require_present(tree: dict[str, Any], parent: dict[str, Any], keys: Sequence[str], text: str) -> None:
    if keys[-1] not in parent:
        raise _unknown(tree, keys, text)


def _unknown(tree: dict[str, Any], keys: Sequence[str], text: str) -> ConfigError:
    known = [dotted(path) for path in node_paths(tree)]
    name = dotted(keys)
    return ConfigError(
        "there is no such key in the run's parameters",
        key=name,
        where=f"override {text}",
        expected="an existing key; config groups can only be selected for a new run",
        nearest=nearest_path(name, known),
    )
