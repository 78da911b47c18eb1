"""Exceptions from users' code: such code cannot end the program as if all had gone well."""

from __future__ import annotations

import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager

from wheelleg_exp.errors import ConfigError, Interrupted, WheellegError

_ORDINARY = "code that returns, or raises an ordinary error"


@contextmanager
def ending_as(kind: type[WheellegError], key: str | None = None) -> Iterator[None]:
    """Turn what would end the program from within the body into an error of ``kind``.

    That is ``SystemExit`` and whatever else is no ``Exception``, and a ``KeyboardInterrupt`` that nobody asked for.

    Raises:
        WheellegError: of ``kind``, with what was raised and its place in the code.
    """
    try:
        yield
    except BaseException as error:
        if isinstance(error, Exception) or is_interrupt(error):
            raise
        message = f"{in_words(error)} would end the program"
        raise kind(message, key=key, where=place(error), expected=_ORDINARY) from error


def is_interrupt(error: BaseException) -> bool:
    """Return whether somebody has asked the program to stop; code may raise a ``KeyboardInterrupt`` of its own."""
    asked = isinstance(error, Interrupted) or signal.getsignal(signal.SIGINT) is signal.default_int_handler
    return isinstance(error, KeyboardInterrupt) and asked


def in_words(error: BaseException) -> str:
    """Return what an exception is, what it says, and what has been noted of it."""
    if isinstance(error, WheellegError):
        return str(error)
    told = f"{type(error).__name__}: {error}" if str(error) else type(error).__name__
    return "".join([told, *(f", {note}" for note in getattr(error, "__notes__", ()))])


def place(error: BaseException) -> str | None:
    """Return file and line from which an exception came."""
    trace = error.__traceback__
    while trace is not None and trace.tb_next is not None:
        trace = trace.tb_next
    return None if trace is None else f"{trace.tb_frame.f_code.co_filename}:{trace.tb_lineno}"


@contextmanager
def importing(what: str) -> Iterator[None]:
    """Import in the body what may be a user's, and give the program its standard streams back.

    Raises:
        ConfigError: it would end the program, or has closed a standard stream. Exceptions of its own pass.
    """
    streams = {"stdout": sys.stdout, "stderr": sys.stderr}
    try:
        with ending_as(ConfigError):
            yield
    finally:
        for stream, own in streams.items():
            setattr(sys, stream, own)
    closed = [stream for stream, own in streams.items() if getattr(own, "closed", False)]
    if closed:
        raise ConfigError(f"'{what}' closes the program's {closed[0]} when it is imported", expected="open streams")
