"""Errors of processes that train together: one's own told to the others, and that another one is gone."""

from __future__ import annotations

import os
import traceback
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch.distributed as dist

from wheelleg_exp.errors import EXIT_FAILED, ConfigError, SimulationFailure, WheellegError

_COMMUNICATION = Path(dist.__file__).parent


class ToldByFirst(WheellegError):
    """The training has failed, and the first process says why.

    Args:
        keeps: whether the first keeps what it failed with, and a checkpoint of the last iteration that was whole.
    """

    exit_code = EXIT_FAILED

    def __init__(self, keeps: bool) -> None:
        super().__init__("the training has failed, and the first process says why")
        self.keeps = keeps


class Left(SimulationFailure):
    """Another process of the training is gone."""


@contextmanager
def communicating() -> Iterator[None]:
    """Say of an error in the body, if it came up in a word between processes, that another one is gone."""
    try:
        yield
    except Exception as error:
        if not is_communication(error):
            raise
        raise left() from error


def is_communication(error: BaseException) -> bool:
    """Return whether an error came up where processes talk to each other."""
    frames = traceback.extract_tb(error.__traceback__)
    return bool(frames) and Path(frames[-1].filename).is_relative_to(_COMMUNICATION)


def left() -> Left:
    """Return the error of a process whose others are gone."""
    return Left(
        "another process of the training has ended",
        key=f"rank {os.environ.get('RANK', '0')}",
        expected="all of them to go on; the one that ended first says why, or torchrun's table names the signal",
    )


def plain(error: WheellegError | None) -> dict[str, str | None]:
    """Return an error for people as text by name; empty for none."""
    if error is None:
        return {}
    facts = {name: getattr(error, name) for name in ("message", "key", "where", "expected", "nearest")}
    return {**facts, "failed": "yes" if error.exit_code == EXIT_FAILED else None}


def rebuilt(rank: int, told: Mapping[str, str | None], evidence: Mapping[str, Any]) -> WheellegError:
    """Return the error of another process.

    Args:
        rank: the process's number.
        told: what ``plain`` gave there.
        evidence: what it failed with.
    """
    fields = {name: told[name] for name in ("key", "where", "expected", "nearest")}
    message = f"{told['message']} [in process {rank}]"
    if told["failed"]:
        return SimulationFailure(message, evidence=evidence, **fields)
    return ConfigError(message, **fields)
