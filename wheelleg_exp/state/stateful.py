"""Declare the values of an object that outlive a control step; save, restore, and reset them by these declarations.

```python
class mean_speed(TermBase):
    def __init__(self, env):
        self.sum = self.buffer("sum", torch.zeros(env.num_envs), fill=0.0)
        self.calls = self.number("calls", 0)
```
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Literal, TypeVar, cast

import torch
from torch.utils._pytree import tree_leaves

from wheelleg_exp.errors import ConfigError
from wheelleg_exp.state.values import PLAIN, Unsaveable, encoded, is_own, is_saving, restored, same, snapshot

T = TypeVar("T")
Kind = Literal["buffer", "number", "setting", "part"]
_DECLARED = "_declared"  # the attribute with the declarations of an object


@dataclass(frozen=True)
class Declaration:
    """What an object has declared about one of its attributes."""

    kind: Kind
    initial: object = None  # an encoded copy of the first value; None for buffers and parts
    saved: bool = True  # whether checkpoints contain the attribute
    fill: float | None = None  # the number to which a reset sets the rows of a buffer; None: it does not change them
    is_automatic: bool = False  # whether ``register_undeclared`` registered what the class does not declare


class Stateful:
    """Base class of objects with state: terms, sensors, actuators, managers, and their parts.

    Whatever a later control step reads must be declared, or be the same in every step:

    - ``buffer``: a tensor, or a list or dictionary of tensors. Change it in place, or assign one of the same shape.
    - ``number``: a plain value that changes, such as a count or a flag.
    - ``setting``: a value from the config that events or curricula can change. It is saved only once it has changed, so
      that a resumed run uses a new value from the config.
    - ``child``: an object with state of its own, or a list or dictionary of such objects.

    Each of these methods assigns the value to the attribute ``name``, and returns it. ``saved=False`` declares a value
    that changes within a step, but does not outlive it: checkpoints omit it, and CUDA graphs use it.
    """

    def buffer(self, name: str, value: T, *, saved: bool = True, fill: float | None = None) -> T:
        """Declare a tensor; ``fill`` is the number to which ``reset_rows`` sets the rows of reset environments."""
        return _declare(self, name, value, Declaration("buffer", None, saved, fill))

    def number(self, name: str, value: T, *, saved: bool = True) -> T:
        """Declare a number, a text, None, a generator, or lists and dictionaries of these."""
        initial = _encoded(self, name, value) if saved else None
        return _declare(self, name, value, Declaration("number", initial, saved))

    def setting(self, name: str, value: T) -> T:
        """Declare a tensor or plain value from the config that events or curricula can change."""
        return _declare(self, name, value, Declaration("setting", _encoded(self, name, value)))

    def child(self, name: str, value: T, *, saved: bool = True) -> T:
        """Declare an object with state, or a list or dictionary of such objects; None means no object."""
        return _declare(self, name, value, Declaration("part", None, saved))

    def reset_rows(self, env_ids: torch.Tensor) -> None:
        """Set the rows ``env_ids`` of all buffers that have a ``fill`` to this number."""
        for name, declared in declarations(self).items():
            if declared.fill is not None:
                getattr(self, name).index_fill_(0, env_ids, declared.fill)

    def state_dict(self) -> dict[str, object]:
        """Return copies of all declared values that later control steps depend on."""
        return save(self)

    def load_state_dict(self, saved: Mapping[str, object]) -> None:
        """Restore a state that was returned by the ``state_dict`` of an object constructed with the same arguments."""
        restore(self, saved)


def _declare(owner: object, name: str, value: T, declared: Declaration) -> T:
    vars(owner).setdefault(_DECLARED, {})[name] = declared
    setattr(owner, name, value)
    return value


def declarations(owner: object) -> dict[str, Declaration]:
    """Return what an object has declared, by the names of its attributes."""
    return cast("dict[str, Declaration]", getattr(owner, "__dict__", {}).get(_DECLARED, {}))


def parts(owner: object) -> Iterator[tuple[str, str | int | None, object]]:
    """Yield the parts of an object: the attribute, the key or index in its dictionary or list, and the part."""
    for name, declared in declarations(owner).items():
        if declared.kind == "part":
            value = getattr(owner, name)
            if isinstance(value, Mapping):
                for key, item in value.items():
                    inner = item.items() if isinstance(item, Mapping) else [(None, item)]
                    yield from ((name, key if own is None else f"{key}.{own}", each) for own, each in inner)
            elif isinstance(value, (list, tuple)):
                yield from ((name, index, item) for index, item in enumerate(value))
            elif value is not None:
                yield name, None, value


def tree(owner: object, path: str = "env") -> Iterator[tuple[str, object]]:
    """Yield an object and, recursively, all its parts, each with its config key, or a path of attributes."""
    yield path, owner
    for name, key, item in parts(owner):
        own = path if name == "func" else f"{path}.{name.strip('_')}"
        own += "" if key is None else f".{key}" if isinstance(key, str) else f"[{key}]"
        yield from tree(item, getattr(item, "path", None) or own)


def save(owner: object) -> dict[str, object]:
    """Return an object's state as tensors and plain values, by attribute; parts give nested dictionaries."""
    found: dict[str, Any] = {}
    for name, declared in declarations(owner).items():
        if declared.saved and declared.kind != "part":
            now = _encoded(owner, name, getattr(owner, name), declared)
            if declared.kind == "buffer" or not same(now, declared.initial):
                found[name] = now
    for name, key, item in parts(owner):
        if declarations(owner)[name].saved:
            state = item.state_dict() if is_saving(item) else save(item)
            if key is None:
                found[name] = state
            else:
                found.setdefault(name, {})[key] = state
    return found


