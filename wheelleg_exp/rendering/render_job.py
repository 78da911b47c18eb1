"""Draw pictures in a worker process, because a graphics driver can abort the process that uses the driver."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from wheelleg_exp.child_process import serve_requests
from wheelleg_exp.rendering.render_scene import Array, Scene

if TYPE_CHECKING:
    import mujoco


@dataclass(frozen=True)
class Order:
    """A request to draw a scene, with the size of the picture, px, and the number of samples per pixel."""

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
    """A picture to draw: positions (B, 3) and orientations (B, 4), wxyz, of all bodies, arrows, and the camera."""

    pos: Array
    quat: Array
    arrows: Sequence[Arrow]
    lookat: Array
    distance: float
    azimuth: float
    elevation: float


@contextmanager
def _prepare(order: Order) -> Iterator[Callable[[View], bytes]]:
    import mujoco

    from wheelleg_exp.rendering.scene_models import build_model

    model = build_model(order.scene, order.width, order.height, order.samples)
    data = mujoco.MjData(model)
    with mujoco.Renderer(model, order.height, order.width) as renderer:
        yield lambda view: _draw(view, renderer, model, data).tobytes()


def _draw(view: View, renderer: mujoco.Renderer, model: mujoco.MjModel, data: mujoco.MjData) -> NDArray[np.uint8]:
    import mujoco

    data.mocap_pos[0] = view.lookat
    data.mocap_pos[1:], data.mocap_quat[1:] = view.pos, view.quat
    mujoco.mj_forward(model, data)
    camera = mujoco.MjvCamera()
    camera.lookat[:] = view.lookat
    camera.distance, camera.azimuth, camera.elevation = view.distance, view.azimuth, view.elevation
    renderer.update_scene(data, camera)
    for arrow in view.arrows:
        scene, kind = renderer.scene, mujoco.mjtGeom.mjGEOM_ARROW
        if scene.ngeom >= scene.maxgeom:
            break
        geom = scene.geoms[scene.ngeom]
        mujoco.mjv_initGeom(geom, kind, np.zeros(3), np.zeros(3), np.eye(3).ravel(), np.array(arrow.rgba, np.float32))
        # Double the arrow's vector, because MuJoCo draws an arrow with half of the given length.
        mujoco.mjv_connector(geom, kind, arrow.radius, arrow.origin, 2 * arrow.end - arrow.origin)
        geom.category = int(mujoco.mjtCatBit.mjCAT_DECOR)
        scene.ngeom += 1
    return np.asarray(renderer.render())


if __name__ == "__main__":
    serve_requests(_prepare)
