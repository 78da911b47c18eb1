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
from wheelleg_exp.config.config_tree import build, defaults_entries, leaves, line_table
from wheelleg_exp.paths import show_file
from wheelleg_exp.terms.key_syntax import Keys, dotted, split_path

MISSING = "???"


@dataclass(frozen=True)
class Source:
    """One writer of one leaf.

    Attributes:
        path: the leaf that it wrote.
        value: the raw value, with ``${...}`` as written.
        file: the file, or None for an override.
        line: the line in the file, from 1.
        override: the override as typed, or None for a file.
        package: the keys under which the file's own keys stand.
        shadowed: the earlier writers whose values this one hides, oldest first.
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
    """The last writer of each leaf, by its dotted path; ``deleted`` holds what overrides removed."""

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

    def tree(self) -> dict[str, Any]:
        """Return the replayed config: the raw values as a nested mapping."""
        return build({keys: source.value for keys, source in self._sources.items()})

    def below(self, path: str) -> list[Source]:
        """Return the sources of the leaf at ``path``, or of every leaf below it."""
        keys = split_path(path)
        return [source for leaf, source in self._sources.items() if leaf[: len(keys)] == keys]

    def deleted_below(self, path: str) -> list[Source]:
        """Return what overrides removed at or below ``path``."""
        keys = split_path(path)
        return [source for leaf, source in self.deleted.items() if split_path(leaf)[: len(keys)] == keys]

    def where(self, path: str) -> str | None:
        """Return the place that set ``path``: the leaf's, else the first below, else the nearest above."""
        if path in self.deleted:
            return self.deleted[path].where
        keys = split_path(path)
        # A key at the top stands for too much to tell where a part of it that is not there should have been.
        for length in range(len(keys), min(2, len(keys)) - 1, -1):
            found = [s for leaf, s in self._sources.items() if leaf[:length] == keys[:length]]
            if found:
                return found[0].where
        return None


class _Replay:
    """The leaves while they are written one after the other."""

    def __init__(self) -> None:
        self.sources: dict[Keys, Source] = {}
        self.deleted: dict[Keys, Source] = {}

    def write(self, keys: Keys, source: Source) -> None:
        """Note that a leaf was written, and whose values it hides."""
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
        """Note that an override took away a key and all below it."""
        gone = [leaf for leaf in self.sources if leaf[: len(keys)] == keys]
        for leaf in gone:
            shadowed = _history(self.sources[leaf])
            self.deleted[leaf] = Source(dotted(leaf), None, override=override, shadowed=shadowed)
        parent = keys[:-1]
        if parent and sum(leaf[: len(parent)] == parent for leaf in self.sources) == len(gone):
            self._put(parent, Source(dotted(parent), {}, override=override), gone)
        else:
            self._gather(parent)  # so that what stays keeps the parent in its place
            self.sources = {leaf: old for leaf, old in self.sources.items() if leaf not in set(gone)}

    def _gather(self, parent: Keys) -> None:
        """Move all leaves of a section to its first one, before one is taken away; no mapping's order changes."""
        inside = {leaf: old for leaf, old in self.sources.items() if leaf[: len(parent)] == parent}
        before: dict[Keys, Source] = {}
        for leaf, old in self.sources.items():
            before |= inside if leaf in inside and leaf not in before else {leaf: old}
        self.sources = before

    def _put(self, keys: Keys, source: Source, hidden: Sequence[Keys]) -> None:
        """Put a leaf in the place of the first of those that it hides, because the order of terms has a meaning."""
        if not hidden or list(hidden) == [keys]:
            self.sources[keys] = source
            return
        gone, first = set(hidden), next(leaf for leaf in self.sources if leaf in hidden)
        kept = [(keys, source) if leaf == first else (leaf, old) for leaf, old in self.sources.items()]
        self.sources = {leaf: old for leaf, old in kept if leaf == keys or leaf not in gone}

    def _value(self, keys: Keys) -> Any:
        source = self.sources.get(keys)
        return source.value if source is not None else None


def _history(source: Source) -> tuple[Source, ...]:
    # An empty mapping that gets its first key is filled, not hidden.
    own = () if source.value == {} else (replace(source, shadowed=()),)
    return (*source.shadowed, *own)


def trace(loader: Loader, primary: str, parsed: Sequence[Override]) -> Provenance:
    """Replay the composition that ``loader`` did last.

    Args:
        loader: a loader whose ``load`` has run.
        primary: name of the primary config.
        parsed: the overrides of that run.
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
    """Turn an override of one list element into an override of the list."""
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
        package: the key under which its options stand; empty is the top.
        selected: the options in force, in order.
        options: all there are.
        choices: every selection, in the order in which they act: each hides those before it, but ``+`` adds.
    """

    name: str
    group: str
    package: str
    selected: tuple[str, ...]
    options: tuple[str, ...]
    choices: tuple[Choice, ...]

    @property
    def several(self) -> bool:
        """Whether it takes a list of options."""
        return "@" in self.name or any(isinstance(choice.value, list) for choice in self.choices)


def find_mounts(loader: Loader, parsed: Sequence[Override]) -> list[Mount]:
    """Return the groups that a composition mounts, without Hydra's own.

    Args:
        loader: the loader that has composed it.
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
    """Tell an option that another one of its group extends, as a robot another robot or a task its parent."""
    return str(default.parent).rpartition("/")[0] == group


def _written(loader: Loader, parsed: Sequence[Override], defaults: Sequence[Any]) -> dict[str, list[Choice]]:
    """Return every selection by mount name: the files', then ``override`` from the inside out, then typed ones."""
    plain: dict[str, list[Choice]] = {}
    replacing: dict[str, list[Choice]] = {}
    loaded = loader.repository_used.loaded
    # The order of the defaults list is the one in which files act: parents first.
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
    """Return the mount whose options bring the node at ``keys``: the one with the longest package."""
    fitting = [m for m in found if m.package and keys[: len(split_path(m.package))] == split_path(m.package)]
    return max(fitting, key=lambda m: len(m.package), default=None)


def option_of(mount: Mount, keys: Keys) -> str | None:
    """Return the option's name where ``keys`` lead into a term of ``mount``, else None."""
    depth = len(split_path(mount.package))
    return dotted(keys[depth : depth + 1]) if mount.several and len(keys) > depth else None
