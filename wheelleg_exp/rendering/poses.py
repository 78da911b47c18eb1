"""Poses of every body from one row of positions, and how tall what is below a body stands."""

from __future__ import annotations

import mujoco
import numpy as np

from wheelleg_exp.rendering.compiled import is_plane
from wheelleg_exp.rendering.shapes import Array


class Kinematics:
    """Forward kinematics on an own ``MjData``, so that nothing of the simulations is touched.

    Args:
        model: the compiled scene.
    """

    def __init__(self, model: mujoco.MjModel) -> None:
        self._model = model
        self._data = mujoco.MjData(model)
        self.xpos: Array = self._data.xpos
        self.xquat: Array = self._data.xquat

    def update(self, qpos: Array) -> None:
        """Make ``xpos`` (B, 3), m, and ``xquat`` (B, 4), wxyz, the world poses of all bodies at ``qpos`` (nq,)."""
        self._data.qpos[:] = qpos
        mujoco.mj_kinematics(self._model, self._data)

    def poses(self, qpos: Array) -> tuple[Array, Array]:
        """Return positions (n, B, 3), m, and orientations (n, B, 4), wxyz, of all bodies for rows of qpos (n, nq)."""
        count = len(qpos)
        positions, orientations = np.empty((count, *self.xpos.shape)), np.empty((count, *self.xquat.shape))
        for i, row in enumerate(qpos):
            self.update(row)
            positions[i], orientations[i] = self.xpos, self.xquat
        return positions, orientations

    def height(self, root: int, qpos: Array) -> float:
        """Return how tall the tree below ``root`` stands at ``qpos``, m: its vertical extent by bounding spheres.

        At least 1 cm, so that it can serve as a length scale.
        """
        self.update(qpos)
        geoms = [g for g in tree_geoms(self._model, root) if not is_plane(self._model, g)]
        if not geoms:
            return 0.1
        centre, radius = self._data.geom_xpos[geoms, 2], self._model.geom_rbound[geoms]
        return max(float((centre + radius).max() - (centre - radius).min()), 0.01)


def tree_bodies(model: mujoco.MjModel, root: int) -> list[int]:
    """Return ``root`` and all bodies below it."""
    bodies = [root]
    for body in range(root + 1, model.nbody):
        if int(model.body_parentid[body]) in bodies:
            bodies.append(body)
    return bodies


def tree_geoms(model: mujoco.MjModel, root: int) -> list[int]:
    """Return the geoms of ``root`` and of all bodies below it."""
    return np.flatnonzero(np.isin(model.geom_bodyid, tree_bodies(model, root))).tolist()
