"""The process that trains a run again: started, heard, asked to stop."""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from wheelleg_exp.errors import EXIT_INPUT, Interrupted, RunDirectoryError, SimulationFailure, WheellegError
from wheelleg_exp.jobs.heard_process import HeardProcess
from wheelleg_exp.jobs.processes import Child
from wheelleg_exp.jobs.replay import restored_imports as replay_boot
from wheelleg_exp.jobs.replay.snapshot_training import Request
from wheelleg_exp.stop_request import StopRequest


@dataclass
class TrainingProcess(HeardProcess):
    """A training from a snapshot in a process of its own; left, it has ended.

    Args:
        request: what is trained.
        places: the folder of each top-level package that is imported from a restored source.
        environ: its environment variables.
        folder: its working folder.
        stop: asks to stop.
    """

    request: Request
    places: Mapping[str, Path]
    environ: Mapping[str, str]
    folder: Path
    stop: StopRequest

    def _start(self) -> Child:
        # -P: nothing of the working folder is imported. The code is handed over as text, so that no file of this
        # version is among the process's modules.
        code = Path(replay_boot.__file__).read_text(encoding="utf-8")
        places = json.dumps({name: str(folder) for name, folder in self.places.items()})
        program = (sys.executable, "-P", "-c", code, places)
        return Child(program, self.request.line(), self.environ, self.folder)

    def _require_finished(self, status: int) -> None:
        ended = self._child.ended
        if self.stop.requested or (ended is not None and ended["status"] == "interrupted"):
            raise Interrupted
        if ended is None:
            words = "".join(f": {line}" for line in self._child.last_words)
            raise SimulationFailure(f"the training {self._child.how_it_died()}{words}")
        if ended["status"] == "failed":
            message = f"the training from the snapshot failed: {ended['error']['message']}"
            kind: type[WheellegError] = RunDirectoryError if status == EXIT_INPUT else SimulationFailure
            raise kind(message)
