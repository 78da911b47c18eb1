"""Guards that keep a training reproducible: no draws from global generators, sums that use one thread."""

from __future__ import annotations

import random
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch

from wheelleg_exp.errors import ConfigError


@contextmanager
def no_global_draws(*generators: str) -> Iterator[None]:
    """Refuse a body that moves a global generator.

    The policy draws its exploration from torch's: an environment that does so as well changes the policy's draws, and
    each of its terms those of all others. No seed of a run sets numpy's and Python's. Looking at torch's takes some
    microseconds, at Python's some tens.

    Args:
        generators: which ones, of ``torch``, ``numpy`` and ``python``; all when none is named.

    Raises:
        ConfigError: the body moved one, naming it.
    """
    watched = generators or tuple(_STATES)
    before = [_STATES[name]() for name in watched]
    yield
    moved = [name for name, state in zip(watched, before, strict=True) if _STATES[name]() != state]
    if moved:
        raise ConfigError(
            f"a term draws random numbers from the global generator of {' and '.join(moved)}",
            key="env",
            expected="draws from the term's own stream: a parameter 'generator' of the term receives it, and "
            "torch.rand(..., generator=generator) uses it",
        )


def _numpy() -> tuple[Any, ...]:
    kind, keys, *rest = np.random.get_state(legacy=True)
    return kind, np.asarray(keys).tobytes(), *rest


_STATES: dict[str, Callable[[], Any]] = {
    "torch": lambda: torch.get_rng_state().numpy().tobytes(),
    "numpy": _numpy,
    "python": random.getstate,
}


# Above this many numbers torch splits a sum or a mean over everything among its threads, so that their count decides
# the order of the additions (at::internal::GRAIN_SIZE).
SPLIT_ABOVE = 32768


@contextmanager
def one_thread() -> Iterator[None]:
    """Let torch work with one thread in the body."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
