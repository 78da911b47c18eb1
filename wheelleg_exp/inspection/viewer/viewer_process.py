"""Starting rerun's own viewer so that it listens on the loopback address alone and sends nothing anywhere."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import IO

from wheelleg_exp.recording.programs import rerun_program
from wheelleg_exp.recording.writing.feed import LOOPBACK, viewer_environment

_PATIENCE_S = 5.0
_TELLING = ("adapter", "panic", "error", "failed")  # words of the line that says why, best first
_COLOUR = re.compile(r"\x1b\[[0-9;]*m")


@contextmanager
def viewer(arguments: Sequence[str]) -> Iterator[tuple[subprocess.Popen[bytes], IO[bytes]]]:
    """Yield a running viewer and what it says; it is ended, with all that it started, when the body ends.

    Args:
        arguments: what it is told beside the address that it binds to.
    """
    with tempfile.TemporaryDirectory(prefix="wheelleg-viewer-") as folder, tempfile.TemporaryFile() as said:
        process = subprocess.Popen(
            [rerun_program(), "--bind", LOOPBACK, *arguments],
            stdin=subprocess.DEVNULL,
            stdout=said,
            stderr=subprocess.STDOUT,
            env=viewer_environment(),  # sends nothing, and leaves the user's settings alone
            cwd=folder,
            start_new_session=True,  # Ctrl-C is ours to answer
        )
        try:
            yield process, said
        finally:
            end(process)


def end(process: subprocess.Popen[bytes]) -> None:
    """End a process that leads its own session, and whatever it started."""
    for number in (signal.SIGTERM, getattr(signal, "SIGKILL", signal.SIGTERM)):
        _signal(process, number)
        with suppress(subprocess.TimeoutExpired):
            process.wait(_PATIENCE_S)
            break
    _signal(process, getattr(signal, "SIGKILL", signal.SIGTERM))  # those that outlived it


def last_words(said: IO[bytes]) -> str:
    """Return the line that tells best why a viewer failed."""
    said.seek(0)
    text = said.read().decode(errors="replace")
    lines = [line for line in (_COLOUR.sub("", raw).strip() for raw in text.splitlines()) if line]
    for word in _TELLING:
        if found := [line for line in lines if word in line.lower()]:
            return found[0][:300]
    return lines[-1][:300] if lines else "it said nothing"


def _signal(process: subprocess.Popen[bytes], number: int) -> None:
    with suppress(ProcessLookupError, PermissionError):
        if hasattr(os, "killpg"):
            os.killpg(process.pid, number)
        else:
            process.terminate()
