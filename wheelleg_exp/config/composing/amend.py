"""Overrides on a config that is composed already: the parameters that a run kept."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override

from wheelleg_exp.config.checking.diagnose import nearest_path, unreadable
from wheelleg_exp.config.composing.hydra_keys import unread
from wheelleg_exp.config.problems import join, parts, raise_all
from wheelleg_exp.config.tree import dotted, node_paths, split_path
from wheelleg_exp.errors import ConfigError, UnreadKey
from wheelleg_exp.terms.binding import drop_removed

_OTHER = "another value"


def amend(tree: Mapping[str, Any], overrides: Sequence[str]) -> dict[str, Any]:
    """Return a copy of ``tree`` with overrides applied: ``key=value``, ``+key=value``, ``++key=value``, ``~key``.

    Groups cannot be chosen here, because nothing is composed. A term that is null is removed, as by composing.

    Raises:
        ConfigError: an override cannot be read, names a key that is not there, or is of Hydra's own settings.
    """
    amended = copy.deepcopy(dict(tree))
    for text in overrides:
        _apply(amended, _parse(text), text)
    if overrides:  # what nobody changes stays as it was recorded
        drop_removed(amended)
    return amended


def require_read(
    kept: Mapping[str, Any],
    overrides: Sequence[str],
    read: Callable[[Mapping[str, Any]], Any],
    instead: Mapping[str, str],
) -> None:
    """Raise ConfigError, with every key, for overrides that nothing reads.

    An override is read if its value, or any other value of its key, changes what ``read`` returns. Thus an override
    that repeats the present value is no mistake.

    Args:
        kept: the tree before the overrides.
        overrides: the overrides, each of which ``amend`` accepts.
        read: returns what of a tree is read, comparable with ``==``.
        instead: what to write in place of a key or of those below it, by key; ``""`` for all others.
    """
    errors: list[ConfigError] = []
    tree: Mapping[str, Any] = kept
    for text in overrides:
        keys, after = split_path(_parse(text).key_or_group), amend(tree, [text])
        other = amend(after, [])
        parent = _parent(other, keys, text)
        old = parent.get(keys[-1], _OTHER)
        parent[keys[-1]] = {**(old or {}), _OTHER: None} if old is None or isinstance(old, Mapping) else _OTHER
        if read(after) == read(tree) == read(other):
            key = dotted(keys)
            expected = next(what for name, what in instead.items() if not name or f"{key}.".startswith(f"{name}."))
            errors.append(UnreadKey("this command ignores it", key=key, where=f"override {text}", expected=expected))
        tree = after
    if errors:
        raise_all(errors)


@contextmanager
def placing(overrides: Sequence[str]) -> Iterator[None]:
    """Give mistakes that leave the body, and have no place, the override that their key comes from."""
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
        raise unread(dotted(keys), f"override {text}", "a key of the run's parameters")
    parent = _parent(tree, keys, text)
    if override.is_delete():
        _require_there(tree, parent, keys, text)
        del parent[keys[-1]]
        return
    if not override.is_add() and not override.is_force_add():
        _require_there(tree, parent, keys, text)
    parent[keys[-1]] = override.value()


def _parent(tree: dict[str, Any], keys: Sequence[str], text: str) -> dict[str, Any]:
    node = tree
    for depth, key in enumerate(keys[:-1], start=1):
        if not isinstance(node.get(key), dict):
            raise _unknown(tree, keys[:depth], text)
        node = node[key]
    return node


def _require_there(tree: dict[str, Any], parent: dict[str, Any], keys: Sequence[str], text: str) -> None:
    if keys[-1] not in parent:
        raise _unknown(tree, keys, text)


def _unknown(tree: dict[str, Any], keys: Sequence[str], text: str) -> ConfigError:
    known = [dotted(path) for path in node_paths(tree)]
    name = dotted(keys)
    return ConfigError(
        "there is no such key in the run's parameters",
        key=name,
        where=f"override {text}",
        expected="a key that is there; a config group is chosen when a run begins",
        nearest=nearest_path(name, known),
    )
