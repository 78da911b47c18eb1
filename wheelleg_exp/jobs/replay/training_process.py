"""The process that trains a run again: started, heard, asked to stop."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Self

from wheelleg_exp.errors import EXIT_INPUT, Interrupted, RunDirectoryError, SimulationFailure, WheellegError
from wheelleg_exp.jobs.processes import Child, Event, listen
from wheelleg_exp.jobs.replay import boot as replay_boot
from wheelleg_exp.jobs.replay.snapshot_training import Request
from wheelleg_exp.jobs.stop import StopRequest

_WAIT_S = 0.2
_PATIENCE_S = 10.0


@dataclass
class TrainingProcess:
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

    def __enter__(self) -> Self:
        # -P: nothing of the working folder is imported. The code is handed over as text, so that no file of this
        # version is among the process's modules.
        code = Path(replay_boot.__file__).read_text(encoding="utf-8")
        places = json.dumps({name: str(folder) for name, folder in self.places.items()})
        program = (sys.executable, "-P", "-c", code, places)
        self._child = Child(program, self.request.line(), self.environ, self.folder)
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
        if self.stop.requested or (ended is not None and ended["status"] == "interrupted"):
            raise Interrupted
        if ended is None:
            words = "".join(f": {line}" for line in self._child.last_words)
            raise SimulationFailure(f"the training {self._child.how_it_died()}{words}")
        if ended["status"] == "failed":
            message = f"the training from the snapshot failed: {ended['error']['message']}"
            kind: type[WheellegError] = RunDirectoryError if status == EXIT_INPUT else SimulationFailure
            raise kind(message)

    def _end(self, act: Callable[[], None], patience_s: float) -> None:
        if self._child.process.poll() is not None:
            return
        act()
        deadline = time.monotonic() + patience_s
        while self._child.process.poll() is None and time.monotonic() < deadline:
            for _ in listen([self._child], 0.05):  # it may have to be heard before it can end
                pass
