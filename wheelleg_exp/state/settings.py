"""Parameters of manager terms, which checkpoints contain once a curriculum or other code has changed them."""

from __future__ import annotations

from collections.abc import Collection, Mapping

from wheelleg_exp.errors import ConfigError
from wheelleg_exp.state.values import Unsaveable, encoded, encoded_or_itself, restored, same

_MISSING = object()


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
        return {place: encoded_or_itself(value) for place, value in pairs if place[1] not in self._skip}

    def state_dict(self) -> dict[str, dict[str, object]]:
        """Return each changed setting's present value and its value from the config, by group and name."""
        found: dict[str, dict[str, object]] = {}
        for (group, name), now in self._present().items():
            was = self._base.get((group, name), _MISSING)
            if now is was or same(now, was):
                continue
            try:
                change = {"now": encoded(now), "was": encoded(None if was is _MISSING else was)}
            except Unsaveable as error:
                message = f"the setting '{name}' has changed to or from {error}, which checkpoints cannot contain"
                expected = "a tensor, a number, a text, or lists and dictionaries of these"
                raise ConfigError(message, key=self._key, expected=expected) from error
            found.setdefault(group, {})[name] = change
        return found

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
                self._groups[group][name] = restored(wanted, self._groups[group].get(name))
