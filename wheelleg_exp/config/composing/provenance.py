"""Find the file or override that set each value and selected each config group of a composed config.

The source of a config value is a file and line, or an override. If several files or overrides set one value,
``Source.shadowed`` lists the earlier ones, which have no effect.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from hydra.core.override_parser.types import Override
from omegaconf._utils import split_key

from wheelleg_exp.config.composing.config_loader import LoadedFile, Loader, hydra_globals
from wheelleg_exp.config.tree_lookup import defaults_entries, leaves, line_table
from wheelleg_exp.paths import show_file
from wheelleg_exp.terms.key_syntax import Keys, dotted, split_path

MISSING = "???"


@dataclass(frozen=True)
class Source:
    """The source of one config value: a line of a file, or an override.

    ``value`` is the config value with unresolved interpolations. ``package`` is the key of the config section into
    which Hydra puts the content of ``file``. ``shadowed`` lists the sources that this source replaced, oldest first.
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
        """The file and line of a config value, or the override that set the value."""
        if self.override is not None:
            return f"override {self.override}"
        return show_file(self.file, self.line) if self.file is not None else "unknown"


class Provenance(Mapping[str, Source]):
    """The last source (file and line, or override) of each value of a config, by dotted path.

    For each config key that an override removed, ``deleted`` contains a ``Source`` that names the override.
    """

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
        """Return the sources of all config values at or below the config key ``path``."""
        keys = split_path(path)
        return [source for leaf, source in self._sources.items() if leaf[: len(keys)] == keys]

    def deleted_below(self, path: str) -> list[Source]:
        """Return a ``Source`` for each config key at or below ``path`` that an override removed."""
        keys = split_path(path)
        return [source for leaf, source in self.deleted.items() if split_path(leaf)[: len(keys)] == keys]

    def where(self, path: str) -> str | None:
        """Return the file and line, or the override, that set the config key ``path``.

        For a config section, return the source of the section's first value. For a missing key, return the source of
        the nearest existing section that would contain the key.
        """
        if path in self.deleted:
            return self.deleted[path].where
        keys = split_path(path)
        # If `env.x` is missing, return None, because the place of the whole section `env` would not help a user.
        for length in range(len(keys), min(2, len(keys)) - 1, -1):
            found = [s for leaf, s in self._sources.items() if leaf[:length] == keys[:length]]
            if found:
                return found[0].where
        return None


class _Replay:
    """Repeat the composition of a config, file by file, and store which file or override sets each value."""

    def __init__(self) -> None:
        self.sources: dict[Keys, Source] = {}
        self.deleted: dict[Keys, Source] = {}

    def write(self, keys: Keys, source: Source) -> None:
        """Record the source of a config value, and the value's earlier sources, which the new source replaces."""
        below = [leaf for leaf in self.sources if len(leaf) > len(keys) and leaf[: len(keys)] == keys]
        old_value = self.sources[keys].value if keys in self.sources else None
        if source.value == {} and (below or isinstance(old_value, dict)):
            return
        absent = isinstance(source.value, str) and source.value == MISSING and source.override is None
        if absent and (below or keys in self.sources):
            return
        above = [keys[:n] for n in range(1, len(keys)) if keys[:n] in self.sources]
        hidden = [*above, *below, *([keys] if keys in self.sources else [])]
        shadowed = tuple(entry for old in hidden for entry in _history(self.sources[old]))
        self._put(keys, replace(source, shadowed=shadowed), hidden)

    def delete(self, keys: Keys, override: str) -> None:
        """Record that an override deleted a config key and all keys below this key."""
        gone = [leaf for leaf in self.sources if leaf[: len(keys)] == keys]
        for leaf in gone:
            shadowed = _history(self.sources[leaf])
            self.deleted[leaf] = Source(dotted(leaf), None, override=override, shadowed=shadowed)
        parent = keys[:-1]
        if parent and sum(leaf[: len(parent)] == parent for leaf in self.sources) == len(gone):
            self._put(parent, Source(dotted(parent), {}, override=override), gone)
        else:
            # When a key is deleted, group the section's other keys together in ``sources``, in unchanged order.
            inside = {leaf: old for leaf, old in self.sources.items() if leaf[: len(parent)] == parent}
            before: dict[Keys, Source] = {}
            for leaf, old in self.sources.items():
                before |= inside if leaf in inside and leaf not in before else {leaf: old}
            self.sources = {leaf: old for leaf, old in before.items() if leaf not in set(gone)}

    def _put(self, keys: Keys, source: Source, hidden: Sequence[Keys]) -> None:
        """Replace the sources of the keys ``hidden`` by one source, at the first of their positions."""
        if not hidden or list(hidden) == [keys]:
            self.sources[keys] = source
            return
        gone, first = set(hidden), next(leaf for leaf in self.sources if leaf in hidden)
        entries = [(keys, source) if leaf == first else (leaf, old) for leaf, old in self.sources.items()]
        self.sources = {leaf: old for leaf, old in entries if leaf == keys or leaf not in gone}


