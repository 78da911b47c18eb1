"""A job in a process of its own: told on standard input what to do, it tells on the output how it goes.

The first line of the input is a request in JSON; its end asks the job to stop, so that a job whose parent was killed
stops as well. Every line of the output is one event in JSON; what else is printed goes to standard error.
"""

from __future__ import annotations

import json
import os
import threading
from collections.abc import Callable
from io import FileIO
from typing import TYPE_CHECKING, Any, TypeVar

from wheelleg_exp.errors import EXIT_FAILED, EXIT_INTERRUPTED, EXIT_OK, WheellegError
from wheelleg_exp.jobs.stop import StopRequest
from wheelleg_exp.threads import prepare_threads

if TYPE_CHECKING:
    from wheelleg_exp.rl.trainer import Iteration


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
    except KeyboardInterrupt:
        if not events.reached:
            events.send("ended", status="interrupted", error=None)
            return EXIT_INTERRUPTED
    except Exception as error:
        events.send("ended", status="failed", error={"type": type(error).__name__, "message": str(error)})
        return error.exit_code if isinstance(error, WheellegError) else EXIT_FAILED
    events.send("ended", status="finished", error=None)
    return EXIT_OK
