"""Errors for users: one message that states what is wrong, where, and what to write instead."""

from __future__ import annotations

import difflib
import re
import unicodedata
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import torch

EXIT_OK = 0
EXIT_FINDING = 1
EXIT_INPUT = 2
EXIT_FAILED = 3
EXIT_INTERRUPTED = 130

_ODD = re.compile(r"[^\n\t -~]")
# The Unicode categories of space characters that are harmless, although str.isprintable rejects them.
_SPACES = ("Zs", "Zl", "Zp")
# For a wrong name of at least 4 characters, an error message can suggest a valid name that contains it.
_LEAST_PART = 4


class WheellegError(Exception):
    """An error that the user can understand and that is printed without a traceback.

    ``message`` states the problem in one sentence without a full stop, and ``key`` is the config key, USD prim, file or
    command-line argument. ``where`` is ``file:line``, or an override. ``expected`` describes a valid value; ``nearest``
    is the valid name most similar to a misspelled name.
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
        self.message, self.key, self.where = message, key, where
        self.expected, self.nearest = expected, nearest

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
    """A required value is missing."""

    def __init__(self, message: str = "this value is missing", **fields: str | None) -> None:
        super().__init__(message, **fields)


class UnreadKey(ConfigError):
    """A config sets a key that no code reads."""

    def __init__(self, message: str = "nothing reads this key", **fields: str | None) -> None:
        super().__init__(message, **fields)


class AssetError(WheellegError):
    """A robot file is unreadable or lacks required content."""

    def of(self, key: str) -> AssetError:
        """Return a copy of the error with the config key ``key``; the message names the old key and the robot file."""
        if self.key == key:
            return self
        message = (f"{self.key}: " if self.key else "") + self.message + (f", in {self.where}" if self.where else "")
        return AssetError(message, key=key, expected=self.expected, nearest=self.nearest)


@contextmanager
def named_as(copy: Path, original: Path) -> Iterator[None]:
    """Name the path ``original`` in place of the temporary path ``copy`` in AssetErrors that the block raises."""
    try:
        yield
    except AssetError as error:
        texts = {name: text for name, text in vars(error).items() if isinstance(text, str)}
        vars(error).update({name: text.replace(str(copy), str(original)) for name, text in texts.items()})
        raise


class RunDirectoryError(WheellegError):
    """A run directory, checkpoint or recording is missing, invalid or damaged."""


class SimulationFailure(WheellegError):
    """A run failed while it was running, for example because physics became NaN or the disk is full.

    ``evidence`` contains the simulation state that led to the failure of a run, as arrays by name.
    """

    exit_code = EXIT_FAILED

    def __init__(
        self, message: str, *, evidence: Mapping[str, torch.Tensor] | None = None, **fields: str | None
    ) -> None:
        super().__init__(message, **fields)
        self.evidence = dict(evidence or {})


class Interrupted(KeyboardInterrupt):
    """The user stopped the program with Ctrl-C, or with a signal that is treated as Ctrl-C."""


def printable(text: str) -> str:
    """Escape the control characters in a text, because text from files could otherwise control the terminal."""

    def escaped(found: re.Match[str]) -> str:
        is_shown = found[0].isprintable() or unicodedata.category(found[0]) in _SPACES
        return found[0] if is_shown else ascii(found[0])[1:-1]

    return _ODD.sub(escaped, text)


def nearest_name(name: str, names: Iterable[str]) -> str | None:
    """Return the name among ``names`` that is most similar to ``name``, or None if no name is similar.

    Prefer a name that differs only in case. Without a similar name, return the shortest one that contains ``name``.
    """
    listed = list(names)
    same = [other for other in listed if other.lower() == name.lower()]
    near = same or difflib.get_close_matches(name, listed, n=1, cutoff=0.6)
    longer = sorted((other for other in listed if name.lower() in other.lower()), key=len)
    found = near or (longer if len(name) >= _LEAST_PART else [])
    return found[0] if found else None


def not_one_of(
    message: str, name: object, names: Iterable[object], *, key: str, where: str | None = None
) -> ConfigError:
    """Return the error for an unknown name, which lists the valid names and suggests the most similar one."""
    known = [str(valid) for valid in names]
    expected, nearest = "one of " + ", ".join(known), nearest_name(str(name), known)
    return ConfigError(message, key=key, where=where, expected=expected, nearest=nearest)
