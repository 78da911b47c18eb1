"""Save and restore attributes of objects, and settings of manager terms that changed after the terms' construction.

A checkpoint contains all tensor attributes of an object, except those that its class lists in ``settings``. Other
attributes, such as numbers, are saved only if their value has changed since the object's construction. If the user has
changed a config value after saving a checkpoint, restoring the checkpoint keeps the new value.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any, ClassVar, NamedTuple

import torch

from wheelleg_exp.errors import ConfigError
from wheelleg_exp.state.saved_values import NOTHING, Unsaveable, checkpoint_value, restored_value, same, snapshot

_BASE = "_state_when_made"
_TENSOR = "a tensor"  # ``made`` stores this text in place of tensors, because every checkpoint contains them.


class _Base(NamedTuple):
    values: dict[str, Any]
    key: str | None


class Stateful:
    """Base class of objects that save and restore their own attributes as their state.

    ``settings`` lists tensor attributes that come from the config and are saved only if their value has changed.
    """

    settings: ClassVar[tuple[str, ...]] = ()

    def state_dict(self) -> dict[str, Any]:
        """Return all values of the object that later control steps depend on."""
        return save(self)

    def load_state_dict(self, saved: Mapping[str, Any]) -> None:
        """Restore a state that was returned by the ``state_dict`` of an object constructed with the same arguments."""
        restore(self, saved)


def made(value: Any, key: str | None = None) -> None:
    """Record an object's present attributes as its initial state; raise ConfigError if an attribute cannot be saved."""
    try:
        if any(vars(kind).get("__slots__") for kind in type(value).__mro__):
            raise Unsaveable("__slots__", value)
        seen = {name: snapshot(item, name) for name, item in attributes(value).items()}
    except (Unsaveable, RecursionError) as error:
        raise refusal(value, error, key) from error
    always = {name for name, item in seen.items() if isinstance(item, torch.Tensor) and name not in _settings(value)}
    vars(value)[_BASE] = _Base({n: _TENSOR if n in always else item for n, item in seen.items()}, key)


def save(value: Any) -> dict[str, Any]:
    """Return an object's state as tensors, numbers, and strings; raise ConfigError if an attribute cannot be saved."""
    if _BASE not in vars(value):
        made(value)
    base, key = vars(value)[_BASE]
    settings, found = _settings(value), {}
    try:
        for name, item in attributes(value).items():
            now, before = snapshot(item, name), base.get(name, NOTHING)
            if (isinstance(now, torch.Tensor) and name not in settings) or not same(now, before):
                found[name] = checkpoint_value(now, before, name)
        for name in base.keys() - vars(value).keys():
            raise Unsaveable(name, NOTHING, "an attribute that was deleted")
    except (Unsaveable, RecursionError) as error:
        raise refusal(value, error, key) from error
    return found


def restore(value: Any, saved: Mapping[str, Any]) -> None:
    """Restore the object state ``saved``; the attributes that ``saved`` does not contain get their initial values."""
    if _BASE not in vars(value):
        made(value)
    base, held = vars(value)[_BASE].values, attributes(value)
    for name in held.keys() - base.keys() - saved.keys():
        delattr(value, name)
    unchanged = {name: item for name, item in base.items() if name not in saved and item is not _TENSOR}
    for name, item in {**unchanged, **saved}.items():
        present = held.get(name)
        if name in saved or not same(snapshot(present, name), item):
            vars(value)[name] = restored_value(item, present)


def adopt(value: Stateful, made_anew: Stateful, key: str) -> None:
    """Copy the settings of the object ``made_anew`` to ``value``; keep the state and tensor addresses of ``value``."""
    state = value.state_dict()
    for name, item in attributes(made_anew).items():
        vars(value)[name] = restored_value(item, vars(value).get(name)) if isinstance(item, torch.Tensor) else item
    made(value, key)
    value.load_state_dict(state)


