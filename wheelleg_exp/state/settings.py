"""Settings of terms, which are state once something has changed them."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any

from wheelleg_exp.errors import ConfigError
from wheelleg_exp.state.rebuilding import made_again, writable
from wheelleg_exp.state.values import NOTHING, Unsaveable, look, same

_Looked = dict[str, dict[str, Any]]


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

    def _look(self) -> _Looked:
        try:
            return {
                group: {name: look(value, name) for name, value in values.items() if name not in self._skip}
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
        try:
            return {"was": _written(None if was is NOTHING else was), "now": writable(now, was, name)}
        except Unsaveable as error:
            raise ConfigError(f"the changed setting {error}, which cannot be saved", key=self._key) from error

    def load_state_dict(self, saved: Mapping[str, Any]) -> None:
        """Restore what ``state_dict`` returned; settings that had not changed are what the config says."""
        for group, values in self._groups.items():
            changes, base = saved.get(group, {}), self._base[group]
            for name in list(values.keys() - base.keys() - changes.keys() - self._skip):
                del values[name]
            for name in [*base, *(n for n in changes if n not in base)]:
                change, own = changes.get(name), base.get(name)
                wanted = change["now"] if change is not None and same(change["was"], _written(own)) else own
                if not same(look(values.get(name), name), wanted):
                    values[name] = made_again(wanted, values.get(name))


def _written(looked: Any) -> Any:
    """Return a setting of the config as a checkpoint takes it."""
    return writable(looked, looked, "")
