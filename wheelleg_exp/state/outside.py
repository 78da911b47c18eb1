"""What a term changes although it is not its own state: noticed, and named.

No checkpoint saves the attributes and the default arguments of functions and classes, nor what a term writes into
the scene, the managers or the config. Module variables and closures are not checked.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import torch

from wheelleg_exp.errors import ConfigError
from wheelleg_exp.state.saved_or_refused import Stateful
from wheelleg_exp.state.values import NOTHING, Kept, Unsaveable, look, same

_PLAIN = (bool, int, float, str, type(None))
_PACKAGE = __name__.partition(".")[0]


class Outside:
    """Notes the surroundings of terms when they are made.

    Args:
        code: the function or class of each term, by config key.
        owners: objects that terms may read but not write, by name. Attributes are not allowed to appear on them or on
            this package's objects below them; their own public numbers and texts are not allowed to change.
        config: the config that the terms were made from.

    Raises:
        ConfigError: a class attribute or a default argument is an iterator, whose position cannot be read.
    """

    def __init__(self, code: Mapping[str, Callable[..., Any]], owners: Mapping[str, Any], config: Any) -> None:
        self._code, self._config, self._own = code, config, frozenset(owners)
        self._parts = dict(_parts(owners))
        self._before = dict(self._seen())

    def require_unchanged(self) -> None:
        """Raise ConfigError when something has changed, with its name."""
        now = dict(self._seen())
        for place in {**self._before, **now}:
            was, item = self._before.get(place, NOTHING), now.get(place, NOTHING)
            if was is not item and not same(was, item):
                key, name = place
                raise ConfigError(
                    f"a term has changed {name}, which no checkpoint saves",
                    key=key,
                    expected="a class term that stores it on self",
                )

    def _seen(self) -> Iterator[tuple[tuple[str, str], Any]]:
        for key, code in self._code.items():
            for name, item in _code_values(code):
                if hasattr(item, "__next__"):
                    raise ConfigError(
                        f"{name} is a {type(item).__name__}, whose state cannot be saved",
                        key=key,
                        expected="a class term with a number on self, set in __init__",
                    )
                yield (key, name), _looked(item, name)
        for key, value in self._parts.items():
            own = key in self._own
            for name, item in vars(value).items():
                if own and isinstance(item, _PLAIN) and not name.startswith("_"):
                    yield (key, f"the attribute '{name}'"), item
                elif not _is_default(value, name):
                    yield (
                        (key, f"the attribute '{name}'"),
                        (isinstance(item, torch.Tensor) and {**vars(item)}) or "there",
                    )
        yield from _leaves(self._config, "env")


def _parts(owners: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    """Yield owners, and the objects of this package in their public attributes that do not save themselves, by name."""
    waiting, seen = list(owners.items()), {id(value) for value in owners.values()}
    yield from waiting
    for key, value in waiting:  # which grows
        for name, item in vars(value).items():
            is_ours = type(item).__module__.partition(".")[0] == _PACKAGE and hasattr(item, "__dict__")
            is_public = not name.startswith("_") and not _is_default(value, name)
            if is_ours and is_public and not isinstance(item, Stateful) and id(item) not in seen:
                seen.add(id(item))
                waiting.append((f"{key}.{name}", item))
                yield waiting[-1]


def _is_default(value: Any, name: str) -> bool:
    """Return whether an attribute overrides a number or None of its class, such as a dataclass has."""
    return isinstance(getattr(type(value), name, NOTHING), _PLAIN)


def _code_values(code: Callable[..., Any]) -> Iterator[tuple[str, Any]]:
    """Yield attributes and default arguments of a function, or of a class and its bases, that could be state."""
    if not inspect.isclass(code):
        function: Any = code
        while function is not None:
            owner = getattr(function, "__qualname__", "?")
            yield from ((f"the attribute '{name}' of '{owner}'", item) for name, item in vars(function).items())
            yield from _defaults(function)
            function = getattr(function, "__wrapped__", None)
        return
    for owner in code.__mro__:
        for name, item in list(vars(owner).items()):
            if hasattr(item, "__get__"):
                if name != "__init__":  # what __init__ stores on self is saved there
                    yield from _defaults(getattr(item, "__func__", item))
            elif not name.startswith(("__", "_abc_")) and not isinstance(item, Kept):
                yield f"the attribute '{name}' of '{owner.__qualname__}'", item


def _defaults(function: Any) -> Iterator[tuple[str, Any]]:
    """Yield the default arguments of a function that can be changed in place."""
    if not inspect.isfunction(function):
        return
    count, given = function.__code__.co_argcount, function.__defaults__ or ()
    names = function.__code__.co_varnames[count - len(given) : count]
    for name, item in (*zip(names, given, strict=True), *(function.__kwdefaults__ or {}).items()):
        if not isinstance(item, _PLAIN):
            yield f"the default argument '{name}' of '{function.__qualname__}'", item


def _looked(item: Any, name: str) -> Any:
    try:
        return look(item, name)
    except (Unsaveable, RecursionError):
        return {n: part if isinstance(part, _PLAIN) else "there" for n, part in getattr(item, "__dict__", {}).items()}


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
