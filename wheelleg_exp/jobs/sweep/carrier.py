"""The far end of a job that a queue has started: it runs the job's process there, and writes down what that tells.

What passes between the machines are files of the job's folder, which both see: ``request.json`` before the job is
submitted, ``events.jsonl`` as it goes, and ``stop`` when it is to end.
"""

from __future__ import annotations

import json
import os
import socket
import sys
from collections.abc import Mapping
from concurrent.futures import Future, ThreadPoolExecutor, wait
from pathlib import Path
from typing import Any

from wheelleg_exp.jobs.processes import Child, listen
from wheelleg_exp.jobs.sweep.launchers import program_here
from wheelleg_exp.run.environment import replay_environ

REQUEST, EVENTS, STOP = "request.json", "events.jsonl", "stop"
SOON, NOW = "soon", "now"  # what STOP may hold
_WAIT_S = 0.3
_PATIENCE_S = 90.0  # of Slurm's delay between its warning and the kill, which is 120 s by default


class Carrier:
    """Runs one job; the object is what travels to the other machine, and holds nothing.

    Its process computes what it would on the machine of the sweep: variables on which numbers depend are that one's.
    """

    _child: Child | None = None
    _carried: Future[str] | None = None

    def __call__(self, folder: str) -> str:
        """Run the job whose folder it is, and return its status.

        Args:
            folder: absolute, seen by this machine as by the one that wrote it.
        """
        place = Path(folder)
        request = json.loads((place / REQUEST).read_text(encoding="utf-8"))
        if (place / EVENTS).exists():
            raise RuntimeError("the job has run already, and is not begun anew")
        self._tell(place, {"event": "began", "host": socket.gethostname(), "pid": os.getpid()})
        same = all(Path(entry).exists() for entry in request["path"])  # else this machine's own installation
        path = request["path"] if same else sys.path
        environ = replay_environ(request["variables"])
        self._child = Child(
            program_here(path), request["line"].encode() + b"\n", environ, Path(request["working_directory"])
        )
        with ThreadPoolExecutor(1) as reader:  # which no signal interrupts
            self._carried = reader.submit(self._carry, self._child, place)
            return self._carried.result()

    def checkpoint(self, folder: str) -> None:
        """Let the job stop with a checkpoint: its time is over. It is not begun again."""
        del folder
        if self._child is not None and self._carried is not None:
            self._child.ask_to_stop()
            if not wait([self._carried], _PATIENCE_S).done:
                self._child.kill()

    def _carry(self, child: Child, place: Path) -> str:
        asked = ""
        while child.process.poll() is None:
            self._pass_on(child, place, _WAIT_S)
            wanted = _text(place / STOP)
            if wanted != asked:
                child.ask_to_stop() if wanted == SOON else child.interrupt()
                asked = wanted
        self._pass_on(child, place, 0.0)
        child.close()
        ended = child.ended or {"event": "ended", "status": "failed", "error": _died(child)}
        self._tell(place, ended)
        return str(ended["status"])

    def _pass_on(self, child: Child, place: Path, wait_s: float) -> None:
        for _, event in listen([child], wait_s):
            self._tell(place, event)

    def _tell(self, place: Path, event: Mapping[str, Any]) -> None:
        with (place / EVENTS).open("a", encoding="utf-8") as file:
            file.write(json.dumps(event) + "\n")


def _died(child: Child) -> dict[str, str]:
    words = "".join(f": {line.strip()}" for line in [*child.last_words][-1:])
    return {"type": "error", "message": f"its process on {socket.gethostname()} {child.how_it_died()}{words}"}


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except OSError:
        return ""
