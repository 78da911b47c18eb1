"""What a term changes although it is not its own state: noticed, and named.

A function's and a class's attributes are shared by all who use them, and nobody saves them; nor what a term writes into
the scene, the managers or the config. Variables of modules and what closures hold cannot be seen.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator, Mapping
from typing import Any

from wheelleg_exp.errors import ConfigError
from wheelleg_exp.state.values import NOTHING, Kept, Unsaveable, look, same

_PLAIN = (bool, int, float, str, type(None))


class Outside:
    """Notes the surroundings of terms when they are made.

    Args:
        code: the function or class of each term, by config key.
        owners: objects that terms may ask, and not write to, by name.
        config: the config that the terms were made from.

    Raises:
        ConfigError: a class keeps an iterator, whose place nobody can see.
    """

    def __init__(self, code: Mapping[str, Callable[..., Any]], owners: Mapping[str, Any], config: Any) -> None:
        self._code, self._owners, self._config = code, owners, config
        self._before = dict(self._seen())

    def require_unchanged(self) -> None:
        """Raise ConfigError when something has changed, with its name."""
        now = dict(self._seen())
        for place in {**self._before, **now}:
            if not same(self._before.get(place, NOTHING), now.get(place, NOTHING)):
                key, name = place
                raise ConfigError(
                    f"a term has changed {name}, which is no term's own state and is saved nowhere",
                    key=key,
                    expected="a class term that keeps it on self",
                )

    def _seen(self) -> Iterator[tuple[tuple[str, str], Any]]:
        for key, code in self._code.items():
            for owner, name, item in _code_attributes(code, key):
                yield (key, f"the attribute '{name}' of '{owner}'"), _looked(item, name)
        for key, value in self._owners.items():
            for name, item in vars(value).items():
                public = isinstance(item, _PLAIN) and not name.startswith("_")
                yield (key, f"the attribute '{name}'"), item if public else "there"
        yield from _leaves(self._config, "env")


def _code_attributes(code: Callable[..., Any], key: str) -> Iterator[tuple[str, str, Any]]:
    """Yield the attributes of a function, or of a class and its bases, that could be state."""
    if not inspect.isclass(code):
        yield from ((getattr(code, "__qualname__", "?"), name, item) for name, item in vars(code).items())
        return
    for owner in code.__mro__:
        for name, item in list(vars(owner).items()):
            described = hasattr(item, "__get__") or isinstance(item, Kept)
            if name.startswith(("__", "_abc_")) or described:
                continue
            if hasattr(item, "__next__"):
                raise ConfigError(
                    f"'{owner.__qualname__}' keeps a {type(item).__name__} in its class attribute '{name}', "
                    "whose state cannot be saved",
                    key=key,
                    expected=f"a number in self.{name}, made in __init__",
                )
            yield owner.__qualname__, name, item


def _looked(item: Any, name: str) -> Any:
    try:
        return look(item, name)
    except (Unsaveable, RecursionError):
        return "there"


def _leaves(tree: Any, path: str) -> Iterator[tuple[tuple[str, str], Any]]:
    """Yield the leaves of a config by their keys."""
    if isinstance(tree, Mapping):
        for name, item in tree.items():
            yield from _leaves(item, f"{path}.{name}")
    elif isinstance(tree, (list, tuple)):
        for index, item in enumerate(tree):
            yield from _leaves(item, f"{path}[{index}]")
    else:
        yield (path, "the config"), tree
