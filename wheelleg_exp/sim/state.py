"""State that an object keeps between steps, found and saved without its author's help.

Tensors among an object's attributes are its state and are always saved, but for those that the class names in
``settings``. Every other attribute (numbers, text, lists, dictionaries, arrays, random generators, helper objects and
what they hold) is saved once it differs from what it was when the object was made, so that loading does not undo a
setting that was changed in the config since. What cannot be saved is refused when the object is made, or when it
appears later, when the state is saved.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Mapping
from typing import Any, ClassVar

import numpy as np
import torch

from wheelleg_exp.errors import ConfigError
from wheelleg_exp.sim.state_values import (
    BASE,
    CONSTANTS,
    NOTHING,
    TAG,
    Inside,
    Kept,
    NamedStream,
    Unsaveable,
    attributes,
    look,
    made_again,
    require_plain,
    same,
    slots_of,
)

__all__ = [
    "Kept",
    "NamedStream",
    "Settings",
    "Stateful",
    "cloned",
    "made",
    "note_class",
    "restore",
    "same",
    "save",
    "stateful",
]


class Stateful:
    """An object that saves and restores its attributes (see the module).

    Attributes:
        settings: names of tensor attributes that come from the config, and are saved only when they have changed.
    """

    settings: ClassVar[tuple[str, ...]] = ()

    def state_dict(self) -> dict[str, Any]:
        """Return what the coming steps depend on."""
        return save(self)

    def load_state_dict(self, saved: Mapping[str, Any]) -> None:
        """Restore what ``state_dict`` returned, in an object that was made alike."""
        restore(self, saved)


def made(value: Any, key: str | None = None) -> None:
    """Note what an object holds now as what it was made with.

    Raises:
        ConfigError: it keeps something whose state cannot be saved.
    """
    vars(value).pop(BASE, None)
    try:
        vars(value)[BASE] = _without_tensors(attributes(value), getattr(value, "settings", ()))
    except Unsaveable as error:
        raise _refusal(value, error, key) from error


def _without_tensors(base: Inside, settings: Collection[str] = ()) -> Inside:
    """Leave out what is saved whether it has changed or not."""
    kept = {n: item for n, item in base.items() if n in settings or not isinstance(item, torch.Tensor)}
    return Inside({n: _without_tensors(i) if isinstance(i, Inside) else i for n, i in kept.items()})


def save(value: Any) -> dict[str, Any]:
    """Return the state of an object as tensors and plain values.

    Raises:
        ConfigError: it now keeps something whose state cannot be saved.
    """
    _require_class_untouched(value)
    try:
        return _changes(attributes(value), vars(value).get(BASE), "", settings=getattr(value, "settings", ()))
    except Unsaveable as error:
        raise _refusal(value, error, None) from error


def restore(value: Any, saved: Mapping[str, Any]) -> None:
    """Give an object the state that ``save`` returned; what was not saved goes back to what it was made with."""
    base = vars(value).get(BASE)
    if base is not None:
        _restore_made(value, base, saved)
    for name, item in saved.items():
        _set(value, name, item, base)


class _Stateless:
    """Stands for what has no state."""

    def state_dict(self) -> dict[str, Any]:
        """Return nothing."""
        return {}

    def load_state_dict(self, saved: Mapping[str, Any]) -> None:
        """Do nothing."""


class _ByAttributes(_Stateless):
    """Saves the attributes of an object that has no ``state_dict``."""

    def __init__(self, value: Any, key: str) -> None:
        self._value = value
        made(value, key)

    def state_dict(self) -> dict[str, Any]:
        return save(self._value)

    def load_state_dict(self, saved: Mapping[str, Any]) -> None:
        restore(self._value, saved)


def stateful(value: Any, key: str) -> Any:
    """Return what saves and restores ``value``: itself when it can, else its attributes; nothing for a function.

    Raises:
        ConfigError: it keeps something whose state cannot be saved.
    """
    if hasattr(value, "state_dict") and hasattr(value, "load_state_dict"):
        return value
    if value is None or isinstance(value, CONSTANTS) or not hasattr(value, "__dict__"):
        return _Stateless()
    return _ByAttributes(value, key)


def cloned(tree: Any) -> Any:
    """Return a copy of mappings, lists and tuples of tensors that stands still."""
    if isinstance(tree, torch.Tensor):
        return tree.detach().clone()
    if isinstance(tree, Mapping):
        return {key: cloned(value) for key, value in tree.items()}
    if isinstance(tree, (list, tuple)):
        return type(tree)(cloned(value) for value in tree)
    return tree


def _refusal(value: Any, error: Unsaveable, key: str | None) -> ConfigError:
    return ConfigError(
        f"'{type(value).__qualname__}' {error}, whose state cannot be saved, so that a resumed run would differ",
        key=key,
        expected="tensors, arrays, numbers, text, lists, dictionaries, or state_dict and load_state_dict of its own",
    )


class Settings:
    """The settings of a term, as its config gave them: what differs from them is state, set by a curriculum perhaps.

    A change is saved beside the setting that it was made on, and is not restored on another: who changed the
    setting in the config means it.

    Args:
        groups: dictionaries of settings by name.
        key: config key of the term, for messages.
        skip: names of settings that save their state themselves.
    """

    def __init__(self, groups: Mapping[str, dict[str, Any]], key: str, skip: Collection[str] = ()) -> None:
        self._groups = dict(groups)
        self._key = key
        self._skip = frozenset(skip)
        self._base = self._look()

    def _look(self) -> dict[str, Inside]:
        try:
            return {
                group: Inside({n: look(v, n) for n, v in values.items() if n not in self._skip})
                for group, values in self._groups.items()
            }
        except Unsaveable as error:
            raise ConfigError(f"a setting {error}, whose state cannot be saved", key=self._key) from error

    def state_dict(self) -> dict[str, Any]:
        """Return the changed settings by group and name, each with what it was."""
        found: dict[str, Any] = {}
        for group, values in self._look().items():
            for name, now in values.items():
                was = self._base[group].get(name, NOTHING)
                if not same(now, was):
                    found.setdefault(group, {})[name] = self._change(name, was, now)
        return found

    def _change(self, name: str, was: Any, now: Any) -> dict[str, Any]:
        change = {"was": None if was is NOTHING else was, "now": now}
        try:
            for item in change.values():
                require_plain(item, name)
        except Unsaveable as error:
            raise ConfigError(f"the changed setting {error}, which cannot be saved", key=self._key) from error
        return change

    def load_state_dict(self, saved: Mapping[str, Any]) -> None:
        """Restore what ``state_dict`` returned; settings that had not changed are what the config says."""
        for group, values in self._groups.items():
            changes, base = saved.get(group, {}), self._base[group]
            for name in list(values.keys() - base.keys() - changes.keys() - self._skip):
                del values[name]
            for name in [*base, *(n for n in changes if n not in base)]:
                change = changes.get(name)
                own = base.get(name)
                wanted = change["now"] if change is not None and same(change["was"], own) else own
                if not isinstance(wanted, Inside) and not same(look(values.get(name), name), wanted):
                    values[name] = made_again(wanted, None)


# --- comparing ---


def _changes(
    now: Inside, base: Mapping[str, Any] | None, path: str, *, settings: Collection[str] = ()
) -> dict[str, Any]:
    """Return tensors, and whatever else differs from ``base`` (tensors alone when that was never noted)."""
    if base is None:
        return {n: item for n, item in now.items() if isinstance(item, torch.Tensor) and n not in settings}
    found: dict[str, Any] = {}
    for name, item in now.items():
        if isinstance(item, Inside) and isinstance(base.get(name), Inside):
            inner = _changes(item, base[name], f"{path}{name}.")
            found.update({name: {TAG: "object", "data": inner}} if inner else {})
        elif (isinstance(item, torch.Tensor) and name not in settings) or not same(item, base.get(name, NOTHING)):
            require_plain(item, path + name)
            found[name] = item
    return found


def _require_class_untouched(value: Any) -> None:
    """Refuse state in the class itself, which every object of the class shares."""
    base = vars(value).get(BASE)
    for kind in type(value).__mro__ if base is not None else ():
        for name, item in vars(kind).items():
            if isinstance(item, (list, dict, set, deque, torch.Tensor, np.ndarray)) and not name.startswith("__"):
                before = _class_values.setdefault((kind, name), _look_safely(item, name))
                if not same(_look_safely(item, name), before):
                    raise ConfigError(
                        f"'{kind.__qualname__}' changes its class attribute '{name}', which is no object's state",
                        expected=f"self.{name}, made in __init__",
                    )


_class_values: dict[tuple[type, str], Any] = {}


def note_class(kind: type) -> None:
    """Note the values of a class's own containers, before any object of it has run."""
    for base in kind.__mro__:
        for name, item in vars(base).items():
            if isinstance(item, (list, dict, set, deque, torch.Tensor, np.ndarray)) and not name.startswith("__"):
                _class_values.setdefault((base, name), _look_safely(item, name))


def _look_safely(item: Any, name: str) -> Any:
    try:
        return look(item, name)
    except Unsaveable:
        return None


# --- restoring ---


def _restore_made(value: Any, base: Mapping[str, Any], saved: Mapping[str, Any]) -> None:
    present = dict(slots_of(value))
    for name in present.keys() - base.keys() - saved.keys():
        delattr(value, name)
    for name, item in base.items():
        if name in saved:
            continue
        if isinstance(item, Inside):
            _restore_made(present[name], item, {})
        elif name not in present or not same(look(present[name], name), item):
            _set(value, name, item, None)


def _set(owner: Any, name: str, item: Any, base: Mapping[str, Any] | None) -> None:
    present = getattr(owner, name, None)
    if isinstance(item, dict) and item.get(TAG) == "object":
        inside = None if base is None else base.get(name)
        if isinstance(inside, Inside):
            _restore_made(present, inside, item["data"])
        for inner, value in item["data"].items():
            _set(present, inner, value, inside)
        return
    value = made_again(item, present)
    if value is not present:
        setattr(owner, name, value)
