"""Rows in time of what recorders note, for all environments at once, from which each episode's own are cut."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import torch

from wheelleg_exp.errors import ConfigError
from wheelleg_exp.terms.term_errors import code_place, described

_FIRST_ROOM = 64


class Rows:
    """One quantity: a row (N, …) each time that it is noted; old rows go once no episode under way needs them.

    Args:
        num_envs: number of environments, N.
    """

    def __init__(self, num_envs: int) -> None:
        self._num_envs = num_envs
        self._rows = np.empty((0,))
        self._count = 0
        self._starts = np.zeros(num_envs, dtype=np.int64)

    def append(self, value: np.ndarray, owner: str) -> None:
        """Note ``value`` (N, …); ``owner`` is the config key of who does.

        Raises:
            ConfigError: it had another shape before.
        """
        if self._count and value.shape != self._rows.shape[1:]:
            message = f"its shape is {value.shape}, and was {self._rows.shape[1:]}"
            raise ConfigError(message, key=owner, expected="the same shape at every call")
        if self._count == len(self._rows):
            self._make_room(value)
        self._rows[self._count] = value
        self._count += 1

    def set(self, ids: np.ndarray, value: np.ndarray) -> None:
        """Note ``value`` (n, …) of some environments alone, as the only row of their episode; the others' is zero."""
        self._count = 0
        if not len(self._rows):
            self._make_room(np.zeros((self._num_envs, *value.shape[1:]), value.dtype))
            self._rows[0] = 0
        self._rows[0, ids] = value
        self._count = 1
        self._starts[:] = 0

    def of(self, env_id: int) -> np.ndarray:
        """Return the rows (T, …) of the present episode of an environment."""
        return self._rows[self._starts[env_id] : self._count, env_id]

    def begin(self, ids: np.ndarray) -> None:
        """Begin new episodes: what was noted before is not theirs."""
        self._starts[ids] = self._count

    def _make_room(self, value: np.ndarray) -> None:
        first = int(self._starts.min())
        kept = self._rows[first : self._count]
        grown = np.empty((max(_FIRST_ROOM, 2 * len(kept)), *value.shape), value.dtype)
        grown[: len(kept)] = kept if len(kept) else 0
        self._rows, self._count = grown, self._count - first
        self._starts -= first


def noted(returned: Any, rows: int, source: str, code: Any) -> Iterator[tuple[str, np.ndarray]]:
    """Yield the arrays (rows, …) that a hook returned, by key; those of mappings within it by ``key/name``.

    Args:
        returned: a key and a tensor or a mapping; or None and None.
        rows: how many rows there have to be.
        source: the hook, in words.
        code: the hook.

    Raises:
        ConfigError: it returned something else.
    """
    found = described(returned)
    if isinstance(returned, tuple) and len(returned) == 2:
        arrays = {} if returned[1] is None else dict(_flat(*returned))
        wrong = next((item for item in arrays.items() if not _is_noted(*item, rows)), None)
        if wrong is None:
            yield from ((key, value.detach().cpu().numpy()) for key, value in arrays.items())
            return
        found = " and ".join(map(described, wrong))
    expected = f"a key, and a tensor of shape ({rows}, ...) or such tensors by name; or None, None"
    raise ConfigError(f"{source} returns {found}", where=code_place(code), expected=expected)


def _is_noted(key: Any, value: Any, rows: int) -> bool:
    return isinstance(key, str) and isinstance(value, torch.Tensor) and value.shape[:1] == (rows,)


def _flat(key: Any, value: Any) -> Iterator[tuple[str, Any]]:
    if not isinstance(value, Mapping):
        yield key, value
        return
    for name, item in value.items():
        yield from _flat(f"{key}/{name}", item)
