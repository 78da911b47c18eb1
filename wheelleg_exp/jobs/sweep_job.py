"""One job of a sweep, in a process of its own: told on standard input what to train, it tells on the output how.

The first line of the input is a ``Request`` in JSON; its end asks the job to stop, so that a job whose parent was
killed stops as well. Every line of the output is one event in JSON; what else is printed goes to standard error.
"""

from __future__ import annotations

import json
import os
import sys
import threading
from dataclasses import asdict, dataclass
from io import FileIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

from wheelleg_exp.errors import EXIT_FAILED, EXIT_INTERRUPTED, EXIT_OK, ConfigError, WheellegError
from wheelleg_exp.jobs.stop import StopRequest
from wheelleg_exp.threads import prepare_threads

if TYPE_CHECKING:
    from wheelleg_exp.rl.trainer import Iteration


@dataclass(frozen=True)
class Request:
    """What a job trains.

    Attributes:
        overrides: the job's overrides.
        config_dirs: the user's config folders, as seen from the working folder.
        command: the command line that trains it alone.
        digest: digest of the config that was checked.
    """

    overrides: list[str]
    config_dirs: list[str]
    command: list[str]
    digest: str

    def line(self) -> bytes:
        """Return the request as one line."""
        return json.dumps(asdict(self)).encode() + b"\n"


class Events:
    """Sends events to the sweep; a display for the training."""

    def __init__(self, descriptor: int) -> None:
        self._file = FileIO(descriptor, "w", closefd=False)

    def send(self, event: str, **facts: Any) -> None:
        """Send one event; a sweep that is gone hears nothing."""
        line = json.dumps({"event": event, **facts}, default=float) + "\n"
        data = memoryview(line.encode())
        try:
            while data:
                data = data[self._file.write(data) :]
        except OSError:
            pass

    def environment(self, description: str) -> None:
        """Pass the managers' tables over: a sweep has many."""

    def note(self, text: str) -> None:
        """Send one line for people."""
        self.send("note", text=text)

    def iteration(self, iteration: Iteration, total: int) -> None:
        """Send that a training iteration is done."""
        self.send("iteration", done=iteration.index + 1, total=total, scalars=iteration.scalars)

    def steps(self, done: int, total: int) -> None:
        """Pass rollouts over: a training has none."""


def main() -> int:
    """Train what the first line of standard input asks for, and return the exit status."""
    prepare_threads()
    events = Events(os.dup(1))
    os.dup2(2, 1)
    with StopRequest() as stop:
        source = FileIO(0, "r", closefd=False)
        request = Request(**json.loads(source.readline()))
        threading.Thread(target=_stop_at_end, args=(source, stop), daemon=True).start()
        return _ended(events, request, stop)


def _stop_at_end(source: FileIO, stop: StopRequest) -> None:
    while source.read(1):
        pass
    stop.requested = True


def _ended(events: Events, request: Request, stop: StopRequest) -> int:
    """Train and tell how it ended."""
    try:
        _train(events, request, stop)
    except KeyboardInterrupt:
        events.send("ended", status="interrupted", error=None)
        return EXIT_INTERRUPTED
    except Exception as error:
        events.send("ended", status="failed", error={"type": type(error).__name__, "message": str(error)})
        return error.exit_code if isinstance(error, WheellegError) else EXIT_FAILED
    events.send("ended", status="finished", error=None)
    return EXIT_OK


def _train(events: Events, request: Request, stop: StopRequest) -> None:
    from wheelleg_exp.config.collect import compose_valid
    from wheelleg_exp.config.sweep import digest_of
    from wheelleg_exp.projects import with_current

    folders = with_current([Path(folder) for folder in request.config_dirs])
    composed = compose_valid(request.overrides, config_dirs=folders)
    if digest_of(composed) != request.digest:
        raise ConfigError(
            "the config files have changed since the sweep was checked",
            expected="files that stay as they are until the last job has begun",
        )

    from wheelleg_exp.jobs import training
    from wheelleg_exp.physics.report import examine

    stop.check()
    ready = training.prepare(composed, request.command, events)
    events.send("run", path=str(ready.directory.path))
    for finding in examine(composed).open:
        events.note(f"warning: {finding.line()}")
    training.run(ready, events, stop)


if __name__ == "__main__":
    sys.exit(main())
