"""Progress of long work in code that may not print: workers report progress, and a listener shows it."""

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
    """Call ``listener(what, done, total)`` when work inside the ``with`` block reports progress."""
    token = _listener.set(listener)
    try:
        yield
    finally:
        _listener.reset(token)


def with_progress(what: str, items: Sequence[_Item]) -> Iterable[_Item]:
    """Yield items; after each one, report the number of finished items. ``what`` names the work: ``"making tiles"``."""
    listener = _listener.get()
    for number, item in enumerate(items, start=1):
        yield item
        if listener is not None:
            listener(what, number, len(items))
