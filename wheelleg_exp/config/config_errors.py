"""Join config errors, and convert a config error to JSON."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import NoReturn

from wheelleg_exp.errors import ConfigError, MissingValue, WheellegError

_OVERRIDE = "override "


class Mistakes(ConfigError):
    """An error whose message lists several config errors, one per line."""

    def __init__(self, errors: Sequence[ConfigError]) -> None:
        lines = "\n".join(f"  {error}" for error in errors)
        super().__init__(f"{len(errors)} mistakes in the config:\n{lines}")
        self.errors = tuple(errors)


class UnknownName(ConfigError):
    """A config value, such as the interpolation ``${env.x}``, refers to the key ``named``, which does not exist."""

    named: str


class AbsentKey(ConfigError):
    """An override sets or deletes a config key that does not exist."""


def join(errors: Sequence[ConfigError]) -> ConfigError:
    """Combine ``errors`` into one ConfigError with one line per error; return a single error unchanged."""
    return errors[0] if len(errors) == 1 else Mistakes(errors)


def parts(error: ConfigError) -> list[ConfigError]:
    """Return the separate config errors inside an error that ``join`` returned."""
    return list(error.errors) if isinstance(error, Mistakes) else [error]


def raise_all(errors: Sequence[ConfigError], cause: Exception | None = None) -> NoReturn:
    """Raise one ConfigError that lists all given ``errors``."""
    joined = join(errors)
    raise joined from cause or joined.__cause__


def follows_from(error: ConfigError, lost: Collection[str]) -> bool:
    """Return whether an error can be caused by the missing values of the config keys in ``lost``.

    In ``lost``, ``.alive`` means the key ``alive`` in any config section, and an empty text means all keys.
    """
    key = error.key or ""
    if isinstance(error, UnknownName) and _is_at_or_below(error.named, lost):
        return True
    if isinstance(error, AbsentKey) and "" in lost:
        return True
    above = isinstance(error, MissingValue) and any(name.startswith(f"{key}.") for name in lost)
    return above or _is_at_or_below(key, lost)


def _is_at_or_below(key: str, places: Collection[str]) -> bool:
    return any(f"{p}." in f".{key}." if p.startswith(".") else f"{key}.".startswith(f"{p}.") for p in places)


def override_of(error: WheellegError) -> str | None:
    """Return the override that caused an error, as the user typed it; None if a config file caused the error."""
    where = error.where or ""
    return where.removeprefix(_OVERRIDE) if where.startswith(_OVERRIDE) else None


def document(error: WheellegError) -> dict[str, object]:
    """Return the fields of a config error as a mapping for JSON."""
    override = override_of(error)
    place, _, line = (error.where or "").rpartition(":")
    has_line = override is None and line.isdigit()
    return {
        "key": error.key,
        "message": error.message,
        "file": place if has_line else (error.where if override is None else None),
        "line": int(line) if has_line else None,
        "override": override,
        "expected": error.expected,
        "nearest": error.nearest,
    }
