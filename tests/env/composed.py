"""Configs that many tests ask for, composed once in a process."""

from __future__ import annotations

import copy
from functools import lru_cache

from wheelleg_exp.config.composing.compose import Composed, compose

_once = lru_cache(maxsize=128)(lambda words: compose(list(words)))


def composed(*words: str) -> Composed:
    """Return what the words compose to, of the caller's own."""
    return copy.deepcopy(_once(words))
