"""A job in a process of its own, both ends: told on its input what to do, it tells on its output how it goes.

The first line of the input is a request in JSON; its end asks the job to stop, so that a job whose parent was killed
stops as well. Every line of the output is one event in JSON; what else is printed goes to standard error.
"""

from __future__ import annotations

import contextlib
import json
import os
import selectors
import signal
import subprocess
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from io import FileIO
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, TypeVar, cast

from wheelleg_exp.errors import EXIT_FAILED, EXIT_INTERRUPTED, EXIT_OK, Interrupted, WheellegError
from wheelleg_exp.machine import prepare_threads
from wheelleg_exp.stop_request import StopRequest

if TYPE_CHECKING:
    from wheelleg_exp.rl.trainer import Iteration

Event = dict[str, Any]
_LAST_WORDS = 3
_CHUNK = 1 << 16


# --- the job's end ---


class Events:
    """Sends events to the parent; a display for the training.

    Attributes:
        reached: whether the job has done all that was asked for, so that its stop is no interruption.
    """

    reached = False

    def __init__(self, descriptor: int) -> None:
        self._file = FileIO(descriptor, "w", closefd=False)

    def send(self, event: str, **facts: Any) -> None:
        """Send one event; a parent that is gone hears nothing."""
        line = json.dumps({"event": event, **facts}, default=float) + "\n"
        data = memoryview(line.encode())
        try:
            while data:
                data = data[self._file.write(data) :]
        except OSError:
            pass

    def environment(self, description: str) -> None:
        """Pass the managers' tables over."""

    def note(self, text: str) -> None:
        """Send one line for people."""
        self.send("note", text=text)

    def iteration(self, iteration: Iteration, total: int) -> None:
        """Send that a training iteration is done."""
        self.send("iteration", done=iteration.index + 1, total=total, scalars=iteration.scalars)

    def steps(self, done: int, total: int) -> None:
        """Pass rollouts over: a training has none."""


E = TypeVar("E", bound=Events)


def serve(events_of: Callable[[int, StopRequest], E], job: Callable[[E, bytes, StopRequest], None]) -> int:
    """Do what the first line of standard input asks for, and return the exit status.

    Args:
        events_of: makes the events from the descriptor that they go to.
        job: does the work, given the events, the line and the request to stop.
    """
    prepare_threads()
    descriptor = os.dup(1)
    os.dup2(2, 1)
    with StopRequest() as stop:
        events = events_of(descriptor, stop)
        source = FileIO(0, "r", closefd=False)
        line = source.readline()
        threading.Thread(target=_stop_at_end, args=(source, stop), daemon=True).start()
        return _ended(events, lambda: job(events, line, stop))


def _stop_at_end(source: FileIO, stop: StopRequest) -> None:
    while source.read(1):
        pass
    stop.requested = True


def _ended(events: Events, work: Callable[[], None]) -> int:
    """Work and tell how it ended."""
    try:
        work()
    except Interrupted:
        if not events.reached:
            events.send("ended", status="interrupted", error=None)
            return EXIT_INTERRUPTED
    except BaseException as error:
        events.send("ended", status="failed", error={"type": type(error).__name__, "message": str(error)})
        return error.exit_code if isinstance(error, WheellegError) else EXIT_FAILED
    events.send("ended", status="finished", error=None)
    return EXIT_OK


# --- the end of the process that has started it ---


class Child:
    """A job's process: told what to do, heard without waiting, asked to stop.

    It is a group of its own, so that Ctrl-C reaches this process alone, which asks the job to stop at its next whole
    iteration; asked twice it stops at once.

    Args:
        program: the command that runs it.
        request: the line that says what to do.
        environ: its environment variables.
        folder: its working folder, by default this process's own.

    Attributes:
        process: the process.
        ended: what the job has told of its end; None when it has not.
        last_words: its last lines on standard error.
    """

    def __init__(
        self, program: Sequence[str], request: bytes, environ: Mapping[str, str], folder: Path | None = None
    ) -> None:
        self.process = subprocess.Popen(
            program,
            env=dict(environ),
            cwd=folder,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            process_group=0,
        )
        self.ended: Event | None = None
        self.last_words: deque[str] = deque(maxlen=_LAST_WORDS)
        pipes = (self.process.stdin, self.process.stdout, self.process.stderr)
        self._input, self._output, self._errors = cast(tuple[IO[bytes], ...], pipes)
        self.open = {self._output: b"", self._errors: b""}  # with the beginning of a line that is not whole yet
        for pipe in self.open:
            os.set_blocking(pipe.fileno(), False)
        with contextlib.suppress(OSError):  # it may be gone already; how it ended says so
            self._input.write(request)
            self._input.flush()

    def ask_to_stop(self) -> None:
        """Let the job stop at its next whole iteration."""
        with contextlib.suppress(OSError):
            self._input.close()

    def interrupt(self) -> None:
        """Let a job that has been asked to stop do so at once: it takes this as the second time."""
        self.process.send_signal(signal.SIGTERM)  # a background shell lets it ignore SIGINT

    def kill(self) -> None:
        """End the process."""
        self.process.kill()

    def over(self) -> bool:
        """Return whether the process has ended."""
        return self.process.poll() is not None

    def end_now(self) -> None:
        """End the process, and leave nothing of it."""
        self.kill()
        self.process.wait()

    def close(self) -> None:
        """Close the pipes."""
        self.open = {}
        self.ask_to_stop()
        self._output.close()
        self._errors.close()

    def read(self, pipe: IO[bytes]) -> Iterator[Event]:
        """Yield what has come through a pipe by now; its lines for people come as ``note``."""
        for line in self._lines(pipe):
            if pipe is self._errors:
                self.last_words.append(line)
                yield {"event": "note", "text": line}
            elif (told := event_of(line)) is not None:
                if told["event"] == "ended":
                    self.ended = told
                else:
                    yield told

    def how_it_died(self) -> str:
        """Return how a job ended that did not say so itself."""
        code = self.process.wait()
        if code >= 0:
            return f"ended with status {code} and did not say why"
        name = signal.Signals(-code).name
        return f"was ended by {name}" + (" (out of memory?)" if name == "SIGKILL" else "")

    def _lines(self, pipe: IO[bytes]) -> list[str]:
        found = self.open.pop(pipe)
        try:
            while chunk := os.read(pipe.fileno(), _CHUNK):
                found += chunk
            found += b"\n"
        except BlockingIOError:  # more may come
            found, _, self.open[pipe] = found.rpartition(b"\n")
        return [line.decode(errors="replace").rstrip() for line in found.split(b"\n") if line.strip()]


def listen(children: Iterable[Child], wait_s: float) -> Iterator[tuple[Child, Event]]:
    """Yield what children have told by now, having waited for a first word no longer than ``wait_s``."""
    with selectors.DefaultSelector() as selector:
        for child in children:
            for pipe in child.open:
                selector.register(pipe, selectors.EVENT_READ, child)
        ready = selector.select(wait_s)
    for key, _ in ready:
        for event in key.data.read(key.fileobj):
            yield key.data, event


def event_of(line: str) -> Event | None:
    """Return the event that a job has told on a line; None for a line that is none, as one cut off by a kill."""
    try:
        told = json.loads(line)
    except (ValueError, RecursionError):
        return None
    return told if isinstance(told, dict) and isinstance(told.get("event"), str) else None
