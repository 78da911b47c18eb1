"""Trace where each leaf and each selected group of a composed config comes from.

The source of a leaf is a file and line, or an override; a source also lists the values that it replaced.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from hydra.core.override_parser.types import Override
from omegaconf._utils import split_key

from wheelleg_exp.config.composing.config_loader import LoadedFile, Loader, hydra_globals
from wheelleg_exp.config.config_tree import defaults_entries, leaves, line_table
from wheelleg_exp.paths import show_file
from wheelleg_exp.terms.key_syntax import Keys, dotted, split_path

MISSING = "???"


@dataclass(frozen=True)
class Source:
    """One source of one leaf: a line of a file, or an override.

    Attributes:
        path: the leaf.
        value: the raw value, with ``${...}`` as written.
        file: the file, or None for an override.
        line: the line in the file, from 1.
        override: the override as typed, or None for a file.
        package: the keys below which the file is mounted.
        shadowed: the earlier sources whose values this source replaced, oldest first.
    """

    path: str
    value: Any
    file: Path | None = None
    line: int | None = None
    override: str | None = None
    package: Keys = ()
    shadowed: tuple[Source, ...] = ()

    @property
    def where(self) -> str:
        """``file:line``, or the override."""
        if self.override is not None:
            return f"override {self.override}"
        return show_file(self.file, self.line) if self.file is not None else "unknown"


class Provenance(Mapping[str, Source]):
    """The last source of each leaf, by dotted path; ``deleted`` contains the leaves that overrides removed."""

    def __init__(self, sources: dict[Keys, Source], deleted: dict[Keys, Source]) -> None:
        self._sources = sources
        self._by_path = {dotted(keys): source for keys, source in sources.items()}
        self.deleted = {dotted(keys): source for keys, source in deleted.items()}

    def __getitem__(self, path: str) -> Source:
        return self._by_path[path]

    def __iter__(self) -> Iterator[str]:
        return iter(self._by_path)

    def __len__(self) -> int:
        return len(self._by_path)

    def below(self, path: str) -> list[Source]:
        """Return the sources of the leaf at ``path``, or of every leaf below it."""
        keys = split_path(path)
        return [source for leaf, source in self._sources.items() if leaf[: len(keys)] == keys]

    def deleted_below(self, path: str) -> list[Source]:
        """Return the leaves at or below ``path`` that overrides removed."""
        keys = split_path(path)
        return [source for leaf, source in self.deleted.items() if split_path(leaf)[: len(keys)] == keys]

    def where(self, path: str) -> str | None:
        """Return the place that set ``path``: of the leaf, of the first leaf below, or of the nearest key above."""
        if path in self.deleted:
            return self.deleted[path].where
        keys = split_path(path)
        # A top-level key comes from many files, so its place does not help to find a missing key in it.
        for length in range(len(keys), min(2, len(keys)) - 1, -1):
            found = [s for leaf, s in self._sources.items() if leaf[:length] == keys[:length]]
            if found:
                return found[0].where
        return None


class _Replay:
    """The sources of all leaves, during a replay of the composition."""

    def __init__(self) -> None:
        self.sources: dict[Keys, Source] = {}
        self.deleted: dict[Keys, Source] = {}

    def write(self, keys: Keys, source: Source) -> None:
        """Record the source of a leaf, and the earlier sources that it replaces."""
        below = [leaf for leaf in self.sources if len(leaf) > len(keys) and leaf[: len(keys)] == keys]
        if source.value == {} and (below or isinstance(self._value(keys), dict)):
            return
        absent = isinstance(source.value, str) and source.value == MISSING and source.override is None
        if absent and (below or keys in self.sources):
            return
        above = [keys[:n] for n in range(1, len(keys)) if keys[:n] in self.sources]
        same = [keys] if keys in self.sources else []
        hidden = [*above, *below, *same]
        shadowed = tuple(entry for old in hidden for entry in _history(self.sources[old]))
        self._put(keys, replace(source, shadowed=shadowed), hidden)

    def delete(self, keys: Keys, override: str) -> None:
        """Record that an override deleted a key and everything below it."""
        gone = [leaf for leaf in self.sources if leaf[: len(keys)] == keys]
        for leaf in gone:
            shadowed = _history(self.sources[leaf])
            self.deleted[leaf] = Source(dotted(leaf), None, override=override, shadowed=shadowed)
        parent = keys[:-1]
        if parent and sum(leaf[: len(parent)] == parent for leaf in self.sources) == len(gone):
            self._put(parent, Source(dotted(parent), {}, override=override), gone)
        else:
            self._gather(parent)  # so that the remaining leaves keep the parent's place in the order
            self.sources = {leaf: old for leaf, old in self.sources.items() if leaf not in set(gone)}

    def _gather(self, parent: Keys) -> None:
        """Move all leaves of a section next to its first leaf. The order within each mapping stays the same."""
        inside = {leaf: old for leaf, old in self.sources.items() if leaf[: len(parent)] == parent}
        before: dict[Keys, Source] = {}
        for leaf, old in self.sources.items():
            before |= inside if leaf in inside and leaf not in before else {leaf: old}
        self.sources = before

    def _put(self, keys: Keys, source: Source, hidden: Sequence[Keys]) -> None:
        """Put a leaf at the place of the first leaf that it replaces, because the order of terms matters."""
        if not hidden or list(hidden) == [keys]:
            self.sources[keys] = source
            return
        gone, first = set(hidden), next(leaf for leaf in self.sources if leaf in hidden)
        entries = [(keys, source) if leaf == first else (leaf, old) for leaf, old in self.sources.items()]
        self.sources = {leaf: old for leaf, old in entries if leaf == keys or leaf not in gone}

    def _value(self, keys: Keys) -> Any:
        source = self.sources.get(keys)
        return source.value if source is not None else None


def _history(source: Source) -> tuple[Source, ...]:
    # A key that is added to an empty mapping does not replace it.
    own = () if source.value == {} else (replace(source, shadowed=()),)
    return (*source.shadowed, *own)


def trace(loader: Loader, primary: str, parsed: Sequence[Override]) -> Provenance:
    """Replay the loader's last composition, and return the source of each leaf.

    Args:
        loader: a loader whose ``load`` has run.
        primary: name of the primary config.
        parsed: the overrides of that ``load``.
    """
    replay = _Replay()
    with hydra_globals():
        defaults = loader.defaults(primary, parsed)
        loaded = loader.repository_used.loaded
        for default in defaults.defaults:
            if default.config_path in loaded:
                _write_file(replay, loaded[default.config_path], default.package or "")
        for override in defaults.config_overrides:
            _write_override(replay, override)
    sources = {keys: source for keys, source in replay.sources.items() if keys[0] != "hydra"}
    return Provenance(sources, replay.deleted)


def _write_file(replay: _Replay, loaded: LoadedFile, package: str) -> None:
    prefix = tuple(package.split(".")) if package else ()
    lines = line_table(loaded.file)
    if not loaded.content and not prefix:
        return
    for keys, value in leaves(loaded.content):
        line = next((lines[keys[:n]] for n in range(len(keys), 0, -1) if keys[:n] in lines), None)
        path = (*prefix, *keys)
        replay.write(path, Source(dotted(path), value, file=loaded.file, line=line, package=prefix))


def _write_override(replay: _Replay, override: Override) -> None:
    text = str(override.input_line)
    keys = tuple(split_key(override.key_or_group))
    if override.is_delete():
        replay.delete(keys, text)
        return
    keys, value = _into_list(replay, keys, override.value())
    for rest, leaf in leaves(value):
        path = (*keys, *rest)
        replay.write(path, Source(dotted(path), leaf, override=text))


def _into_list(replay: _Replay, keys: Keys, value: Any) -> tuple[Keys, Any]:
    """Convert an override of one list element into an override of the list."""
    for n in range(1, len(keys)):
        source = replay.sources.get(keys[:n])
        if source is not None and isinstance(source.value, list):
            return keys[:n], _with_element(source.value, keys[n:], value)
    return keys, value


def _with_element(node: Any, keys: Keys, value: Any) -> Any:
    if not keys:
        return value
    if isinstance(node, list):
        copy = list(node)
        copy[int(keys[0])] = _with_element(copy[int(keys[0])], keys[1:], value)
        return copy
    return {**(node or {}), keys[0]: _with_element((node or {}).get(keys[0]), keys[1:], value)}


@dataclass(frozen=True)
class Choice:
    """One selection of a group's options, by a file's defaults list or by an override.

    Attributes:
        value: the options, as written.
        where: ``file:line``, or the override.
    """

    value: Any
    where: str


@dataclass(frozen=True)
class Mount:
    """A group at one place of the tree.

    Attributes:
        name: the group as an override names it: ``robot``, ``reward@env.rewards``.
        group: the group.
        package: the key below which the group's options are mounted; empty for the top.
        selected: the selected options, in order.
        options: all options of the group.
        choices: every selection, in the order in which Hydra applies them. Each replaces the earlier ones, but ``+``
            adds an option.
    """

    name: str
    group: str
    package: str
    selected: tuple[str, ...]
    options: tuple[str, ...]
    choices: tuple[Choice, ...]

    @property
    def several(self) -> bool:
        """Whether the group takes a list of options."""
        return "@" in self.name or any(isinstance(choice.value, list) for choice in self.choices)


def find_mounts(loader: Loader, parsed: Sequence[Override]) -> list[Mount]:
    """Return the groups that a composed config mounts, without Hydra's own groups.

    Args:
        loader: the loader that has composed the config.
        parsed: the overrides.
    """
    found = loader.merged
    with hydra_globals():
        return [_mount(loader, name, choices, found) for name, choices in _written(loader, parsed, found).items()]


def _mount(loader: Loader, name: str, choices: list[Choice], found: Sequence[Any]) -> Mount:
    group, _, package = name.partition("@")
    mine = [d for d in found if str(d.config_path).rpartition("/")[0] == group and not _nested(d, group)]
    if package:
        mine = [d for d in mine if d.package == package]
    elif mine:
        package = mine[0].package or ""
    selected = tuple(str(d.config_path).rpartition("/")[2] for d in mine)
    return Mount(name, group, package, selected, tuple(loader.options(group)), tuple(choices))


def _nested(default: Any, group: str) -> bool:
    """Return whether another option of the group extends this one, as a task extends its parent task."""
    return str(default.parent).rpartition("/")[0] == group


def _written(loader: Loader, parsed: Sequence[Override], defaults: Sequence[Any]) -> dict[str, list[Choice]]:
    """Return the selections of every mount: of files, then of ``override`` entries in files, then as typed."""
    plain: dict[str, list[Choice]] = {}
    replacing: dict[str, list[Choice]] = {}
    loaded = loader.repository_used.loaded
    # Hydra applies the files in the order of the defaults list: parents first.
    for path in dict.fromkeys(str(default.config_path) for default in defaults):
        for name, choice, override in _in_file(path, loaded[path].file) if path in loaded else ():
            (replacing if override else plain).setdefault(name, []).append(choice)
    found = {name: [*plain.get(name, []), *replacing.get(name, [])] for name in {**plain, **replacing}}
    for override in parsed:
        name = override.get_key_element().lstrip("+~")
        if name in found or _is_group(loader, override):
            found.setdefault(name, []).append(Choice(override.value(), f"override {override.input_line}"))
    return {name: choices for name, choices in found.items() if not name.startswith("hydra/")}


def _in_file(config_path: str, file: Path) -> Iterator[tuple[str, Choice, bool]]:
    folder = config_path.rpartition("/")[0]
    for entry in defaults_entries(file):
        group, at, package = entry.key.partition("@")
        absolute = group.lstrip("/") if group.startswith("/") or not folder else f"{folder}/{group}"
        yield f"{absolute}{at}{package}", Choice(entry.value, show_file(file, entry.line)), entry.override


def _is_group(loader: Loader, override: Override) -> bool:
    return bool(loader.repository_used.group_exists(override.key_or_group))


def mount_of(found: list[Mount], keys: Keys) -> Mount | None:
    """Return the mount that contains the node at ``keys``: the one with the longest package."""
    fitting = [m for m in found if m.package and keys[: len(split_path(m.package))] == split_path(m.package)]
    return max(fitting, key=lambda m: len(m.package), default=None)


def option_of(mount: Mount, keys: Keys) -> str | None:
    """Return the option of ``mount`` that contains the term at ``keys``; None if ``keys`` are not inside a term."""
    depth = len(split_path(mount.package))
    return dotted(keys[depth : depth + 1]) if mount.several and len(keys) > depth else None
