"""What torchrun tells a process that it starts: how many there are, and which one this is."""

from __future__ import annotations

import os

from wheelleg_exp.errors import ConfigError

COMMAND = "torchrun --nproc-per-node N --no-python wheelleg train ..."


def world_size() -> int:
    """Return how many processes were started together; 1 where torchrun has started none.

    Raises:
        ConfigError: ``WORLD_SIZE`` is no number.
    """
    return number("WORLD_SIZE", 1)


def number(name: str, default: int) -> int:
    """Return one of torchrun's numbers.

    Raises:
        ConfigError: it is none.
    """
    text = os.environ.get(name, "").strip()
    if text and not text.isdigit():
        raise ConfigError(f"is '{text}'", key=name, expected="a number, as torchrun sets it")
    return int(text or default)


def require_alone(what: str) -> None:
    """Raise ConfigError where several processes were started for what one process does."""
    if world_size() > 1:
        raise ConfigError(
            f"torchrun has started {world_size()} processes for it",
            key=what,
            expected="'wheelleg train' of one run, or 'wheelleg resume'; without torchrun this works as ever",
        )
