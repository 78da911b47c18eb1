"""State that an object keeps between steps, found and saved without its author's help.

Tensors among an object's attributes are its state and are always saved, but for those that the class names in
``settings``. Every other attribute (numbers, text, lists, dictionaries, arrays, random generators, helper objects and
what they hold) is saved once it differs from what it was when the object was made, so that loading does not undo a
setting that was changed in the config since. What stands for one thing (a tensor in two lists, a view of another)
does so afterwards. What cannot be saved is refused when the object is made, or when it appears later, when the state
is saved.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any, ClassVar

import torch

from wheelleg_exp.errors import ConfigError
from wheelleg_exp.sim.state_binding import Binder, Nodes, bindings, require_writable
from wheelleg_exp.sim.state_class import is_noted, note_class, require_class_untouched
from wheelleg_exp.sim.state_restoring import made_again, put
from wheelleg_exp.sim.state_settings import Settings
from wheelleg_exp.sim.state_values import (
    BASE,
    BOUND,
    CONSTANTS,
    NODES,
    NOTHING,
    PLAIN,
    TAG,
    Inside,
    Kept,
    NamedStream,
    Unsaveable,
    attributes,
    look,
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
    if not is_noted(type(value)):
        note_class(type(value), key)
    vars(value).pop(BASE, None)
    try:
        base = _without_tensors(attributes(value), getattr(value, "settings", ()))
        nodes = Nodes(value, key)
        require_writable(nodes)
        vars(value).update({BASE: base, NODES: nodes})
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
    base = vars(value).get(BASE)
    key = None if base is None else vars(value)[NODES].key
    if base is not None:
        require_class_untouched(type(value), key)
    settings = getattr(value, "settings", ())
    try:
        if base is None:
            return {n: i for n, i in attributes(value).items() if isinstance(i, torch.Tensor) and n not in settings}
        bound, forced = bindings(Nodes(value), vars(value)[NODES])
        found = _changes(attributes(value), base, forced, settings=settings)
    except Unsaveable as error:
        raise _refusal(value, error, key) from error
    bound = {path: binding for path, binding in bound.items() if _saves(found, path)}
    return {**found, BOUND: bound} if bound else found


def restore(value: Any, saved: Mapping[str, Any]) -> None:
    """Give an object the state that ``save`` returned; what was not saved goes back to what it was made with."""
    base = vars(value).get(BASE)
    binder = Binder(vars(value)[NODES] if base is not None else Nodes(value), saved.get(BOUND))
    found = {name: item for name, item in saved.items() if name != BOUND}
    if base is not None:
        _restore_made(value, base, found, binder)
    for name, item in found.items():
        _set(value, name, item, base, binder)


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
    if value is None or isinstance(value, (*PLAIN, *CONSTANTS)):
        return _Stateless()
    if not hasattr(value, "__dict__"):
        raise _refusal(value, Unsaveable("__slots__", value), key)
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
        expected="tensors, arrays, numbers, text, lists, dictionaries (a list and the place in it instead of an "
        "iterator, a clone instead of shared memory), or state_dict and load_state_dict of its own",
    )


# --- comparing ---


def _changes(
    now: Inside, base: Mapping[str, Any], forced: Collection[str], path: str = "", *, settings: Collection[str] = ()
) -> dict[str, Any]:
    """Return tensors, whatever else differs from ``base``, and what is bound to another thing."""
    found: dict[str, Any] = {}
    for name, item in now.items():
        here = path + name
        if isinstance(item, Inside) and isinstance(base.get(name), Inside):
            inner = _changes(item, base[name], forced, f"{here}.")
            found.update({name: {TAG: "object", "data": inner}} if inner else {})
        elif (
            (isinstance(item, torch.Tensor) and name not in settings)
            or not same(item, base.get(name, NOTHING))
            or any(_is_within(p, here) for p in forced)
        ):
            require_plain(item, here)
            found[name] = item
    return found


def _is_within(path: str, outer: str) -> bool:
    return path == outer or path.startswith((f"{outer}.", f"{outer}["))


def _saves(found: Mapping[str, Any], path: str, above: str = "") -> bool:
    """Return whether what stands at a path is among what is saved."""
    for name, item in found.items():
        if _is_within(path, above + name):
            inside = isinstance(item, dict) and item.get(TAG) == "object"
            return not inside or _saves(item["data"], path, f"{above}{name}.")
    return False


# --- restoring ---


def _restore_made(
    value: Any, base: Mapping[str, Any], saved: Mapping[str, Any], binder: Binder, path: str = ""
) -> None:
    present = dict(slots_of(value))
    for name in present.keys() - base.keys() - saved.keys():
        delattr(value, name)
    for name, item in base.items():
        if name in saved:
            continue
        if isinstance(item, Inside):
            put(value, name, binder.made[path + name])
            _restore_made(binder.made[path + name], item, {}, binder, f"{path}{name}.")
        elif name not in present or _may_stray(item) or not same(look(present[name], name), item):
            put(value, name, made_again(item, path + name, binder))


def _may_stray(item: Any) -> bool:
    """Return whether an equal item could stand in another thing than it was made in."""
    return isinstance(item, dict) and item[TAG] != "stateful"


def _set(owner: Any, name: str, item: Any, base: Mapping[str, Any] | None, binder: Binder, path: str = "") -> None:
    here = path + name
    if not (isinstance(item, dict) and item.get(TAG) == "object"):
        put(owner, name, made_again(item, here, binder))
        return
    inside = None if base is None else base.get(name)
    present = binder.made.get(here, getattr(owner, name, None))
    put(owner, name, present)
    if isinstance(inside, Inside):
        _restore_made(present, inside, item["data"], binder, f"{here}.")
    for inner, value in item["data"].items():
        _set(present, inner, value, inside, binder, f"{here}.")
