"""Launches that are none of torch's, told to whoever records what is done."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

import torch

Listener = Callable[[Callable[[], None], Sequence[torch.Tensor]], None]
_listeners: list[Listener] = []


@contextmanager
def listening(listener: Listener) -> Iterator[None]:
    """Tell somebody, within the body, of launches: how to launch again, and the tensors that it reads.

    These are the tensors that torch made for it; memory of the engine's own need not be told.
    """
    _listeners.append(listener)
    try:
        yield
    finally:
        _listeners.remove(listener)


def launched(again: Callable[[], None], reads: Sequence[torch.Tensor] = ()) -> None:
    """Say that something was launched."""
    for listener in _listeners:
        listener(again, reads)
