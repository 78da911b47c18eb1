"""Compose configs for tests, each distinct config once per process."""

from __future__ import annotations

import copy
from dataclasses import replace
from functools import lru_cache
from typing import Any

from wheelleg_exp.config.composing.compose import Composed, compose

_once = lru_cache(maxsize=128)(lambda words: compose(list(words)))


def composed(*words: str) -> Composed:
    """Return the composed config with a new copy of the tree ``config``."""
    return replace(_once(words), config=copy.deepcopy(_once(words).config))


def term(path: str, **fields: Any) -> dict[str, Any]:
    """Return the config node of a stock term, such as ``events.push_by_adding_velocity``."""
    return {"_target_": f"wheelleg_exp.mdp.{path}", **fields}


def event(name: str, mode: str, **fields: Any) -> dict[str, Any]:
    return term(f"events.{name}", mode=mode, **fields)
