"""Which of many geoms rays may meet: a ray asks each geom that it is shown, and most are far from it."""

from __future__ import annotations

import mujoco
import numpy as np
import numpy.typing as npt

_MARGIN = 1e-6  # m, by which boxes are taken larger than they are computed

Floats = npt.NDArray[np.float64]


class RayReach:
    """The boxes around geoms that never move, in world axes; a plane's has no end.

    Args:
        model: of the geoms.
    """

    def __init__(self, model: mujoco.MjModel) -> None:
        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
        turn = data.geom_xmat.reshape(-1, 3, 3)
        middle = data.geom_xpos + np.einsum("gij,gj->gi", turn, model.geom_aabb[:, :3])
        half = np.einsum("gij,gj->gi", np.abs(turn), model.geom_aabb[:, 3:]) + _MARGIN
        ends = model.geom_type != mujoco.mjtGeom.mjGEOM_PLANE
        self._low = np.where(ends[:, None], middle - half, -np.inf)
        self._high = np.where(ends[:, None], middle + half, np.inf)
        self._all_low = self._low[ends].min(axis=0, initial=np.inf)
        self._all_high = self._high[ends].max(axis=0, initial=-np.inf)

    def reached(self, origins: Floats, directions: Floats) -> npt.NDArray[np.bool_]:
        """Return which geoms (n, G) some ray of each row may meet: all that it meets, and a few more.

        Args:
            origins: world, m, (n, R, 3).
            directions: world, (n, R, 3).
        """
        low, high = self._spans(origins, directions)
        low, high = low.min(axis=1), high.max(axis=1)
        found = np.ones((len(origins), len(self._low)), dtype=np.bool_)
        for axis in range(3):  # much faster than all three at once
            found &= low[:, axis, None] <= self._high[:, axis]
            found &= high[:, axis, None] >= self._low[:, axis]
        return found

    def _spans(self, origins: Floats, directions: Floats) -> tuple[Floats, Floats]:
        """Return the corners (n, R, 3) of the box around what of each ray lies in the box around all geoms.

        By slabs (Kay and Kajiya 1986); a ray that passes it by has corners at infinity, the lower one above.
        """
        with np.errstate(divide="ignore", over="ignore", invalid="ignore"):
            slope = 1.0 / np.where(directions == 0.0, 1e-300, directions)
            one, other = (self._all_low - origins) * slope, (self._all_high - origins) * slope
            enters = np.minimum(one, other).max(axis=2, initial=0.0, keepdims=True)
            leaves = np.maximum(one, other).min(axis=2, keepdims=True)
            start, end = origins + enters * directions, origins + leaves * directions
        meets = enters <= leaves
        low = np.where(meets, np.minimum(start, end) - _MARGIN, np.inf)
        return low, np.where(meets, np.maximum(start, end) + _MARGIN, -np.inf)
