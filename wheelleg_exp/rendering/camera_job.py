"""The child process that draws camera sensors: it reads positions and writes pictures (see ``render_job``)."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Literal

import mujoco
import numpy as np
from numpy.typing import NDArray

from wheelleg_exp.child_process import serve_requests
from wheelleg_exp.rendering.render_scene import Array
from wheelleg_exp.rendering.scene_models import body_geoms, is_plane

Layer = Literal["colour", "depth", "geom"]
# ``FORMS`` maps each picture layer to its channels per pixel and its data type, such as 3 and uint8 for colour.
FORMS: dict[str, tuple[int, str]] = {"colour": (3, "uint8"), "depth": (1, "float32"), "geom": (1, "int32")}
_BEYOND = 0.999  # A pixel whose depth is above 99.9 % of the far clipping distance shows no surface.
_AMBIENT = 0.4
_HIDDEN = 5  # The renderer draws no geoms of geom group 5.


@dataclass(frozen=True)
class CameraOrder:
    """A request to draw the view of a camera sensor: the picture's size, px, and the camera's clipping range, m."""

    model: mujoco.MjModel
    camera: str
    width: int
    height: int
    clipping_range: tuple[float, float]
    layers: Sequence[Layer]  # Depth is measured along the camera's axis, m; depth inf or geom id -1 means no surface.


@dataclass(frozen=True)
class Poses:
    """The joint positions (n, nq) at which to draw n simulations, with one picture per layer, such as depth."""

    qpos: Array


@contextmanager
def _prepare(order: CameraOrder) -> Iterator[Callable[[Poses], bytes]]:
    # Set the picture size and the clipping range of the MuJoCo model, and hide the model's invisible geoms.
    model = order.model
    model.vis.global_.offwidth, model.vis.global_.offheight = order.width, order.height
    # Put the light at the camera, so that a surface that faces the camera appears in the colour of its material.
    light = model.vis.headlight
    light.active, light.ambient[:], light.diffuse[:], light.specular[:] = 1, _AMBIENT, 1.0 - _AMBIENT, 0.0
    near, far = order.clipping_range
    model.vis.map.znear, model.vis.map.zfar = near / model.stat.extent, far / model.stat.extent
    seen = {geom for body in range(model.nbody) for geom in body_geoms(model, body)[0]}
    for geom in range(model.ngeom):
        model.geom_group[geom] = 0 if geom in seen or is_plane(model, geom) else _HIDDEN
    with mujoco.Renderer(model, order.height, order.width) as renderer:
        draw = _Draw(renderer, model, order)
        yield lambda poses: b"".join(np.ascontiguousarray(p).tobytes() for qpos in poses.qpos for p in draw(qpos))


class _Draw:
    def __init__(self, renderer: mujoco.Renderer, model: mujoco.MjModel, order: CameraOrder) -> None:
        self._renderer, self._model, self._order = renderer, model, order
        self._data = mujoco.MjData(model)
        self._option = mujoco.MjvOption()
        self._option.sitegroup[:] = 0
        self._option.flags[mujoco.mjtVisFlag.mjVIS_RANGEFINDER] = 0

    def __call__(self, qpos: Array) -> list[NDArray[np.generic]]:
        self._data.qpos[:] = np.where(np.isfinite(qpos), qpos, self._model.qpos0)
        mujoco.mj_kinematics(self._model, self._data)
        mujoco.mj_comPos(self._model, self._data)
        mujoco.mj_camlight(self._model, self._data)
        # Update the scene twice, because the first update centres an infinite plane at the camera's previous position.
        for _ in range(2):
            self._renderer.update_scene(self._data, self._order.camera, self._option)
        return [getattr(self, layer)() for layer in self._order.layers]

    def colour(self) -> NDArray[np.uint8]:
        self._renderer.disable_depth_rendering()
        self._renderer.disable_segmentation_rendering()
        return np.asarray(self._renderer.render())

    def depth(self) -> NDArray[np.float32]:
        self._renderer.enable_depth_rendering()
        far = self._order.clipping_range[1]
        depth = np.asarray(self._renderer.render())
        return np.where(depth < _BEYOND * far, depth, np.float32(np.inf))

    def geom(self) -> NDArray[np.int32]:
        self._renderer.enable_segmentation_rendering()
        number, kind = np.moveaxis(np.asarray(self._renderer.render()), -1, 0)
        return np.where(kind == mujoco.mjtObj.mjOBJ_GEOM, number, np.int32(-1))


if __name__ == "__main__":
    serve_requests(_prepare)
