"""The process that trains a run again: started, heard, asked to stop."""

from __future__ import annotations

import contextlib
import json
import queue
import signal
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import IO, Any, Self

from wheelleg_exp.errors import EXIT_INPUT, RunDirectoryError, SimulationFailure, WheellegError
from wheelleg_exp.jobs import replay_boot
from wheelleg_exp.jobs.snapshot_training import Request
from wheelleg_exp.jobs.stop import StopRequest

_WAIT_S = 0.2
_PATIENCE_S = 10.0
_LAST_WORDS = 3

Event = dict[str, Any]


@dataclass
class TrainingProcess:
    """A training from a snapshot in a process of its own; left, it has ended.

    It is a group of its own, so that Ctrl-C reaches this process alone, which asks it to stop at its next whole
    iteration; asked twice it stops at once.

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
    _told: queue.Queue[tuple[str, str | None]] = field(default_factory=queue.Queue, init=False)
    _last_words: deque[str] = field(default_factory=lambda: deque(maxlen=_LAST_WORDS), init=False)

    def __enter__(self) -> Self:
        # -P: nothing of the working folder is imported. The code is handed over as text, so that no file of this
        # version is among the process's modules.
        code = Path(replay_boot.__file__).read_text(encoding="utf-8")
        places = json.dumps({name: str(folder) for name, folder in self.places.items()})
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-c", code, places],
            env=dict(self.environ),
            cwd=self.folder,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            process_group=0,
        )
        for name, pipe in (("event", self._process.stdout), ("error", self._process.stderr)):
            threading.Thread(target=self._read, args=(name, pipe), daemon=True).start()
        with contextlib.suppress(OSError):  # it may be gone already; how it ended says so
            self._input.write(self.request.line())
            self._input.flush()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """End what still runs: politely, then at once, then by force."""
        try:
            self._end(self._ask_to_stop, 0.0 if self.stop.requested else _PATIENCE_S)
            self._end(self._interrupt, _PATIENCE_S)
        finally:
            self._process.kill()
            self._process.wait()
            self._ask_to_stop()  # closes the pipe

    def events(self) -> Iterator[Event]:
        """Yield what it tells; its lines for people come as ``note``.

        Raises:
            WheellegError: it failed, with the exit status that it had.
            KeyboardInterrupt: it was stopped.
        """
        ended: Event | None = None
        open_pipes = 2
        while open_pipes:
            if self.stop.requested:
                self._ask_to_stop()
            try:
                name, line = self._told.get(timeout=_WAIT_S)
            except queue.Empty:
                continue
            if line is None:
                open_pipes -= 1
            elif name == "error":
                self._last_words.append(line)
                yield {"event": "note", "text": line}
            else:
                told = json.loads(line)
                if told["event"] == "ended":
                    ended = told
                else:
                    yield told
        self._require_finished(ended, self._process.wait())

    def _require_finished(self, ended: Event | None, status: int) -> None:
        if self.stop.requested or (ended is not None and ended["status"] == "interrupted"):
            raise KeyboardInterrupt
        if ended is None:
            raise SimulationFailure(
                f"the training {_how_it_died(status)}" + "".join(f": {w}" for w in self._last_words)
            )
        if ended["status"] == "failed":
            message = f"the training from the snapshot failed: {ended['error']['message']}"
            kind: type[WheellegError] = RunDirectoryError if status == EXIT_INPUT else SimulationFailure
            raise kind(message)

    @property
    def _input(self) -> IO[bytes]:
        assert self._process.stdin is not None
        return self._process.stdin

    def _read(self, name: str, pipe: IO[bytes]) -> None:
        with pipe:
            for line in pipe:
                if line.strip():
                    self._told.put((name, line.decode(errors="replace").rstrip()))
        self._told.put((name, None))

    def _ask_to_stop(self) -> None:
        with contextlib.suppress(OSError):
            self._input.close()

    def _interrupt(self) -> None:
        self._process.send_signal(signal.SIGINT)

    def _end(self, act: Any, patience_s: float) -> None:
        if self._process.poll() is not None:
            return
        act()
        deadline = time.monotonic() + patience_s
        while self._process.poll() is None and time.monotonic() < deadline:
            time.sleep(0.05)


def _how_it_died(code: int) -> str:
    if code >= 0:
        return f"ended with status {code} and did not say why"
    name = signal.Signals(-code).name
    return f"was ended by {name}" + (" (out of memory?)" if name == "SIGKILL" else "")
