"""Draws views of a scene in a process of its own, with the first of MuJoCo's backends that works."""

from __future__ import annotations

import os
import pickle
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

import wheelleg_exp
from wheelleg_exp.errors import SimulationFailure, WheellegError
from wheelleg_exp.rendering.render_job import READY, Order, View

BACKENDS = ("egl", "osmesa")
INSTALL = (
    "a driver that draws without a display; on Debian or Ubuntu: apt install libegl1 libgl1-mesa-dri (MUJOCO_GL=egl)"
    " or libosmesa6 (MUJOCO_GL=osmesa)"
)
_PATIENCE_S = 20.0


class NoGraphics(WheellegError):
    """No backend draws on this machine."""


class Drawing:
    """A running process that draws views."""

    def __init__(self, order: Order, backend: str, errors: IO[bytes], folder: Path) -> None:
        self.backend = backend
        self._size = (order.height, order.width, 3)
        self._errors = errors
        self._process = subprocess.Popen(
            [sys.executable, "-m", "wheelleg_exp.rendering.render_job"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=errors,
            env=_environment(backend),
            cwd=folder,  # MuJoCo leaves its log where it runs
        )
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._stdin, self._stdout = self._process.stdin, self._process.stdout
        try:
            self._send(order)
            self.is_ready = self._stdout.read(len(READY)) == READY
        except OSError:
            self.is_ready = False

    def draw(self, view: View) -> NDArray[np.uint8]:
        """Return a picture, (height, width, 3).

        Raises:
            SimulationFailure: the graphics driver gave up.
        """
        data = b""
        with suppress(OSError):
            self._send(view)
            data = self._stdout.read(int(np.prod(self._size)))
        if len(data) != np.prod(self._size):
            raise SimulationFailure(f"the graphics driver gave up while drawing ({self.backend}): {self.reason()}")
        return np.frombuffer(data, dtype=np.uint8).reshape(self._size)

    def reason(self) -> str:
        """Return the last line that the process said."""
        self._errors.seek(0)
        lines = [line for line in self._errors.read().decode(errors="replace").splitlines() if line.strip()]
        return lines[-1].strip() if lines else f"exit status {self._process.poll()}"

    def close(self) -> None:
        """End the process."""
        for stream in (self._stdin, self._stdout):
            with suppress(OSError):
                stream.close()
        try:
            self._process.wait(_PATIENCE_S if self.is_ready else 2.0)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def _send(self, what: Any) -> None:
        pickle.dump(what, self._stdin)
        self._stdin.flush()


@contextmanager
def drawing(order: Order) -> Iterator[Drawing]:
    """Yield a process that draws.

    Raises:
        NoGraphics: none of the backends works here; the message says what to install.
    """
    with tempfile.TemporaryDirectory(prefix="wheelleg-") as folder, tempfile.TemporaryFile() as errors:
        found = _first_that_works(order, errors, Path(folder))
        try:
            yield found
        finally:
            found.close()


def _first_that_works(order: Order, errors: IO[bytes], folder: Path) -> Drawing:
    reasons = []
    for backend in backends():
        candidate = Drawing(order, backend, errors, folder)
        if candidate.is_ready:
            return candidate
        candidate.close()
        reasons.append(f"{backend}: {candidate.reason()}")
        errors.seek(0)
        errors.truncate()
    raise NoGraphics(f"nothing can be drawn on this machine ({'; '.join(reasons)})", expected=INSTALL)


def backends() -> Sequence[str]:
    """Return the backends that are tried: the one that MUJOCO_GL names first."""
    wanted = os.environ.get("MUJOCO_GL", "").lower()
    return tuple(dict.fromkeys([*([wanted] if wanted in BACKENDS else []), *BACKENDS]))


def _environment(backend: str) -> dict[str, str]:
    package = str(Path(wheelleg_exp.__file__).parents[1])
    paths = [package, *filter(None, os.environ.get("PYTHONPATH", "").split(os.pathsep))]
    kept = {k: v for k, v in os.environ.items() if k != "PYOPENGL_PLATFORM"}
    return {**kept, "MUJOCO_GL": backend, "PYTHONPATH": os.pathsep.join(str(Path(p).absolute()) for p in paths)}
