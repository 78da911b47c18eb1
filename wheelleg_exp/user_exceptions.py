"""Convert ``SystemExit`` and similar exceptions that user-defined code raises to this package's errors."""

from __future__ import annotations

import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager

from wheelleg_exp.errors import ConfigError, Interrupted, WheellegError

_ORDINARY = "code that returns, or raises an ordinary error"


@contextmanager
def ending_as(kind: type[WheellegError], key: str | None = None) -> Iterator[None]:
    """Inside the ``with`` block, convert an exception that would end the program to an error of the class ``kind``.

    ``SystemExit`` or ``KeyboardInterrupt`` from user-defined code would end the program. The new error names the
    original exception, and the file and line at which it was raised.
    """
    try:
        yield
    except BaseException as error:
        if isinstance(error, Exception) or is_interrupt(error):
            raise
        message = f"{in_words(error)} would end the program"
        raise kind(message, key=key, where=place(error), expected=_ORDINARY) from error


def is_interrupt(error: BaseException) -> bool:
    """Return whether the user stopped the program. A KeyboardInterrupt of user-defined code does not count."""
    asked = isinstance(error, Interrupted) or signal.getsignal(signal.SIGINT) is signal.default_int_handler
    return isinstance(error, KeyboardInterrupt) and asked


def in_words(error: BaseException) -> str:
    """Return a text with the class, the message and the notes of an exception."""
    if isinstance(error, WheellegError):
        return str(error)
    text = f"{type(error).__name__}: {error}" if str(error) else type(error).__name__
    return "".join([text, *(f", {note}" for note in getattr(error, "__notes__", ()))])


def place(error: BaseException) -> str | None:
    """Return the file and line of the code that raised an exception."""
    trace = error.__traceback__
    while trace is not None and trace.tb_next is not None:
        trace = trace.tb_next
    return None if trace is None else f"{trace.tb_frame.f_code.co_filename}:{trace.tb_lineno}"


@contextmanager
def importing(what: str) -> Iterator[None]:
    """Restore the standard streams after an import; a module that closes them or ends the program is an error."""
    streams = {"stdout": sys.stdout, "stderr": sys.stderr}
    try:
        with ending_as(ConfigError):
            yield
    finally:
        for stream, own in streams.items():
            setattr(sys, stream, own)
    closed = [stream for stream, own in streams.items() if getattr(own, "closed", False)]
    if closed:
        raise ConfigError(f"the import of '{what}' closes the standard stream {closed[0]}", expected="open streams")
