"""Progress of long work in parts of the program that may not print: workers report, and a listener shows it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from typing import TypeVar

Listener = Callable[[str, int, int], None]
_Item = TypeVar("_Item")

_listener: ContextVar[Listener | None] = ContextVar("_listener", default=None)


@contextmanager
def progress_to(listener: Listener) -> Iterator[None]:
    """Let ``listener(what, done, total)`` hear of the work that is done inside."""
    token = _listener.set(listener)
    try:
        yield
    finally:
        _listener.reset(token)


def with_progress(what: str, items: Sequence[_Item]) -> Iterable[_Item]:
    """Yield items, and tell behind each one how many of them are done.

    Args:
        what: what is being done, such as ``"making tiles"``.
        items: what it is done to.
    """
    listener = _listener.get()
    for number, item in enumerate(items, start=1):
        yield item
        if listener is not None:
            listener(what, number, len(items))
