"""Draw views of a scene in a child process, with the first MuJoCo backend that works."""

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
from wheelleg_exp.errors import ConfigError, SimulationFailure, WheellegError
from wheelleg_exp.rendering.render_job import READY, Order, View


def too_many(num_envs: int, limit: int, sensor_key: str) -> ConfigError | None:
    """Return the error for more environments than a camera may draw, or None.

    ``limit`` is the camera's ``max_num_envs``.
    """
    if num_envs <= limit:
        return None
    return ConfigError(
        f"{num_envs} environments would be drawn one after another at every reading",
        key=f"{sensor_key}.max_num_envs",
        expected=f"env.num_envs at most {limit}, or a higher limit here; a RayCasterCamera is fast for many",
    )


BACKENDS = ("egl", "osmesa")
INSTALL = (
    "a driver that draws without a display; on Debian or Ubuntu: apt install libegl1 libgl1-mesa-dri (MUJOCO_GL=egl)"
    " or libosmesa6 (MUJOCO_GL=osmesa)"
)
_PATIENCE_S = 20.0


class NoGraphics(WheellegError):
    """No MuJoCo backend can draw on this machine."""


class Worker:
    """A child process with a graphics driver that answers requests with bytes.

    Args:
        module: its module. It reads an order from standard input, writes ``READY``, and then answers requests.
        order: the first object that it reads.
        backend: MuJoCo's backend.
        errors: the file of its standard error.
        folder: its working directory.
    """

    def __init__(self, module: str, order: Any, backend: str, errors: IO[bytes], folder: Path) -> None:
        self.backend = backend
        self._errors = errors
        self._process = subprocess.Popen(
            [sys.executable, "-m", module],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=errors,
            env=_environment(backend),
            cwd=folder,  # MuJoCo writes its log into the working directory
        )
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._stdin, self._stdout = self._process.stdin, self._process.stdout
        try:
            self._send(order)
            self.is_ready = self._stdout.read(len(READY)) == READY
        except OSError:
            self.is_ready = False

    def ask(self, what: Any, count: int) -> bytes:
        """Send a request and return ``count`` bytes of its answer.

        Raises:
            SimulationFailure: the graphics driver failed.
        """
        data = b""
        with suppress(OSError):
            self._send(what)
            data = self._stdout.read(count)
        if len(data) != count:
            raise SimulationFailure(f"the graphics driver failed while drawing ({self.backend}): {self.reason()}")
        return data

    def reason(self) -> str:
        """Return the last line of the process's error output."""
        self._errors.seek(0)
        lines = [line for line in self._errors.read().decode(errors="replace").splitlines() if line.strip()]
        return lines[-1].strip() if lines else f"exit status {self._process.poll()}"

    def close(self) -> None:
        """Stop the process."""
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


class Drawing:
    """Draw views in a worker."""

    def __init__(self, worker: Worker, order: Order) -> None:
        self._worker, self._size = worker, (order.height, order.width, 3)
        self.backend = worker.backend

    def draw(self, view: View) -> NDArray[np.uint8]:
        """Return a picture, (height, width, 3).

        Raises:
            SimulationFailure: the graphics driver failed.
        """
        data = self._worker.ask(view, int(np.prod(self._size)))
        return np.frombuffer(data, dtype=np.uint8).reshape(self._size)


@contextmanager
def drawing(order: Order) -> Iterator[Drawing]:
    """Yield an object that draws views of a scene.

    Raises:
        NoGraphics: no backend works here; the message names the packages to install.
    """
    with working("wheelleg_exp.rendering.render_job", order) as worker:
        yield Drawing(worker, order)


@contextmanager
def working(module: str, order: Any) -> Iterator[Worker]:
    """Yield a child process with a working graphics driver (see ``Worker``).

    Raises:
        NoGraphics: no backend works here; the message names the packages to install.
    """
    with tempfile.TemporaryDirectory(prefix="wheelleg-") as folder, tempfile.TemporaryFile() as errors:
        found = _first_that_works(module, order, errors, Path(folder))
        try:
            yield found
        finally:
            found.close()


def _first_that_works(module: str, order: Any, errors: IO[bytes], folder: Path) -> Worker:
    reasons = []
    for backend in backends():
        candidate = Worker(module, order, backend, errors, folder)
        if candidate.is_ready:
            return candidate
        candidate.close()
        reasons.append(f"{backend}: {candidate.reason()}")
        errors.seek(0)
        errors.truncate()
    raise NoGraphics(f"drawing is not possible on this machine ({'; '.join(reasons)})", expected=INSTALL)


def backends() -> Sequence[str]:
    """Return the backends to try, the one in MUJOCO_GL first."""
    wanted = os.environ.get("MUJOCO_GL", "").lower()
    return tuple(dict.fromkeys([*([wanted] if wanted in BACKENDS else []), *BACKENDS]))


def _environment(backend: str) -> dict[str, str]:
    package = str(Path(wheelleg_exp.__file__).parents[1])
    paths = [package, *filter(None, os.environ.get("PYTHONPATH", "").split(os.pathsep))]
    kept = {k: v for k, v in os.environ.items() if k != "PYOPENGL_PLATFORM"}
    return {**kept, "MUJOCO_GL": backend, "PYTHONPATH": os.pathsep.join(str(Path(p).absolute()) for p in paths)}
