"""Parameters of manager terms, which checkpoints contain once a curriculum or other code has changed them."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any

from wheelleg_exp.errors import ConfigError
from wheelleg_exp.state.values import Unsaveable, encoded, restored, same

_MISSING = object()


class Settings:
    """Config values that are state once they have changed.

    Each changed setting, such as a reward weight, is saved together with its value from the config. If the user has
    changed a setting in the config of a resumed run, the saved setting is not restored. ``groups`` maps each group's
    name to a dictionary of setting names and values. ``skip`` names the settings to omit. A setting that a checkpoint
    cannot contain, such as a function, must not change.
    """

    def __init__(self, groups: Mapping[str, dict[str, Any]], key: str, skip: Collection[str] = ()) -> None:
        self._groups, self._key, self._skip = dict(groups), key, frozenset(skip)
        self._base = {group: self._encoded(values) for group, values in self._groups.items()}

    def _encoded(self, values: Mapping[str, object]) -> dict[str, object]:
        return {name: _encoded_or_itself(value) for name, value in values.items() if name not in self._skip}

    def state_dict(self) -> dict[str, Any]:
        """Return each changed setting's present value and its value from the config, by group and name."""
        found: dict[str, dict[str, object]] = {}
        for group, values in self._groups.items():
            base = self._base[group]
            for name, now in self._encoded(values).items():
                was = base.get(name, _MISSING)
                if now is was or same(now, was):
                    continue
                try:
                    change = {"now": encoded(values[name]), "was": encoded(None if was is _MISSING else was)}
                except Unsaveable as error:
                    message = f"the setting '{name}' has changed to or from {error}, which checkpoints cannot contain"
                    expected = "a tensor, a number, a text, or lists and dictionaries of these"
                    raise ConfigError(message, key=self._key, expected=expected) from error
                found.setdefault(group, {})[name] = change
        return found

    def load_state_dict(self, saved: Mapping[str, Any]) -> None:
        """Restore the changed settings that ``state_dict`` returned; reset other settings to the config's values."""
        for group, values in self._groups.items():
            changes, base = saved.get(group, {}), self._base[group]
            for name in list(values.keys() - base.keys() - changes.keys() - self._skip):
                del values[name]
            for name in [*base, *(name for name in changes if name not in base)]:
                own, change = base.get(name), changes.get(name)
                wanted = own if change is None or not same(change.get("was", own), own) else change["now"]
                if not same(_encoded_or_itself(values.get(name)), wanted):
                    values[name] = restored(wanted, values.get(name))


def _encoded_or_itself(value: object) -> object:
    try:
        return encoded(value)
    except Unsaveable:
        return value
