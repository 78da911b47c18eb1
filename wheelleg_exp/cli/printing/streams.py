"""Standard output and error: their readers may go away, and what is written obeys nobody but this program.

A command goes on without its readers, and its exit status says how it went.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any

from wheelleg_exp.errors import printable


class LastingStream:
    """A text stream that takes what is written when nobody reads it any more.

    Args:
        stream: where text goes.
        losses: the errors that mean that nobody reads it.
        styled: whether the text may hold what a terminal obeys; otherwise that is shown by its codes.
    """

    def __init__(self, stream: Any, *losses: type[OSError], styled: bool = False) -> None:
        self._stream, self._losses, self._styled = stream, losses, styled

    def styled(self) -> LastingStream:
        """Return the stream for colours and moving lines; who writes to it looks after the texts of others itself."""
        return LastingStream(self._stream, *self._losses, styled=True)

    def write(self, text: str) -> int:
        """Write a text, and return its length."""
        try:
            self._write(text if self._styled else printable(text))
        except self._losses:
            self._let_go()
        return len(text)

    def _write(self, text: str) -> None:
        """Write a text; what the stream's encoding cannot show, as ASCII cannot show °, becomes a question mark."""
        try:
            self._stream.write(text)
        except UnicodeEncodeError as error:
            self._stream.write(text.encode(error.encoding, "replace").decode(error.encoding))

    def flush(self) -> None:
        """Pass on what has been written."""
        try:
            self._stream.flush()
        except self._losses:
            self._let_go()

    def _let_go(self) -> None:
        """Point the stream at nothing, so that the interpreter's last flush does not complain."""
        with suppress(OSError, ValueError):
            descriptor = self._stream.fileno()
            null = os.open(os.devnull, os.O_WRONLY)
            os.dup2(null, descriptor)
            os.close(null)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


def styled(stream: Any) -> Any:
    """Return a standard stream for colours and moving lines (see ``LastingStream.styled``)."""
    return stream.styled() if isinstance(stream, LastingStream) else stream


@contextmanager
def lasting_streams() -> Iterator[None]:
    """Let the body's output outlast its readers: a pipe that is closed, and of what is told on standard error any loss.

    A terminal that was closed, or a full disk behind standard error, is no reason to end a training; what was asked for
    on standard output and cannot be written is one.
    """
    before = sys.stdout, sys.stderr
    sys.stdout = before[0] and LastingStream(before[0], BrokenPipeError)
    sys.stderr = before[1] and LastingStream(before[1], OSError)
    try:
        yield
    finally:
        sys.stdout, sys.stderr = before
