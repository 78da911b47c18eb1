"""Record the file or override that sets each value of a config, and find the config groups that it selects."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Protocol

from hydra.core.override_parser.types import Override

from wheelleg_exp.config.tree_lookup import at, defaults_entries, leaves, line_table
from wheelleg_exp.paths import show_file
from wheelleg_exp.terms.key_syntax import Keys, dotted, split_path

MISSING = "???"


@dataclass(frozen=True)
class ConfigFile:
    """A config file that Hydra loaded: the name that Hydra gives to it, such as ``reward/alive``, and its content.

    ``content`` excludes the defaults list. Hydra puts the content below the key ``package``; an empty key is the top
    of the tree. ``parent`` names the config file whose defaults list contains ``config_path``.
    """

    config_path: str
    file: Path
    content: Mapping[str, object]
    package: str = ""
    parent: str = ""

    @property
    def group(self) -> str:
        """Return the config group of a config file, such as ``reward`` for the file ``reward/alive.yaml``."""
        return self.config_path.rpartition("/")[0]

    @property
    def name(self) -> str:
        """Return the name of a config file without ``.yaml``, such as ``alive`` for the file ``reward/alive.yaml``."""
        return self.config_path.rpartition("/")[2]


@dataclass(frozen=True)
class Source:
    """The source of one config value: a line of a file, or an override.

    ``value`` has unresolved interpolations. ``package`` is the key below which Hydra puts ``file``. ``shadowed`` lists
    the replaced sources, oldest first. Sorting by ``order`` gives the order in which Hydra first set the keys.
    """

    keys: Keys
    value: object
    file: Path | None = None
    line: int | None = None
    override: str | None = None
    package: Keys = ()
    shadowed: tuple[Source, ...] = ()
    order: tuple[int, ...] = ()

    @property
    def path(self) -> str:
        return dotted(self.keys)

    @property
    def where(self) -> str:
        """The file and line of a config value, or the override that set the value."""
        if self.override is not None:
            return f"override {self.override}"
        return show_file(self.file, self.line) if self.file is not None else "unknown"

    @property
    def history(self) -> tuple[Source, ...]:
        """The earlier sources of a value and this one, except an empty mapping, to which later files only add keys."""
        return self.shadowed if self.value == {} else (*self.shadowed, replace(self, shadowed=()))


_Tree = dict[str, "_Tree | Source"]


class Provenance(Mapping[str, Source]):
    """The last source (file and line, or override) of each value of a config, by dotted path.

    ``deleted`` maps each key that an override removed to a ``Source`` that names the override.
    """

    def __init__(self) -> None:
        self._tree: _Tree = {}
        self._numbers = itertools.count()
        self.deleted: dict[str, Source] = {}

    @cached_property
    def _by_path(self) -> dict[str, Source]:
        return {source.path: source for source in self.below("")}

    def __getitem__(self, path: str) -> Source:
        return self._by_path[path]

    def __iter__(self) -> Iterator[str]:
        return iter(self._by_path)

    def __len__(self) -> int:
        return len(self._by_path)

    def below(self, path: str) -> list[Source]:
        return _sources(at(self._tree, path))

    def deleted_below(self, path: str) -> list[Source]:
        """Return a ``Source`` for each config key at or below ``path`` that an override removed."""
        keys = split_path(path)
        return [source for source in self.deleted.values() if source.keys[: len(keys)] == keys]

    def where(self, path: str) -> str | None:
        """Return the file and line, or the override, that set the config key ``path``.

        A section has the source of its first value, and a missing key that of the nearest existing section.
        """
        if path in self.deleted:
            return self.deleted[path].where
        keys = split_path(path)
        # If `env.x` is missing, return None, because the place of the whole section `env` would not help a user.
        for length in range(len(keys), min(2, len(keys)) - 1, -1):
            found = _sources(at(self._tree, keys[:length]))
            if found:
                return found[0].where
        return None

    def record_file(self, file: ConfigFile) -> None:
        """Record that Hydra merged a config file, after all files and before all overrides recorded later."""
        package, lines = split_path(file.package), line_table(file.file)
        for keys, value in leaves(file.content) if file.content or package else ():
            line = next((lines[keys[:n]] for n in range(len(keys), 0, -1) if keys[:n] in lines), None)
            self._record(Source((*package, *keys), value, file.file, line, package=package))

    def record_override(self, text: str, keys: Keys, value: object) -> None:
        """Record that an override set a config key to a value, or merged a mapping into a config section."""
        for inside, leaf in leaves(value):
            self._record(Source((*keys, *inside), leaf, override=text))

    def record_deletion(self, text: str, keys: Keys) -> None:
        """Record that an override deleted a config key and all keys below this key."""
        section = at(self._tree, keys[:-1])
        if not isinstance(section, dict):
            return
        first = min((source.order for source in _sources(section)), default=())
        for old in _sources(section.pop(keys[-1], None)):
            self.deleted[old.path] = Source(old.keys, None, override=text, shadowed=old.history)
        if not section and keys[:-1]:
            self._record(Source(keys[:-1], {}, override=text, order=first))
        for rest in _sources(section):  # The section has the position of its first key, even if this key is deleted.
            self._put(replace(rest, order=(*first, *rest.order)))

    def above(self, keys: Keys) -> Source | None:
        """Return the source of the value, such as a list or null, that is above a config key; None for a section."""
        found = (at(self._tree, keys[:n]) for n in range(1, len(keys)))
        return next((source for source in found if isinstance(source, Source)), None)

    def _record(self, source: Source) -> None:
        if source.keys[0] == "hydra":
            return
        above = self.above(source.keys)
        old = [above] if above is not None else _sources(at(self._tree, source.keys))
        is_mapping = above is None and any(other.keys != source.keys or isinstance(other.value, dict) for other in old)
        is_absent = source.value == MISSING and source.override is None and above is None
        if (source.value == {} and is_mapping) or (is_absent and old):
            return
        shadowed = tuple(entry for other in old for entry in other.history)
        order = source.order or min((other.order for other in old), default=(next(self._numbers),))
        self._put(replace(source, shadowed=shadowed, order=order))

    def _put(self, source: Source) -> None:
        section = self._tree
        for key in source.keys[:-1]:
            node = section.get(key)
            if not isinstance(node, dict):
                node = section[key] = {}
            section = node
        section[source.keys[-1]] = source


def _sources(node: object) -> list[Source]:
    return sorted((leaf for _, leaf in leaves(node) if isinstance(leaf, Source)), key=lambda source: source.order)


@dataclass(frozen=True)
class Choice:
    """A selection of a config group's options; ``where`` names the override or the line of a file that selects them."""

    value: object
    where: str


