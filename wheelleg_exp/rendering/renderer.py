"""Draw pictures of a scene in a child process, with the first graphics backend of MuJoCo that works."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import IO

import numpy as np
from numpy.typing import NDArray

import wheelleg_exp
from wheelleg_exp.child_process import Worker
from wheelleg_exp.errors import ConfigError, SimulationFailure, WheellegError
from wheelleg_exp.rendering.render_job import Order, View


def too_many(num_envs: int, limit: int, sensor_key: str) -> ConfigError | None:
    """Return an error if the number of environments exceeds the ``max_num_envs`` of a camera sensor, else None."""
    if num_envs <= limit:
        return None
    message = f"{num_envs} environments would be drawn one after another at every reading"
    expected = f"env.num_envs at most {limit}, or a higher limit here; a RayCasterCamera is fast for many"
    return ConfigError(message, key=f"{sensor_key}.max_num_envs", expected=expected)


BACKENDS = ("egl", "osmesa")
INSTALL = (
    "a driver that draws without a display; on Debian or Ubuntu: apt install libegl1 libgl1-mesa-dri (MUJOCO_GL=egl)"
    " or libosmesa6 (MUJOCO_GL=osmesa)"
)


class NoGraphics(WheellegError):
    """The error for a machine on which no graphics backend of MuJoCo works."""


class GraphicsWorker(Worker):
    """A child process that draws with a graphics driver; MuJoCo writes its log file into ``folder``."""

    def __init__(self, module: str, order: object, backend: str, errors: IO[bytes], folder: Path) -> None:
        super().__init__(module, order, _environment(backend), errors, folder)
        self.backend = backend

    def ask(self, request: object, count: int) -> bytes:
        """Return ``count`` bytes from the worker process; raise SimulationFailure if its graphics driver failed."""
        data = super().ask(request, count)
        if len(data) != count:
            raise SimulationFailure(f"the graphics driver failed while drawing ({self.backend}): {self.last_line()}")
        return data


class Drawing:
    """Draws pictures of one scene in a worker process."""

    def __init__(self, worker: GraphicsWorker, order: Order) -> None:
        self._worker, self._size = worker, (order.height, order.width, 3)
        self.backend = worker.backend

    def draw(self, view: View) -> NDArray[np.uint8]:
        """Return a picture of the scene, (height, width, 3); raise SimulationFailure if the graphics driver failed."""
        return np.frombuffer(self._worker.ask(view, int(np.prod(self._size))), dtype=np.uint8).reshape(self._size)


@contextmanager
def drawing(order: Order) -> Iterator[Drawing]:
    """Yield a ``Drawing`` of a scene; if no graphics backend works, raise NoGraphics with the packages to install."""
    with working("wheelleg_exp.rendering.render_job", order) as worker:
        yield Drawing(worker, order)


@contextmanager
def working(module: str, order: object) -> Iterator[GraphicsWorker]:
    """Yield a worker with a working graphics driver; if no driver works, raise NoGraphics with packages to install."""
    with tempfile.TemporaryDirectory(prefix="wheelleg-") as folder, tempfile.TemporaryFile() as errors:
        reasons = []
        for backend in backends():
            with closing(GraphicsWorker(module, order, backend, errors, Path(folder))) as worker:
                if worker.is_ready:
                    yield worker
                    return
            reasons.append(f"{backend}: {worker.last_line()}")
            errors.seek(0)
            errors.truncate()
    raise NoGraphics(f"drawing is not possible on this machine ({'; '.join(reasons)})", expected=INSTALL)


def backends() -> Sequence[str]:
    """Return the graphics backends of MuJoCo to try; the backend in the environment variable MUJOCO_GL comes first."""
    wanted = os.environ.get("MUJOCO_GL", "").lower()
    return tuple(dict.fromkeys([*([wanted] if wanted in BACKENDS else []), *BACKENDS]))


def _environment(backend: str) -> dict[str, str]:
    package = str(Path(wheelleg_exp.__file__).parents[1])
    paths = [package, *filter(None, os.environ.get("PYTHONPATH", "").split(os.pathsep))]
    kept = {k: v for k, v in os.environ.items() if k != "PYOPENGL_PLATFORM"}
    return {**kept, "MUJOCO_GL": backend, "PYTHONPATH": os.pathsep.join(str(Path(p).absolute()) for p in paths)}
