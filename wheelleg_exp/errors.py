"""The errors that people see: one message that says what was wrong, where, and what to write instead."""

from __future__ import annotations

import difflib
import re
import unicodedata
from collections.abc import Iterable, Mapping
from typing import Any

EXIT_OK = 0
EXIT_FINDING = 1
EXIT_INPUT = 2
EXIT_FAILED = 3
EXIT_INTERRUPTED = 130

_ODD = re.compile(r"[^\n\t -~]")
_SPACES = ("Zs", "Zl", "Zp")  # which are not printable either, and harmless
_LEAST_PART = 4  # letters of a name that may stand for all of it


class WheellegError(Exception):
    """An error for people.

    Args:
        message: what was wrong, in one sentence without a full stop.
        key: the config key or the prim, file or command-line word that the message is about.
        where: ``file:line`` (or the override) that the value came from.
        expected: what was expected instead.
        nearest: the nearest valid name.
    """

    exit_code = EXIT_INPUT

    def __init__(
        self,
        message: str,
        *,
        key: str | None = None,
        where: str | None = None,
        expected: str | None = None,
        nearest: str | None = None,
    ) -> None:
        super().__init__(message)
        self.message = message
        self.key = key
        self.where = where
        self.expected = expected
        self.nearest = nearest

    def __str__(self) -> str:
        text = f"{self.key}: {self.message}" if self.key else self.message
        if self.where:
            text += f" ({self.where})"
        if self.expected:
            text += f"; expected {self.expected}"
        if self.nearest:
            text += f"; did you mean '{self.nearest}'?"
        return printable(text)


class ConfigError(WheellegError):
    """The configuration is wrong: a key, a value, a term or a target."""


class MissingValue(ConfigError):
    """A value that must be there is not."""

    def __init__(self, message: str = "this value is missing", **fields: str | None) -> None:
        super().__init__(message, **fields)


class UnreadKey(ConfigError):
    """Nothing reads a key."""

    def __init__(self, message: str = "nothing reads this key", **fields: str | None) -> None:
        super().__init__(message, **fields)


class AssetError(WheellegError):
    """A robot file cannot be read, or does not hold what is needed."""

    def of(self, key: str) -> AssetError:
        """Return the error as one of a config key: the place in the file becomes a part of the message."""
        if self.key == key:
            return self
        message = (f"{self.key}: " if self.key else "") + self.message + (f", in {self.where}" if self.where else "")
        return AssetError(message, key=key, expected=self.expected, nearest=self.nearest)


class RunDirectoryError(WheellegError):
    """A run directory, a checkpoint or a recording is not one, or is damaged."""


class SimulationFailure(WheellegError):
    """A run failed while it ran: physics gone to NaN, a full disk.

    Args:
        message: see ``WheellegError``, as for ``fields``.
        evidence: what it failed with, arrays by name.
        fields: the other parts of the message.
    """

    exit_code = EXIT_FAILED

    def __init__(self, message: str, *, evidence: Mapping[str, Any] | None = None, **fields: str | None) -> None:
        super().__init__(message, **fields)
        self.evidence = dict(evidence or {})


class Interrupted(KeyboardInterrupt):
    """Somebody asked the program to stop: Ctrl-C, or a signal that is treated as it."""


def printable(text: str) -> str:
    """Return a text in which what would steer a terminal is spelled out: files may hold any character."""
    return _ODD.sub(lambda found: _spelled_out(found[0]), text)


def _spelled_out(letter: str) -> str:
    return letter if letter.isprintable() or unicodedata.category(letter) in _SPACES else ascii(letter)[1:-1]


def nearest_name(name: str, names: Iterable[str]) -> str | None:
    """Return the name among ``names`` that is most like ``name``, or None when none is near.

    The same letters in capitals come first, and a name of which only a part was written last.
    """
    listed = list(names)
    same = [other for other in listed if other.lower() == name.lower()]
    near = same or difflib.get_close_matches(name, listed, n=1, cutoff=0.6)
    longer = sorted((other for other in listed if name.lower() in other.lower()), key=len)
    found = near or (longer if len(name) >= _LEAST_PART else [])
    return found[0] if found else None
