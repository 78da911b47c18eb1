"""Compose a config from files and overrides, and apply overrides to a recorded config.

The source of each value is recorded. An override of a Hydra setting that has no effect here raises ConfigError.
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

from hydra.core.override_parser.types import Override
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from wheelleg_exp.config.composing.config_loader import Loader, hydra_globals
from wheelleg_exp.config.composing.hydra_errors import flat, nearest_path, parse_override
from wheelleg_exp.config.composing.provenance import MISSING, Mount, Provenance, find_mounts
from wheelleg_exp.config.config_errors import (
    Mistakes,
    UnknownName,
    follows_from,
    join,
    override_of,
    parts,
    raise_all,
)  # fmt: skip
from wheelleg_exp.config.key_slots import is_settable
from wheelleg_exp.config.tree_lookup import at, leaves, node_paths
from wheelleg_exp.errors import ConfigError, MissingValue, UnreadKey, WheellegError
from wheelleg_exp.packages import config_folder
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
# In a config, other keys refer to these keys of ``env.robot``. The parameters of a run contain the resolved values.
_REFERRED = {"physics_dt", "decimation", "action_scales", "joint_sets", "body_sets", "standing_height", "wheel_radius"}
_REFERRED |= {"size", "mass", "natural_speed", "leg_reach"}
_ANY_SETTING = "a key of the config; of Hydra's settings, only hydra.searchpath and, with -m, the launcher's are read"


def is_unread(key: str) -> bool:
    """Return whether a config key, group, or override is one of Hydra's own settings, which this program ignores."""
    found = _KEY.match(key)
    return found is not None and not _READ.match(found[1])


def unread_setting(key: str, where: str, expected: str | None = None) -> ConfigError:
    """Return the error for a Hydra setting that this program ignores; the error names the setting to use instead."""
    instead = expected or _INSTEAD.get(_name(key), _ANY_SETTING)
    return UnreadKey("nothing reads this", key=key, where=where, expected=instead)


def _name(key: str) -> str:
    """Return the section of ``hydra`` that contains a key or a group: ``run`` for ``hydra.run.dir``."""
    return re.split(r"[./]", key, maxsplit=2)[1] if re.match(r"hydra[./]", key) else ""


@dataclass(frozen=True)
class Composed:
    """A composed config.

    ``config`` is the resolved tree of plain mappings, without the null terms in ``removed_terms``. ``raw`` is the
    read-only OmegaConf config with unresolved ``${...}`` and null terms. ``hydra`` contains Hydra's own settings.
    """

    config: dict[str, Any]
    raw: DictConfig
    overrides: list[str]
    primary: str
    config_dirs: tuple[Path, ...]
    removed_terms: tuple[str, ...]
    hydra: DictConfig = field(repr=False)
    loader: Loader = field(repr=False)

    @property
    def terms_without_role(self) -> list[str]:
        """The terms that were removed because the robot lists no joints or links of their role, such as legs."""
        return [key for key in self.removed_terms if at(self.raw_tree, split_path(key)) is not None]

    @property
    def provenance(self) -> Provenance:
        """The file or override that set each config value."""
        return self.loader.provenance

    @cached_property
    def mounts(self) -> list[Mount]:
        """The config groups from which the config selects options, except Hydra's own config groups."""
        with hydra_globals():
            return find_mounts(self.loader)

    @cached_property
    def raw_tree(self) -> dict[str, object]:
        """The config as nested dicts with unresolved interpolations; callers must not change these dicts."""
        return plain_tree(self.raw)

    @contextmanager
    def placing(self) -> Iterator[None]:
        """Add the file and line, or the override, of the wrong key to each error that the ``with`` block raises."""
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
        # Several files can set the keys of one config section, so an error about a section names no file.
        is_section = isinstance(self.config.get(error.key or ""), Mapping)
        if error.where is None and error.key is not None and not is_section:
            error.where = self.provenance.where(error.key)

    @property
    def asset_roots(self) -> tuple[Path, ...]:
        """Return the folders in which ``paths.find_asset`` searches for the user's robot files."""
        return tuple(root for d in self.config_dirs for root in (d.parent / "assets", d.parent))

    def hydra_files(self) -> dict[str, str]:
        """Return the texts of the files that Hydra writes for a run: config.yaml, hydra.yaml, and overrides.yaml."""
        return {
            "config.yaml": OmegaConf.to_yaml(self.raw),
            "hydra.yaml": OmegaConf.to_yaml(OmegaConf.create({"hydra": self.hydra})),
            "overrides.yaml": OmegaConf.to_yaml(OmegaConf.create(self.overrides)),
        }


