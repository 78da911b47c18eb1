"""Overrides on a config that is composed already: the parameters that a run kept."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.errors import HydraException

from wheelleg_exp.config.diagnose import nearest_path
from wheelleg_exp.config.tree import dotted, node_paths, split_path
from wheelleg_exp.errors import ConfigError


def amend(tree: Mapping[str, Any], overrides: Sequence[str]) -> dict[str, Any]:
    """Return a copy of ``tree`` with overrides applied: ``key=value``, ``+key=value``, ``++key=value``, ``~key``.

    Groups cannot be chosen here, because nothing is composed.

    Raises:
        ConfigError: an override cannot be read, or names a key that is not there.
    """
    amended = copy.deepcopy(dict(tree))
    for text in overrides:
        _apply(amended, _parse(text), text)
    return amended


def _parse(text: str) -> Override:
    try:
        override = OverridesParser.create().parse_override(text)
    except HydraException as error:
        message = str(error).splitlines()[0]
        raise ConfigError(f"cannot read the override: {message}", key=text, expected="key=value") from error
    if override.is_sweep_override():
        raise ConfigError("a sweep is not possible here", key=text, expected="one value")
    return override


def _apply(tree: dict[str, Any], override: Override, text: str) -> None:
    keys = split_path(override.key_or_group)
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
        where=f"override '{text}'",
        expected="a key that is there; group options need a new run",
        nearest=nearest_path(name, known),
    )