@dataclass(frozen=True)
class Mount:
    """A config group, such as ``reward``, and the config key, such as ``env.rewards``, that receives its options.

    ``name`` is the group's name in an override, such as ``reward@env.rewards``; ``package`` is the key, empty for the
    top. ``choices`` lists all selections in Hydra's order: each replaces the earlier ones, except with ``+``.
    """

    name: str
    group: str
    package: str
    selected: tuple[str, ...]
    options: tuple[str, ...]
    choices: tuple[Choice, ...]

    @property
    def several(self) -> bool:
        """True if the config group accepts a list of options."""
        return "@" in self.name or any(isinstance(choice.value, list) for choice in self.choices)


class ReadFiles(Protocol):
    """The config files that were read, and the config groups in all config folders."""

    loaded: dict[str, ConfigFile]

    def group_exists(self, config_path: str) -> bool: ...

    def config_exists(self, config_path: str) -> bool: ...

    def get_group_options(self, group_name: str) -> list[str]: ...


class Composition(Protocol):
    """What ``config_loader.Loader`` has read: overrides, files, and config groups."""

    overrides: list[Override]
    files: list[ConfigFile]

    @property
    def repository_used(self) -> ReadFiles: ...

    def groups(self) -> list[str]: ...

    def options(self, group: str) -> list[str]: ...


def find_mounts(loader: Composition) -> list[Mount]:
    """Return the config groups from which a composed config selects options, except Hydra's own config groups."""
    # The selections of each group are plain entries of files, ``override`` entries, and then overrides.
    plain: dict[str, list[Choice]] = {}
    replacing: dict[str, list[Choice]] = {}
    # Hydra applies config files in the order of the defaults list, parents before their children.
    for file in {file.config_path: file for file in loader.files}.values():
        for entry in defaults_entries(file.file):
            is_absolute = entry.key.startswith("/") or not file.group
            name = entry.key.lstrip("/") if is_absolute else f"{file.group}/{entry.key}"
            choice = Choice(entry.value, show_file(file.file, entry.line))
            (replacing if entry.override else plain).setdefault(name, []).append(choice)
    found = {name: [*plain.get(name, []), *replacing.get(name, [])] for name in {**plain, **replacing}}
    for override in loader.overrides:
        name = override.get_key_element().lstrip("+~")
        if name in found or loader.repository_used.group_exists(override.key_or_group):
            found.setdefault(name, []).append(Choice(override.value(), f"override {override.input_line}"))
    mounts = []
    for name, choices in found.items():
        group, _, package = name.partition("@")
        if group.startswith("hydra/"):
            continue
        # If one task extends another, ignore the file of the extended task, because the user did not select it.
        mine = [file for file in loader.files if file.group == group and file.parent.rpartition("/")[0] != group]
        if package:
            mine = [file for file in mine if file.package == package]
        elif mine:
            package = mine[0].package
        selected = tuple(file.name for file in mine)
        mounts.append(Mount(name, group, package, selected, tuple(loader.options(group)), tuple(choices)))
    return mounts


def mount_of(found: list[Mount], keys: Keys) -> Mount | None:
    """Return the config group that can set a key, such as ``reward@env.rewards`` for ``env.rewards.alive``."""
    fitting = [m for m in found if m.package and keys[: len(split_path(m.package))] == split_path(m.package)]
    return max(fitting, key=lambda m: len(m.package), default=None)


def option_of(mount: Mount, keys: Keys) -> str | None:
    """Return the name of the term in a config key, such as ``alive`` in ``env.rewards.alive.weight``, or None."""
    depth = len(split_path(mount.package))
    return dotted(keys[depth : depth + 1]) if mount.several and len(keys) > depth else None
