"""Sums that come out the same whatever torch's number of threads is."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch

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
