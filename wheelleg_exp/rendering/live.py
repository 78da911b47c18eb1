"""Pictures of simulations as they run: from their positions alone, so that nothing of them is touched."""

from __future__ import annotations

from contextlib import ExitStack

import mujoco
import numpy as np
from numpy.typing import NDArray

from wheelleg_exp.rendering import viewpoint
from wheelleg_exp.rendering.compiled import scene_of_model
from wheelleg_exp.rendering.poses import Kinematics
from wheelleg_exp.rendering.render_job import Order, View
from wheelleg_exp.rendering.renderer import drawing
from wheelleg_exp.rendering.scene import points
from wheelleg_exp.rendering.shapes import Array

_SAMPLES = 4


class LivePictures:
    """Draws a compiled scene at positions; the camera follows the robot at one distance.

    The process that draws begins with the first picture and ends with ``close``.

    Args:
        model: the compiled scene.
        root: the name of the robot's root body.
        width: px.
        height: px.
    """

    def __init__(self, model: mujoco.MjModel, root: str, width: int, height: int) -> None:
        self._model, self._root = model, int(model.body(root).id)
        self._width, self._height = width, height
        self._poses = Kinematics(model)
        self._open = ExitStack()
        self._started = False

    def draw(self, qpos: Array) -> NDArray[np.uint8]:
        """Return a picture (height, width, 3) of the scene at positions (nq,).

        Raises:
            NoGraphics: nothing can be drawn on this machine; the message says what to install.
            SimulationFailure: the graphics driver gave up.
        """
        qpos = np.where(np.isfinite(qpos), qpos, self._model.qpos0)
        if not self._started:
            self._start(qpos)
        self._poses.update(qpos)
        pos, quat = self._poses.xpos[1:].copy(), self._poses.xquat[1:].copy()
        lookat = pos[self._root - 1] + self._centre
        view = View(pos, quat, (), lookat, self._distance, viewpoint.AZIMUTH, viewpoint.ELEVATION)
        return self._process.draw(view).copy()

    def close(self) -> None:
        """End the process that draws; the next picture begins another."""
        self._open.close()
        self._started = False

    def _start(self, qpos: Array) -> None:
        scene = scene_of_model(self._model, self._root, self._poses.height(self._root, qpos))
        cloud = points(scene, self._poses.xpos[1:], self._poses.xquat[1:]) - self._poses.xpos[self._root]
        self._centre = np.array([0.0, 0.0, (cloud[:, 2].min() + cloud[:, 2].max()) / 2])
        self._distance = viewpoint.distance(cloud - self._centre, self._width / self._height)
        self._process = self._open.enter_context(drawing(Order(scene, self._width, self._height, _SAMPLES)))
        self._started = True
