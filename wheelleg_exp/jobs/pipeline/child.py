"""The process of one step of a pipeline: started, heard, asked to stop."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from types import TracebackType
from typing import Self

from wheelleg_exp.errors import EXIT_INPUT, Interrupted, RunDirectoryError, SimulationFailure, WheellegError
from wheelleg_exp.jobs.pipeline.job import Step
from wheelleg_exp.jobs.processes import Child, Event, listen
from wheelleg_exp.jobs.stop import StopRequest

# The step imports what this process would import, whatever folder it is called from.
_BOOT = (
    "import os, sys; sys.path[:] = sys.argv.pop().split(os.pathsep); "
    "from wheelleg_exp.jobs.pipeline.job import main; sys.exit(main())"
)
_WAIT_S = 0.2
_PATIENCE_S = 10.0


@dataclass
class StepProcess:
    """A step in a process of its own; left, it has ended.

    Args:
        step: what is done.
        stop: asks to stop; a training stops at its next whole iteration, with a checkpoint.
        program: the command that does it, by default ``job`` under this interpreter.
    """

    step: Step
    stop: StopRequest
    program: Sequence[str] | None = None

    def __enter__(self) -> Self:
        program = self.program or (sys.executable, "-P", "-c", _BOOT, os.pathsep.join(sys.path))
        self._child = Child(program, self.step.line(), os.environ)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """End what still runs: politely, then at once, then by force."""
        try:
            self._end(self._child.ask_to_stop, 0.0 if self.stop.requested else _PATIENCE_S)
            self._end(self._child.interrupt, _PATIENCE_S)
        finally:
            self._child.kill()
            self._child.process.wait()
            self._child.close()

    def events(self) -> Iterator[Event]:
        """Yield what it tells; its lines for people come as ``note``.

        Raises:
            WheellegError: it failed, with the exit status that it had.
            Interrupted: it was stopped.
        """
        while self._child.open:
            if self.stop.requested:
                self._child.ask_to_stop()
            for _, event in listen([self._child], _WAIT_S):
                yield event
        self._require_finished(self._child.process.wait())

    def _require_finished(self, status: int) -> None:
        ended = self._child.ended
        if ended is None:
            if self.stop.requested:
                raise Interrupted
            words = "".join(f": {line}" for line in self._child.last_words)
            raise SimulationFailure(f"its process {self._child.how_it_died()}{words}")
        if ended["status"] == "interrupted":
            raise Interrupted
        if ended["status"] == "failed":
            kind: type[WheellegError] = RunDirectoryError if status == EXIT_INPUT else SimulationFailure
            raise kind(str(ended["error"]["message"]))

    def _end(self, act: Callable[[], None], patience_s: float) -> None:
        if self._child.process.poll() is not None:
            return
        act()
        deadline = time.monotonic() + patience_s
        while self._child.process.poll() is None and time.monotonic() < deadline:
            for _ in listen([self._child], 0.05):  # it may have to be heard before it can end
                pass
