"""The child process that draws: it reads a scene and views from its input and writes raw pictures to its output.

It is a separate process because a graphics driver can abort it, and because MuJoCo selects its backend on import.
"""

from __future__ import annotations

import os
import pickle
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, BinaryIO

import numpy as np

from wheelleg_exp.rendering.render_scene import Array, Scene

READY = b"ready\n"


@dataclass(frozen=True)
class Order:
    """A scene to draw, the picture's size, px, and the number of samples per pixel."""

    scene: Scene
    width: int
    height: int
    samples: int


@dataclass(frozen=True)
class Arrow:
    """An arrow: its colour, radius, m, and two ends, m."""

    rgba: tuple[float, ...]
    radius: float
    origin: Array
    end: Array


@dataclass(frozen=True)
class View:
    """The view of one picture: poses of the bodies, (B, 3) and (B, 4), wxyz, arrows, and camera.

    Angles are in degrees, as in MuJoCo's camera.
    """

    pos: Array
    quat: Array
    arrows: Sequence[Arrow]
    lookat: Array
    distance: float
    azimuth: float
    elevation: float


def main() -> None:
    """Draw until standard input ends."""
    source = sys.stdin.buffer
    target = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # a driver's printed output must not mix with pictures
    order: Order = pickle.load(source)
    import mujoco

    from wheelleg_exp.rendering.scene_models import build_model

    model = build_model(order.scene, order.width, order.height, order.samples)
    data = mujoco.MjData(model)
    with mujoco.Renderer(model, order.height, order.width) as renderer:
        target.write(READY)
        target.flush()
        _serve(source, target, renderer, model, data)


def _serve(source: BinaryIO, target: BinaryIO, renderer: Any, model: Any, data: Any) -> None:
    while True:
        try:
            view: View = pickle.load(source)
        except EOFError:
            return
        target.write(_draw(view, renderer, model, data).tobytes())
        target.flush()


def _draw(view: View, renderer: Any, model: Any, data: Any) -> np.ndarray[Any, Any]:
    import mujoco

    data.mocap_pos[0] = view.lookat
    data.mocap_pos[1:], data.mocap_quat[1:] = view.pos, view.quat
    mujoco.mj_forward(model, data)
    camera = mujoco.MjvCamera()
    camera.lookat[:] = view.lookat
    camera.distance, camera.azimuth, camera.elevation = view.distance, view.azimuth, view.elevation
    renderer.update_scene(data, camera)
    for arrow in view.arrows:
        _add(renderer.scene, arrow)
    return np.asarray(renderer.render())


def _add(scene: Any, arrow: Arrow) -> None:
    import mujoco

    if scene.ngeom >= scene.maxgeom:
        return
    geom = scene.geoms[scene.ngeom]
    kind = mujoco.mjtGeom.mjGEOM_ARROW
    mujoco.mjv_initGeom(geom, kind, np.zeros(3), np.zeros(3), np.eye(3).ravel(), np.array(arrow.rgba, np.float32))
    # MuJoCo draws an arrow at half of the given length.
    mujoco.mjv_connector(geom, kind, arrow.radius, arrow.origin, 2 * arrow.end - arrow.origin)
    geom.category = int(mujoco.mjtCatBit.mjCAT_DECOR)
    scene.ngeom += 1


if __name__ == "__main__":
    main()
