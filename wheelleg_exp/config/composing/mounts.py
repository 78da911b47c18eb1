"""Which groups stand where in a composed config: what each one selects, who selected it, what else it offers."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hydra.core.override_parser.types import Override

from wheelleg_exp.config.composing.loader import Loader, hydra_globals
from wheelleg_exp.config.tree import Keys, defaults_entries, dotted, show_file, split_path


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