def _history(source: Source) -> tuple[Source, ...]:
    # Omit an empty mapping from the history, because later config files only add keys to an empty mapping.
    own = () if source.value == {} else (replace(source, shadowed=()),)
    return (*source.shadowed, *own)


def trace(loader: Loader, primary: str, parsed: Sequence[Override]) -> Provenance:
    """Return the source of each config value, found by applying the config files and overrides one by one.

    Call ``trace`` only after ``loader`` has composed the config ``primary`` with the overrides ``parsed``.
    """
    replay = _Replay()
    with hydra_globals():
        defaults = loader.defaults(primary, parsed)
        loaded = loader.repository_used.loaded
        for default in defaults.defaults:
            if default.config_path in loaded:
                _write_file(replay, loaded[default.config_path], default.package or "")
        for override in defaults.config_overrides:
            text = str(override.input_line)
            keys = tuple(split_key(override.key_or_group))
            if override.is_delete():
                replay.delete(keys, text)
            else:
                keys, value = _into_list(replay, keys, override.value())
                for rest, leaf in leaves(value):
                    path = (*keys, *rest)
                    replay.write(path, Source(dotted(path), leaf, override=text))
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


def _into_list(replay: _Replay, keys: Keys, value: Any) -> tuple[Keys, Any]:
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
    """A selection of a config group's options; ``where`` names the override or the line of a file that selects them."""

    value: Any
    where: str


@dataclass(frozen=True)
class Mount:
    """A config group, such as ``reward``, and the config key, such as ``env.rewards``, that receives its options.

    ``name`` is the name of the config group in an override, such as ``reward@env.rewards``. ``package`` is the config
    key below which the group's options are; an empty key means the top of the config. ``choices`` lists all selections
    of options from the config group, in the order in which Hydra applies them. Each selection replaces the options of
    the earlier selections, but an override with ``+`` adds an option.
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


def find_mounts(loader: Loader, parsed: Sequence[Override]) -> list[Mount]:
    """Return the config groups from which a composed config selects options, except Hydra's own config groups."""
    with hydra_globals():
        return [_mount(loader, name, choices) for name, choices in _choices_by_mount(loader, parsed).items()]


def _mount(loader: Loader, name: str, choices: list[Choice]) -> Mount:
    group, _, package = name.partition("@")
    # If one task extends another, ignore the file of the extended task, because the user did not select it.
    mine = [d for d in loader.merged if _group_of(d.config_path) == group and _group_of(d.parent) != group]
    if package:
        mine = [d for d in mine if d.package == package]
    elif mine:
        package = mine[0].package or ""
    selected = tuple(str(d.config_path).rpartition("/")[2] for d in mine)
    return Mount(name, group, package, selected, tuple(loader.options(group)), tuple(choices))


def _group_of(config_path: str | None) -> str:
    return str(config_path).rpartition("/")[0]


def _choices_by_mount(loader: Loader, parsed: Sequence[Override]) -> dict[str, list[Choice]]:
    """Return the selections of each config group: plain entries of files, ``override`` entries, then overrides."""
    plain: dict[str, list[Choice]] = {}
    replacing: dict[str, list[Choice]] = {}
    loaded = loader.repository_used.loaded
    # Hydra applies config files in the order of the defaults list, parents before their children.
    for path in dict.fromkeys(str(default.config_path) for default in loader.merged):
        for name, choice, override in _in_file(path, loaded[path].file) if path in loaded else ():
            (replacing if override else plain).setdefault(name, []).append(choice)
    found = {name: [*plain.get(name, []), *replacing.get(name, [])] for name in {**plain, **replacing}}
    for override in parsed:
        name = override.get_key_element().lstrip("+~")
        if name in found or loader.repository_used.group_exists(override.key_or_group):
            found.setdefault(name, []).append(Choice(override.value(), f"override {override.input_line}"))
    return {name: choices for name, choices in found.items() if not name.startswith("hydra/")}


def _in_file(config_path: str, file: Path) -> Iterator[tuple[str, Choice, bool]]:
    folder = config_path.rpartition("/")[0]
    for entry in defaults_entries(file):
        group, at, package = entry.key.partition("@")
        absolute = group.lstrip("/") if group.startswith("/") or not folder else f"{folder}/{group}"
        yield f"{absolute}{at}{package}", Choice(entry.value, show_file(file, entry.line)), entry.override


def mount_of(found: list[Mount], keys: Keys) -> Mount | None:
    """Return the config group that can set a key, such as ``reward@env.rewards`` for ``env.rewards.alive``."""
    fitting = [m for m in found if m.package and keys[: len(split_path(m.package))] == split_path(m.package)]
    return max(fitting, key=lambda m: len(m.package), default=None)


def option_of(mount: Mount, keys: Keys) -> str | None:
    """Return the name of the term in a config key, such as ``alive`` in ``env.rewards.alive.weight``, or None."""
    depth = len(split_path(mount.package))
    return dotted(keys[depth : depth + 1]) if mount.several and len(keys) > depth else None
