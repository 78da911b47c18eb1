"""The process of one step of a pipeline: started, heard, asked to stop."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass

from wheelleg_exp.errors import EXIT_INPUT, Interrupted, RunDirectoryError, SimulationFailure, WheellegError
from wheelleg_exp.jobs.heard_process import HeardProcess
from wheelleg_exp.jobs.pipeline.job import Step
from wheelleg_exp.jobs.processes import Child
from wheelleg_exp.machine import own_environ
from wheelleg_exp.stop_request import StopRequest

# The step imports what this process would import, whatever folder it is called from.
_BOOT = (
    "import os, sys; sys.path[:] = sys.argv.pop().split(os.pathsep); "
    "from wheelleg_exp.jobs.pipeline.job import main; sys.exit(main())"
)


@dataclass
class StepProcess(HeardProcess):
    """A step in a process of its own; left, it has ended.

    Args:
        step: what is done.
        stop: asks to stop; a training stops at its next whole iteration, with a checkpoint.
        program: the command that does it, by default ``job`` under this interpreter.
    """

    step: Step
    stop: StopRequest
    program: Sequence[str] | None = None

    def _start(self) -> Child:
        program = self.program or (sys.executable, "-P", "-c", _BOOT, os.pathsep.join(sys.path))
        return Child(program, self.step.line(), own_environ())

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
