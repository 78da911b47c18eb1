"""Raise several config errors as one, and convert an error to JSON."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NoReturn

from wheelleg_exp.errors import ConfigError, WheellegError

_OVERRIDE = "override "


class Mistakes(ConfigError):
    """Several mistakes, one per line; ``errors`` contains each of them."""

    def __init__(self, errors: Sequence[ConfigError]) -> None:
        lines = "\n".join(f"  {error}" for error in errors)
        super().__init__(f"{len(errors)} mistakes in the config:\n{lines}")
        self.errors = tuple(errors)


class UnknownName(ConfigError):
    """A value names a part of the config that does not exist; ``named`` is the missing key."""

    named: str


class AbsentKey(ConfigError):
    """An override names a key that does not exist."""


def join(errors: Sequence[ConfigError]) -> ConfigError:
    """Return one error for all of ``errors``, with one line each. A single error is returned unchanged."""
    return errors[0] if len(errors) == 1 else Mistakes(errors)


def parts(error: ConfigError) -> list[ConfigError]:
    """Return the single mistakes of an error that ``join`` made."""
    return list(error.errors) if isinstance(error, Mistakes) else [error]


def raise_all(errors: Sequence[ConfigError], cause: Exception | None = None) -> NoReturn:
    """Raise ``errors`` as one."""
    raise join(errors) from cause


def override_of(error: WheellegError) -> str | None:
    """Return the override that caused an error, as typed; None if its place is a file or unknown."""
    where = error.where or ""
    return where.removeprefix(_OVERRIDE) if where.startswith(_OVERRIDE) else None


def document(error: WheellegError) -> dict[str, Any]:
    """Return a mistake as JSON: key, message, file and line or override, expected value, nearest name."""
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
