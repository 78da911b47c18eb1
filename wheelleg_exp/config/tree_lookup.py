"""Look up nodes of a config tree, and the line of each key of a YAML file."""

from __future__ import annotations

import errno
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import yaml

from wheelleg_exp.plain_data import yaml_tree
from wheelleg_exp.terms.key_syntax import Keys, split_path


def file_text(file: Path) -> str:
    """Return the text of a UTF-8 file; raise FileNotFoundError for a pipe, because reading it could wait forever."""
    if not file.is_file():
        raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), str(file))
    return file.read_text(encoding="utf-8")


def leaves(node: object, prefix: Keys = ()) -> Iterator[tuple[Keys, object]]:
    """Yield the key path and value of each leaf (scalar, list, or empty mapping) of a config tree."""
    if isinstance(node, Mapping) and node:
        for key, value in node.items():
            yield from leaves(value, (*prefix, str(key)))
    else:
        yield prefix, node


def node_paths(node: object, prefix: Keys = ()) -> Iterator[Keys]:
    """Yield the path of each key below a config node, such as ``("sim",)`` and ``("sim", "dt")`` below ``env``."""
    if isinstance(node, Mapping):
        for key, value in node.items():
            path = (*prefix, str(key))
            yield path
            yield from node_paths(value, path)


def at(tree: object, keys: Keys | str) -> object:
    """Return the config node at a key path, which can contain list indices; None if the node does not exist."""
    for key in split_path(keys) if isinstance(keys, str) else keys:
        if isinstance(tree, Mapping):
            tree = tree.get(key)
        elif isinstance(tree, Sequence) and not isinstance(tree, str) and key.isdigit() and int(key) < len(tree):
            tree = tree[int(key)]
        else:
            return None
    return tree


def section_at(tree: object, keys: Keys | str) -> Mapping[str, object]:
    """Return the mapping at a key path of a config tree, or an empty mapping if the tree lacks it."""
    node = at(tree, keys)
    return node if isinstance(node, Mapping) else {}


def select(node: object, path: str) -> object:
    """Return the config node at a dotted path; raise KeyError if the node does not exist."""
    for key in split_path(path):
        named = {str(name): child for name, child in node.items()} if isinstance(node, Mapping) else {}
        if key not in named:
            raise KeyError(path)
        node = named[key]
    return node


def yaml_node(file: Path) -> yaml.Node | None:
    """Return the tree of a file's YAML nodes, which contain the line of each key and value."""
    return _yaml_node(file, file.stat().st_mtime_ns)


@lru_cache(maxsize=1024)
def _yaml_node(file: Path, _modified_ns: int) -> yaml.Node | None:
    return yaml_tree(file.read_bytes())


def line_table(file: Path) -> dict[Keys, int]:
    """Return the line, counted from 1, of each key of a YAML file."""
    table: dict[Keys, int] = {}
    _collect_lines(yaml_node(file), (), table)
    return table


def _collect_lines(node: yaml.Node | None, prefix: Keys, table: dict[Keys, int]) -> None:
    if not isinstance(node, yaml.MappingNode):
        return
    for key, value in node.value:
        if key.tag == "tag:yaml.org,2002:merge":
            merged = value.value if isinstance(value, yaml.SequenceNode) else [value]
            for source in merged:
                _collect_lines(source, prefix, table)
            continue
        path = (*prefix, str(key.value))
        table.setdefault(path, key.start_mark.line + 1)
        _collect_lines(value, path, table)


def scalar_line(file: Path, *texts: str) -> int | None:
    """Return the line of the first key or value in a YAML file that equals one of ``texts``."""
    return next((node.start_mark.line + 1 for node in _scalars(yaml_node(file)) if node.value in texts), None)


def _scalars(node: object) -> Iterator[yaml.ScalarNode]:
    if isinstance(node, yaml.ScalarNode):
        yield node
    elif isinstance(node, yaml.CollectionNode):
        for child in node.value:
            for part in child if isinstance(child, tuple) else (child,):
                yield from _scalars(part)


@dataclass(frozen=True)
class DefaultsEntry:
    """One ``key: value`` of a file's defaults list, such as ``override /reward@env.rewards: [alive]``."""

    key: str  # ``key`` names a config group, such as ``/reward@env.rewards``, without the word `override`.
    value: object
    override: bool
    optional: bool
    line: int


def defaults_items(file: Path) -> list[yaml.Node]:
    """Return the YAML nodes of a config file's defaults list; empty if the file has no defaults list."""
    root = yaml_node(file)
    pairs = root.value if isinstance(root, yaml.MappingNode) else []
    return [item for key, value in pairs if key.value == "defaults" for item in value.value]


def defaults_entries(file: Path) -> list[DefaultsEntry]:
    """Return the entries of a config file's defaults list that name a config group."""
    found = []
    for item in defaults_items(file):
        for key, value in item.value if isinstance(item, yaml.MappingNode) else ():
            *flags, name = str(key.value).split()
            chosen = [str(n.value) for n in value.value] if isinstance(value, yaml.SequenceNode) else value.value
            line = key.start_mark.line + 1
            found.append(DefaultsEntry(name, chosen, "override" in flags, "optional" in flags, line))
    return found


def self_before_others(file: Path) -> bool:
    """Return whether a file's defaults list has entries after ``_self_``, which overwrite the file's own values."""
    items = defaults_items(file)
    names = [str(item.value) for item in items if isinstance(item, yaml.ScalarNode)]
    return "_self_" in names and not (isinstance(items[-1], yaml.ScalarNode) and items[-1].value == "_self_")