def _encoded(owner: object, name: str, value: object, declared: Declaration | None = None) -> object:
    """Return what a checkpoint stores of an attribute; raise ConfigError if a checkpoint cannot contain the value."""
    was_plain = declared is not None and declared.kind == "number" and type(declared.initial) in PLAIN
    try:
        # A new object has nothing into which the state of a network or a generator could be restored.
        if was_plain and (is_saving(value) or isinstance(value, torch.Generator)):
            raise Unsaveable(value)
        return encoded(value)
    except Unsaveable as error:
        message = f"'{name}' of '{type(owner).__qualname__}' is {error}, which checkpoints cannot contain"
        expected = "tensors, numbers, texts, and lists and dictionaries of these"
        raise ConfigError(message, key=getattr(owner, "path", None), expected=expected) from error


def restore(owner: object, saved: Mapping[str, object]) -> None:
    """Restore what ``save`` returned; numbers and settings that ``saved`` lacks get their initial values."""
    for name, declared in declarations(owner).items():
        if declared.saved and declared.kind != "part" and (name in saved or declared.kind != "buffer"):
            setattr(owner, name, restored(saved.get(name, declared.initial), getattr(owner, name)))
    for name, key, item in parts(owner):
        state: Any = saved.get(name, {})
        if key is not None and isinstance(state, Mapping):
            state = state.get(key)
        if declarations(owner)[name].saved and state is not None:
            item.load_state_dict(state) if is_saving(item) else restore(item, state)


def adopt(value: Stateful, fresh: Stateful) -> None:
    """Copy the settings of the object ``fresh`` to ``value``; keep the state and tensor addresses of ``value``."""
    state = value.state_dict()
    for name, item in vars(fresh).items():
        vars(value)[name] = restored(item, vars(value).get(name)) if isinstance(item, torch.Tensor) else item
    register_undeclared(value)
    value.load_state_dict(state)


def register_undeclared(owner: object, owned: frozenset[int] = frozenset()) -> None:
    """Declare the values that an object has, but did not declare, if a checkpoint can contain them.

    This serves user-defined classes that were written before declarations existed, and plain objects such as
    dataclasses of noise. References to objects whose ids are in ``owned``, such as the robot, are not state.
    """
    if isinstance(owner, Stateful) and is_own(type(owner)):
        return
    for name, value in vars(owner).copy().items():
        leaves = tree_leaves(value)
        if name == _DECLARED or name in declarations(owner) or any(id(leaf) in owned for leaf in leaves):
            continue
        for leaf in leaves:
            if isinstance(leaf, Stateful):
                register_undeclared(leaf, owned)
        kind: Kind = "number" if isinstance(owner, Stateful) else "setting"
        kind = "buffer" if isinstance(value, torch.Tensor) else "part" if isinstance(value, Stateful) else kind
        try:
            initial = None if kind == "part" else encoded(value)
        except Unsaveable:
            continue
        declared = Declaration(kind, None if kind == "buffer" else initial, is_automatic=kind != "setting")
        _declare(owner, name, value, declared)


class Settings:
    """Config values that are state once they have changed.

    Each changed setting, such as a reward weight, is saved together with its value from the config. If the user has
    changed a setting in the config of a resumed run, the saved setting is not restored. ``groups`` maps each group's
    name to a dictionary of setting names and values. ``skip`` names the settings to omit. A setting that a checkpoint
    cannot contain, such as a function, must not change.
    """

    def __init__(self, groups: Mapping[str, dict[str, object]], key: str, skip: Collection[str] = ()) -> None:
        self._groups, self._key, self._skip = dict(groups), key, frozenset(skip)
        self._base = self._present()

    def _present(self) -> dict[tuple[str, str], object]:
        groups = self._groups.items()
        pairs = (((group, name), value) for group, values in groups for name, value in values.items())
        return {place: snapshot(value) for place, value in pairs if place[1] not in self._skip}

    def state_dict(self) -> dict[str, dict[str, object]]:
        """Return each changed setting's present value and its value from the config, by group and name."""
        found: dict[str, dict[str, object]] = {}
        for (group, name), now in self._present().items():
            was = self._base.get((group, name))
            if (group, name) in self._base and same(now, was):
                continue
            with self._refusing(name):
                found.setdefault(group, {})[name] = {"now": encoded(now), "was": encoded(was)}
        return found

    @contextmanager
    def _refusing(self, name: str) -> Iterator[None]:
        try:
            yield
        except Unsaveable as error:
            message = f"the setting '{name}' has changed to or from {error}, which checkpoints cannot contain"
            expected = "a tensor, a number, a text, or lists and dictionaries of these"
            raise ConfigError(message, key=self._key, expected=expected) from error

    def load_state_dict(self, saved: Mapping[str, Mapping[str, Mapping[str, object]]]) -> None:
        """Restore the changed settings that ``state_dict`` returned; reset other settings to the config's values."""
        present = self._present()
        changes = {(group, name): change for group in self._groups for name, change in saved.get(group, {}).items()}
        for group, name in present.keys() - self._base.keys() - changes.keys():
            del self._groups[group][name]
        for group, name in self._base | changes:
            own, change = self._base.get((group, name)), changes.get((group, name))
            wanted = own if change is None or not same(change.get("was", own), own) else change["now"]
            if not same(present.get((group, name)), wanted):
                with self._refusing(name):
                    self._groups[group][name] = restored(wanted, self._groups[group].get(name))