def attributes(value: Any) -> dict[str, Any]:
    """Return the instance attributes of an object by name."""
    return {name: item for name, item in vars(value).items() if name != _BASE}


def _settings(value: Any) -> tuple[str, ...]:
    return getattr(type(value), "settings", ())


def refusal(value: Any, error: Exception, key: str | None) -> ConfigError:
    """Return the error for an object whose state cannot be saved."""
    why = "points back at itself" if isinstance(error, RecursionError) else str(error)
    message = f"'{type(value).__qualname__}' {why}, whose state cannot be saved, so that a resumed run would differ"
    expected = "tensors, arrays, numbers, text, generators, lists and dictionaries of these (a list and the place in "
    expected += "it instead of an iterator), or objects with state_dict and load_state_dict of their own"
    return ConfigError(message, key=key, expected=expected)


class _Attributes:
    """Saves and restores the attributes of an object that has no method ``state_dict``."""

    def __init__(self, value: Any, key: str) -> None:
        self._value = value
        if value is not None:
            made(value, key)

    def state_dict(self) -> dict[str, Any]:
        return {} if self._value is None else save(self._value)

    def load_state_dict(self, saved: Mapping[str, Any]) -> None:
        if self._value is not None:
            restore(self._value, saved)


def stateful(value: Any, key: str) -> Any:
    """Return an object that saves and restores ``value``: the value itself if it has ``state_dict``."""
    return value if hasattr(value, "state_dict") and hasattr(value, "load_state_dict") else _Attributes(value, key)


class Settings:
    """Config values of a manager term, which checkpoints store if a curriculum or other code has changed them.

    Each changed setting, such as a reward weight, is saved together with its value from the config. If the user has
    changed a setting in the config of a resumed run, the saved setting is not restored. ``groups`` maps each group's
    name to a dictionary of setting names and values. ``skip`` names the settings to omit, whose values are objects that
    save their own state.
    """

    def __init__(self, groups: Mapping[str, dict[str, Any]], key: str, skip: Collection[str] = ()) -> None:
        self._groups, self._key, self._skip = dict(groups), key, frozenset(skip)
        self._base = self._snapshots()

    def _snapshots(self) -> dict[str, dict[str, Any]]:
        try:
            own = {g: {n: v for n, v in values.items() if n not in self._skip} for g, values in self._groups.items()}
            return {group: {name: snapshot(v, name) for name, v in values.items()} for group, values in own.items()}
        except Unsaveable as error:
            raise ConfigError(f"checkpoints cannot save a term's setting, because it {error}", key=self._key) from error

    def state_dict(self) -> dict[str, Any]:
        """Return each changed setting's present value and its value from the config, by group and name."""
        found: dict[str, Any] = {}
        for group, values in self._snapshots().items():
            for name, now in values.items():
                was = self._base[group].get(name, NOTHING)
                if same(now, was):
                    continue
                try:
                    change = {"was": _written(None if was is NOTHING else was), "now": checkpoint_value(now, was, name)}
                except Unsaveable as error:
                    message = f"checkpoints cannot save a term's changed setting, because it {error}"
                    raise ConfigError(message, key=self._key) from error
                found.setdefault(group, {})[name] = change
        return found

    def load_state_dict(self, saved: Mapping[str, Any]) -> None:
        """Restore the changed settings that ``state_dict`` returned; reset other settings to the config's values."""
        for group, values in self._groups.items():
            changes, base = saved.get(group, {}), self._base[group]
            for name in list(values.keys() - base.keys() - changes.keys() - self._skip):
                del values[name]
            for name in [*base, *(n for n in changes if n not in base)]:
                change, own = changes.get(name), base.get(name)
                wanted = change["now"] if change is not None and same(change["was"], _written(own)) else own
                if not same(snapshot(values.get(name), name), wanted):
                    values[name] = restored_value(wanted, values.get(name))


def _written(seen: Any) -> Any:
    return checkpoint_value(seen, seen, "")
