"""Attributes of classes, which every object shares: nobody saves them as state, so they may not change."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

from wheelleg_exp.errors import ConfigError
from wheelleg_exp.sim.state_values import NOTHING, Kept, Unsaveable, look, same

_class_values: dict[tuple[type, str], Any] = {}
_noted: set[type] = set()


def require_class_untouched(kind: type, key: str | None) -> None:
    """Refuse state in a class itself, which every object of the class shares.

    Raises:
        ConfigError: an attribute of the class has changed since it was noted.
    """
    for (owner, name), item in _class_attributes(kind):
        if not same(_look_safely(item, name), _class_values.get((owner, name), NOTHING)):
            raise ConfigError(
                f"'{owner.__qualname__}' changes its class attribute '{name}', which is no object's state",
                key=key,
                expected=f"self.{name}, made in __init__",
            )


def note_class(kind: type, key: str | None = None) -> Callable[[], None]:
    """Note the values of a class's own attributes, before any object of it is made.

    Returns:
        what to call once an object is made: what making it has changed (a count of objects) is no state.

    Raises:
        ConfigError: an iterator is among them.
    """
    found = list(_class_attributes(kind))
    for (owner, name), item in found:
        if hasattr(item, "__next__"):
            raise ConfigError(
                f"'{owner.__qualname__}' keeps a {type(item).__name__} in its class attribute '{name}', "
                "whose state cannot be saved",
                key=key,
                expected=f"a number in self.{name}, made in __init__",
            )
    now = {at: _look_safely(item, at[1]) for at, item in found}
    # What a class that was noted did not have has come since: it stays unknown, and is refused when saved.
    _class_values.update({at: item for at, item in now.items() if at[0] not in _noted})
    _noted.update(kind.__mro__)
    untouched = {at for at, item in now.items() if same(_class_values.get(at, NOTHING), item)}

    def note_again() -> None:
        values = {at: _look_safely(item, at[1]) for at, item in _class_attributes(kind)}
        _class_values.update({at: item for at, item in values.items() if at in untouched or at not in now})

    return note_again


def is_noted(kind: type) -> bool:
    """Return whether ``note_class`` has seen a class."""
    return kind in _noted


def _class_attributes(kind: type) -> Iterator[tuple[tuple[type, str], Any]]:
    """Yield the attributes of a class and its bases that could be state: no methods, properties and the like."""
    for owner in kind.__mro__:
        for name, item in list(vars(owner).items()):
            described = hasattr(item, "__get__") or isinstance(item, Kept)
            if not (name.startswith(("__", "_abc_")) or described):
                yield (owner, name), item


def _look_safely(item: Any, name: str) -> Any:
    try:
        return look(item, name)
    except Unsaveable:
        return None
