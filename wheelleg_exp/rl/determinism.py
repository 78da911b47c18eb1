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
    """Raise ConfigError if the body draws from a global generator: ``torch``, ``numpy``, ``python`` (default: all).

    A manager term that draws from torch's global generator would change the policy's exploration noise. The generators
    of NumPy and Python are not seeded, so their numbers differ between runs.
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


_STATES: dict[str, Callable[[], Any]] = {
    "torch": lambda: torch.get_rng_state().numpy().tobytes(),
    "numpy": lambda: [np.asarray(part).tobytes() for part in np.random.get_state(legacy=True)],
    "python": random.getstate,
}


# Torch splits a sum with more addends than `SPLIT_ABOVE` among threads, so that the sum depends on the thread count.
# `SPLIT_ABOVE` equals the constant at::internal::GRAIN_SIZE in torch's C++ code.
SPLIT_ABOVE = 32768


@contextmanager
def one_thread() -> Iterator[None]:
    """Make torch use one thread inside a ``with`` block, so that sums do not depend on the number of threads."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
