"""Draw pictures of running simulations from copied positions, so that drawing does not change a simulation."""

from __future__ import annotations

import weakref
from contextlib import ExitStack

import mujoco
import numpy as np
import torch
from numpy.typing import NDArray

from wheelleg_exp.rendering import render_scene
from wheelleg_exp.rendering.camera_job import FORMS, CameraOrder, Poses
from wheelleg_exp.rendering.render_job import Order, View
from wheelleg_exp.rendering.render_scene import Array, points
from wheelleg_exp.rendering.renderer import Drawing, GraphicsWorker, drawing, working
from wheelleg_exp.rendering.scene_models import Kinematics, scene_of_model

_SAMPLES = 4


class LivePictures:
    """Draws a compiled MuJoCo scene in a child process, until ``close``; the camera follows the body ``root``."""

    def __init__(self, model: mujoco.MjModel, root: str, width: int, height: int) -> None:
        self._model, self._root = model, int(model.body(root).id)
        self._width, self._height = width, height
        self._poses = Kinematics(model)
        self._open = ExitStack()
        self._process: Drawing | None = None

    def draw(self, qpos: Array) -> NDArray[np.uint8]:
        """Return a picture (height, width, 3) at joint positions (nq,); raise WheellegError if drawing fails."""
        qpos = np.where(np.isfinite(qpos), qpos, self._model.qpos0)
        if self._process is None:
            scene = scene_of_model(self._model, self._root, self._poses.height(self._root, qpos))
            cloud = points(scene, self._poses.xpos[1:], self._poses.xquat[1:]) - self._poses.xpos[self._root]
            self._centre = np.array([0.0, 0.0, (cloud[:, 2].min() + cloud[:, 2].max()) / 2])
            self._distance = render_scene.camera_distance(cloud - self._centre, self._width / self._height)
            self._process = self._open.enter_context(drawing(Order(scene, self._width, self._height, _SAMPLES)))
        self._poses.update(qpos)
        pos, quat = self._poses.xpos[1:].copy(), self._poses.xquat[1:].copy()
        lookat = pos[self._root - 1] + self._centre
        view = View(pos, quat, (), lookat, self._distance, render_scene.AZIMUTH, render_scene.ELEVATION)
        return self._process.draw(view).copy()

    def close(self) -> None:
        """Stop the process that draws pictures; the next picture starts a new process."""
        self._open.close()
        self._process = None


class CameraPictures:
    """Draws pictures of a camera sensor in a child process that starts with the first picture."""

    def __init__(self, order: CameraOrder) -> None:
        self._order = order
        self._worker: GraphicsWorker | None = None
        self._open = ExitStack()
        weakref.finalize(self, self._open.close)

    def draw(self, qpos: torch.Tensor) -> dict[str, torch.Tensor]:
        """Return pictures for n rows of joint positions (n, nq): each layer is (n, height, width, channels)."""
        if self._worker is None:
            self._worker = self._open.enter_context(working("wheelleg_exp.rendering.camera_job", self._order))
        order, forms = self._order, [(layer, *FORMS[layer]) for layer in self._order.layers]
        pixels = order.width * order.height
        row = np.dtype([(layer, kind, (pixels * channels,)) for layer, channels, kind in forms])
        rows = np.frombuffer(self._worker.ask(Poses(qpos.double().cpu().numpy()), row.itemsize * len(qpos)), dtype=row)
        size = (len(qpos), order.height, order.width)
        return {
            layer: torch.from_numpy(rows[layer].copy()).reshape(*size, channels).to(qpos.device)
            for layer, channels, _ in forms
        }
