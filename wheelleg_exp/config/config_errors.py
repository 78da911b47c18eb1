"""Raise several config errors as one, and convert an error to JSON."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NoReturn

from wheelleg_exp.errors import ConfigError, WheellegError

_OVERRIDE = "override "


class Mistakes(ConfigError):
    """Several mistakes, one a line; ``errors`` holds each."""

    def __init__(self, errors: Sequence[ConfigError]) -> None:
        lines = "\n".join(f"  {error}" for error in errors)
        super().__init__(f"{len(errors)} mistakes in the config:\n{lines}")
        self.errors = tuple(errors)


class UnknownName(ConfigError):
    """A value names a part of the config that is not there; ``named`` is the key that it should have."""

    named: str


class AbsentKey(ConfigError):
    """An override names a key that is not there."""


def join(errors: Sequence[ConfigError]) -> ConfigError:
    """Return one error that tells all of ``errors``, one a line; a single error is returned as it is."""
    return errors[0] if len(errors) == 1 else Mistakes(errors)


def parts(error: ConfigError) -> list[ConfigError]:
    """Return the single mistakes of an error that ``join`` made."""
    return list(error.errors) if isinstance(error, Mistakes) else [error]


def raise_all(errors: Sequence[ConfigError], cause: Exception | None = None) -> NoReturn:
    """Raise ``errors`` as one."""
    raise join(errors) from cause


def override_of(error: WheellegError) -> str | None:
    """Return the override that an error blames, as typed; None when it blames a file or nothing."""
    where = error.where or ""
    return where.removeprefix(_OVERRIDE) if where.startswith(_OVERRIDE) else None


def document(error: WheellegError) -> dict[str, Any]:
    """Return a mistake for scripts: key, message, file and line or override, what was expected, nearest name."""
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
