"""Environment variables that torchrun sets in its processes: the number of processes, and the index of each."""

from __future__ import annotations

import os

from wheelleg_exp.errors import ConfigError

COMMAND = "torchrun --nproc-per-node N --no-python wheelleg train ..."


def world_size() -> int:
    """Return the number of processes that torchrun has started, or 1 without torchrun."""
    return number("WORLD_SIZE", 1)


def number(name: str, default: int) -> int:
    """Return an integer environment variable of torchrun; raise ConfigError if the variable is not a number."""
    text = os.environ.get(name, "").strip()
    if text and not text.isdigit():
        raise ConfigError(f"the variable is '{text}'", key=name, expected="a number, as torchrun sets it")
    return int(text or default)


def require_alone(what: str) -> None:
    """Raise ConfigError if torchrun has started several processes for a job that needs exactly one process."""
    if world_size() > 1:
        expected = "'wheelleg train' of one run, or 'wheelleg resume'; or this command without torchrun"
        raise ConfigError(f"torchrun has started {world_size()} processes instead of one", key=what, expected=expected)
