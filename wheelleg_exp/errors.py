"""The errors that people see: one message that says what was wrong, where, and what to write instead."""

from __future__ import annotations

import difflib
from collections.abc import Iterable

EXIT_OK = 0
EXIT_FINDING = 1
EXIT_INPUT = 2
EXIT_FAILED = 3
EXIT_INTERRUPTED = 130


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
        return text


class ConfigError(WheellegError):
    """The configuration is wrong: a key, a value, a term or a target."""


class AssetError(WheellegError):
    """A robot file cannot be read, or does not hold what is needed."""


class RunDirectoryError(WheellegError):
    """A run directory, a checkpoint or a recording is not one, or is damaged."""


class SimulationFailure(WheellegError):
    """A run failed while it ran: physics gone to NaN, a full disk."""

    exit_code = EXIT_FAILED


def nearest_name(name: str, names: Iterable[str]) -> str | None:
    """Return the name among ``names`` that is most like ``name``, or None when none is near."""
    matches = difflib.get_close_matches(name, list(names), n=1, cutoff=0.6)
    return matches[0] if matches else None