def compose(
    overrides: Sequence[str] = (), *, primary: str = "train", config_dirs: Sequence[Path] = (), launching: bool = False
) -> Composed:
    """Compose the primary config file with overrides, as Hydra does.

    All mistakes raise one ConfigError. ``launching`` permits overrides of Hydra settings such as ``hydra.launcher``.
    """
    composed, problems, _ = compose_leniently(overrides, primary, config_dirs, launching=launching)
    if problems or composed is None:
        raise_all(problems)
    return composed


def compose_leniently(
    overrides: Sequence[str], primary: str, config_dirs: Sequence[Path], *, launching: bool = False
) -> tuple[Composed | None, list[ConfigError], list[str]]:
    """Compose a config without the files, overrides, and values that contain mistakes, and return the mistakes, too.

    The config is None if nothing can be composed. The last list contains the config keys whose values are unknown
    because of mistakes, as ``config_errors.follows_from`` describes.
    """
    texts = override_texts(overrides)
    unread: list[ConfigError] = []
    for text in () if launching else texts:
        found = _KEY.match(text)
        key, where = found[1] if found else "", f"override {text}"
        if _name(key) in _OF_SWEEPS:
            message = "this is a setting of a sweep, and this is one run"
            expected = "-m (--multirun) in addition, or neither"
            unread.append(ConfigError(message, key=key, where=where, expected=expected))
        elif is_unread(text):
            unread.append(unread_setting(key, where))
    ignored = {override_of(error) for error in unread}
    folders = tuple(config_folder(folder) for folder in config_dirs)
    with hydra_globals():
        loader = Loader(folders)
        try:
            raw = loader.load(primary, [text for text in texts if text not in ignored])
        except ConfigError:
            return None, [*unread, *loader.problems], loader.lost
    OmegaConf.set_struct(raw, False)
    hydra = raw.pop("hydra")
    OmegaConf.set_readonly(raw, True)
    config, unresolved = _resolve(raw, loader.provenance)
    problems = [*unread, *loader.problems, *(e for e in unresolved if not follows_from(e, loader.lost))]
    lost = [*loader.lost, *(str(error.key) for error in unresolved)]
    if config is None:
        return None, problems, lost
    removed = drop_removed(config, plain_tree(raw))
    return Composed(config, raw, texts, primary, folders, removed, hydra, loader), problems, lost


def plain_tree(raw: DictConfig) -> dict[str, object]:
    """Return a config as nested dicts with unresolved interpolations."""
    tree = OmegaConf.to_container(raw, resolve=False)
    return {str(key): node for key, node in tree.items()} if isinstance(tree, dict) else {}


def override_texts(overrides: Sequence[str]) -> list[str]:
    """Return overrides as a list of texts; a single text is one override."""
    return [overrides] if isinstance(overrides, str) else [str(text) for text in overrides]


def _resolve(raw: DictConfig, places: Provenance) -> tuple[dict[str, object] | None, list[ConfigError]]:
    """Return the resolved tree, with null in place of missing values and invalid interpolations, and their errors."""
    try:
        return _resolved(raw), []
    except OmegaConfBaseException as error:
        other = ConfigError(_flat(error), key=str(error.full_key) if error.full_key else None)
        errors = list(_unresolved(raw, places)) or [other]
    tree = OmegaConf.to_container(raw, resolve=False)
    for keys in (split_path(str(error.key)) for error in errors):
        if isinstance(section := at(tree, keys[:-1]), dict):
            section[keys[-1]] = None
    try:
        return _resolved(OmegaConf.create(tree)), errors
    except OmegaConfBaseException:
        return None, errors


def _resolved(raw: object) -> dict[str, object]:
    resolved = OmegaConf.to_container(raw, resolve=True, throw_on_missing=True)
    return {str(key): value for key, value in resolved.items()} if isinstance(resolved, dict) else {}


def _unresolved(raw: DictConfig, places: Provenance) -> Iterator[ConfigError]:
    tree = OmegaConf.to_container(raw, resolve=False)
    for keys, value in leaves(tree):
        path = dotted(keys)
        if value == MISSING or (isinstance(value, list) and MISSING in value):
            yield MissingValue(key=path, where=places.where(path), expected=f"{path}=<value>")
        elif "${" in str(value):
            try:
                found = OmegaConf.select(raw, path, throw_on_missing=True)
                if OmegaConf.is_config(found):
                    OmegaConf.to_container(found, resolve=True, throw_on_missing=True)
            except OmegaConfBaseException as problem:
                message, where = _flat(problem), places.where(path)
                missing = re.match(r"Interpolation key '([^']+)' not found", message)
                if missing is None:
                    yield ConfigError(message, key=path, where=where)
                    continue
                nearest = nearest_path(missing[1], list(map(dotted, node_paths(tree))))
                error = UnknownName(message, key=path, where=where, nearest=nearest)
                error.named = missing[1]
                yield error


