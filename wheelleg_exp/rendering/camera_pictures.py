"""What a camera of a compiled scene sees, at positions of some simulations."""

from __future__ import annotations

import weakref
from contextlib import ExitStack

import mujoco
import numpy as np
import torch

from wheelleg_exp.rendering.camera_job import FORMS, CameraOrder, Layer, Poses
from wheelleg_exp.rendering.renderer import Worker, working


class CameraPictures:
    """Draws the pictures of one camera; the process that draws begins with the first and ends with the object.

    Args:
        model: the compiled scene.
        camera: the name of one of its cameras.
        width: px.
        height: px.
        clipping_range: nearest and farthest distance along the camera's axis, m.
        layers: what is drawn (see ``CameraOrder``).
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        camera: str,
        width: int,
        height: int,
        clipping_range: tuple[float, float],
        layers: tuple[Layer, ...],
    ) -> None:
        self._order = CameraOrder(model, camera, width, height, clipping_range, layers)
        self._worker: Worker | None = None
        self._open = ExitStack()
        weakref.finalize(self, self._open.close)

    def draw(self, qpos: torch.Tensor) -> dict[str, torch.Tensor]:
        """Return each layer, (n, height, width, channels), of the scene at positions (n, nq).

        Raises:
            NoGraphics: nothing can be drawn on this machine; the message says what to install.
            SimulationFailure: the graphics driver gave up.
        """
        if self._worker is None:
            self._worker = self._open.enter_context(working("wheelleg_exp.rendering.camera_job", self._order))
        order, forms = self._order, [(layer, *FORMS[layer]) for layer in self._order.layers]
        pixels = order.width * order.height
        row = np.dtype([(layer, kind, (pixels * channels,)) for layer, channels, kind in forms])
        data = self._worker.ask(Poses(qpos.double().cpu().numpy()), row.itemsize * len(qpos))
        rows = np.frombuffer(data, dtype=row)
        size = (len(qpos), order.height, order.width)
        return {
            layer: torch.from_numpy(rows[layer].copy()).reshape(*size, channels).to(qpos.device)
            for layer, channels, _ in forms
        }

    def close(self) -> None:
        """End the process that draws; the next picture begins another."""
        self._open.close()
        self._worker = None
