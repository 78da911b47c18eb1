"""Walk config trees, and find the line of each key of a YAML file."""

from __future__ import annotations

import errno
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import yaml

from wheelleg_exp.paths import show_file as show_file
from wheelleg_exp.plain_data import yaml_tree
from wheelleg_exp.terms.key_syntax import Keys as Keys
from wheelleg_exp.terms.key_syntax import dotted as dotted
from wheelleg_exp.terms.key_syntax import split_path as split_path


def file_text(file: Path) -> str:
    """Return the text of a config file.

    Raises:
        OSError: the file does not exist, or is not a regular file. Reading a pipe could wait forever.
        UnicodeDecodeError: the file is not UTF-8.
    """
    if not file.is_file():
        raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), str(file))
    return file.read_text(encoding="utf-8")


def leaves(node: Any, prefix: Keys = ()) -> Iterator[tuple[Keys, Any]]:
    """Yield ``(keys, value)`` of each leaf. A list or an empty mapping is one leaf."""
    if isinstance(node, Mapping) and node:
        for key, value in node.items():
            yield from leaves(value, (*prefix, str(key)))
    else:
        yield prefix, node


def node_paths(node: Any, prefix: Keys = ()) -> Iterator[Keys]:
    """Yield the path of each mapping and leaf below ``node``."""
    if isinstance(node, Mapping):
        for key, value in node.items():
            path = (*prefix, str(key))
            yield path
            yield from node_paths(value, path)


def build(entries: Mapping[Keys, Any]) -> dict[str, Any]:
    """Return the nested mapping with these leaves."""
    tree: dict[str, Any] = {}
    for keys, value in entries.items():
        node = tree
        for key in keys[:-1]:
            node = node.setdefault(key, {})
        node[keys[-1]] = value
    return tree


def at(tree: Any, keys: Keys | str) -> Any:
    """Return the node at keys or at a dotted path, which can contain list indices; None if it does not exist."""
    for key in split_path(keys) if isinstance(keys, str) else keys:
        if isinstance(tree, Mapping):
            tree = tree.get(key)
        elif isinstance(tree, Sequence) and not isinstance(tree, str) and key.isdigit() and int(key) < len(tree):
            tree = tree[int(key)]
        else:
            return None
    return tree


def section_at(tree: Any, keys: Keys | str) -> Mapping[str, Any]:
    """Return the mapping at keys; an empty one if there is no mapping."""
    node = at(tree, keys)
    return node if isinstance(node, Mapping) else {}


def select(node: Any, path: str) -> Any:
    """Return the node at ``path``; raise KeyError if it does not exist."""
    for key in split_path(path):
        if not isinstance(node, Mapping):
            raise KeyError(path)
        names = {str(k): k for k in node}
        if key not in names:
            raise KeyError(path)
        node = node[names[key]]
    return node


@lru_cache(maxsize=1024)
def _yaml_node(file: Path, _stamp: int) -> yaml.Node | None:
    return yaml_tree(file.read_bytes())


def yaml_node(file: Path) -> yaml.Node | None:
    """Return the file's tree of YAML nodes, with the line of each node."""
    return _yaml_node(file, file.stat().st_mtime_ns)


def line_table(file: Path) -> dict[Keys, int]:
    """Return the line (from 1) of each key of the file."""
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
    """Return the line of the first key or value in the file that is one of ``texts``."""
    return _scalar_line(yaml_node(file), texts)


def _scalar_line(node: yaml.Node | None, texts: tuple[str, ...]) -> int | None:
    if isinstance(node, yaml.ScalarNode):
        return node.start_mark.line + 1 if node.value in texts else None
    if isinstance(node, yaml.MappingNode):
        children = [child for pair in node.value for child in pair]
    elif isinstance(node, yaml.SequenceNode):
        children = list(node.value)
    else:
        children = []
    for child in children:
        line = _scalar_line(child, texts)
        if line is not None:
            return line
    return None


@dataclass(frozen=True)
class DefaultsEntry:
    """One ``key: value`` of a file's defaults list.

    Attributes:
        key: the group as written, without ``override`` and ``optional``, such as ``/reward@env.rewards``.
        value: the selected option or options.
        override: whether the entry replaces the selection of another file.
        line: the line of the entry, from 1.
    """

    key: str
    value: Any
    override: bool
    line: int


def defaults_items(file: Path) -> list[yaml.Node]:
    """Return the nodes of a file's defaults list; empty if the file has none."""
    root = yaml_node(file)
    pairs = root.value if isinstance(root, yaml.MappingNode) else []
    return [item for key, value in pairs if key.value == "defaults" for item in value.value]


def defaults_entries(file: Path) -> list[DefaultsEntry]:
    """Return the entries of a file's defaults list that name a group."""
    items = defaults_items(file)
    return [_entry(*pair) for item in items if isinstance(item, yaml.MappingNode) for pair in item.value]


def self_before_others(file: Path) -> bool:
    """Return whether ``_self_`` comes before other entries of a file's defaults list, which then overwrite its body."""
    items = defaults_items(file)
    names = [str(item.value) for item in items if isinstance(item, yaml.ScalarNode)]
    return "_self_" in names and not (isinstance(items[-1], yaml.ScalarNode) and items[-1].value == "_self_")


def _entry(key: yaml.Node, value: yaml.Node) -> DefaultsEntry:
    words = str(key.value).split()
    chosen = [str(n.value) for n in value.value] if isinstance(value, yaml.SequenceNode) else value.value
    return DefaultsEntry(words[-1], chosen, "override" in words[:-1], key.start_mark.line + 1)