def _flat(error: Exception) -> str:
    return re.sub(r'^\w+ raised while resolving interpolation: "?(.*?)"?$', r"\1", flat(error))


def apply_overrides(tree: Mapping[str, object], overrides: Sequence[str]) -> dict[str, Any]:
    """Return a copy of ``tree`` with overrides applied: ``key=value``, ``+key=value``, ``++key=value``, ``~key``.

    An override cannot select an option of a config group, because ``apply_overrides`` reads no config files. Null terms
    are removed. An override of a missing key or of one of Hydra's own settings raises ConfigError.
    """
    changed = copy.deepcopy(dict(tree))
    for text in overrides:
        override = _parse(text)
        keys = split_path(override.key_or_group)
        if keys[0] == "hydra":
            raise unread_setting(dotted(keys), f"override {text}", "a key of the run's parameters")
        parent = changed
        for depth, key in enumerate(keys[:-1], start=1):
            if not isinstance(child := parent.get(key), dict):
                raise _unknown(changed, keys[:depth], text)
            parent = child
        adds = override.is_add() or override.is_force_add()
        if keys[-1] not in parent and not adds:
            raise _unknown(changed, keys, text)
        if override.is_delete():
            del parent[keys[-1]]
        else:
            parent[keys[-1]] = override.value()
    if overrides:  # Without overrides, terms that are null stay in the config.
        drop_removed(changed)
    return changed


def require_read(
    recorded: Mapping[str, object],
    overrides: Sequence[str],
    read: Callable[[Mapping[str, object]], object],
    instead: Mapping[str, str],
) -> None:
    """Raise ConfigError if an override has no effect, because the calling command does not read its config key.

    ``read`` returns the part of a config that the calling command uses. An override of such a key is valid, even if it
    repeats the old value. ``instead`` maps a key to the advice for errors about it or its subkeys; ``instead[""]`` is
    the advice for all other keys.
    """
    errors: list[ConfigError] = []
    changed = apply_overrides(recorded, overrides)
    for text in overrides:
        keys = split_path(_parse(text).key_or_group)
        # Check a removed key in the config without the overrides.
        tree = changed if at(changed, keys) is not None else recorded
        is_referred = keys[:2] == ("env", "robot") and not _REFERRED.isdisjoint(keys[2:3])
        if is_referred or not _is_used(at(tree, keys), at(read(tree), keys)):
            key = dotted(keys)
            expected = next(what for name, what in instead.items() if not name or f"{key}.".startswith(f"{name}."))
            expected = "the key that contains its value, such as env.sim.dt" if is_referred else expected
            where = f"override {text}"
            errors.append(UnreadKey("this command ignores the key", key=key, where=where, expected=expected))
    if errors:
        raise_all(errors)


def _is_used(given: object, used: object) -> bool:
    if isinstance(given, Mapping) and given:
        return isinstance(used, Mapping) and any(_is_used(node, used.get(name)) for name, node in given.items())
    return given == used


@contextmanager
def placing(overrides: Sequence[str]) -> Iterator[None]:
    """If a ConfigError in the ``with`` block names no file or override, add the override that set the wrong key."""
    try:
        yield
    except ConfigError as error:
        for part in parts(error):
            key, names = f"{part.key}.", ((text, f"{_parse(text).key_or_group}.") for text in reversed(overrides))
            setters = (f"override {text}" for text, own in names if key.startswith(own) or own.startswith(key))
            part.where = part.where or next(setters, None)
        raise join(parts(error)) from error


def _parse(text: str) -> Override:
    override = parse_override(text)
    if override.is_sweep_override():
        message = "the command accepts only one value per key"
        raise ConfigError(message, key=text, where=f"override {text}", expected="one value")
    return override


def _unknown(tree: dict[str, object], keys: Sequence[str], text: str) -> ConfigError:
    name = dotted(keys)
    message, where = "there is no such key in the run's parameters", f"override {text}"
    is_unset = text.startswith(f"{name}=") and is_settable(tree, tuple(keys))
    expected = f"+{text}" if is_unset else "an existing key; config groups can only be selected for a new run"
    nearest = nearest_path(name, [dotted(path) for path in node_paths(tree)])
    return ConfigError(message, key=name, where=where, expected=expected, nearest=nearest)
