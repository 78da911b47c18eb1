"""Ray casts on the CPU against static geoms, such as the ground, in a model that contains only these geoms."""

from __future__ import annotations

from collections.abc import Callable, Collection

import mujoco
import numpy as np
import numpy.typing as npt
from mujoco.batch import Batch

_MARGIN = 1e-6  # The bounding boxes of geoms are enlarged by 1e-6 m because of rounding errors.

Floats = npt.NDArray[np.float64]


class GeomBoxes:
    """The axis-aligned boxes around the static geoms of a model; the box around a plane is infinite."""

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
        """Return a mask (n, G) of the geoms that the R rays of each of n blocks may hit."""
        low, high = self._spans(origins, directions)
        low, high = low.min(axis=1), high.max(axis=1)
        found = np.ones((len(origins), len(self._low)), dtype=np.bool_)
        for axis in range(3):  # Looping over x, y, and z is faster than comparing arrays (..., 3) at once.
            found &= low[:, axis, None] <= self._high[:, axis]
            found &= high[:, axis, None] >= self._low[:, axis]
        return found

    def _spans(self, origins: Floats, directions: Floats) -> tuple[Floats, Floats]:
        """Return the box around each ray's section inside the bounding box of all geoms, as two corners (n, R, 3).

        The slab method (Kay and Kajiya 1986) clips each ray to the bounding box of all geoms. A ray that misses the
        bounding box of all geoms gets the lower corner inf and the upper corner -inf.
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


_GEOM_FIELDS = ("geom_type", "geom_size", "geom_pos", "geom_quat")
_ROWS = 32  # simulations per thread
_MANY = 8  # If there are at least 8 geoms, a ray is tested only against geoms whose bounding box it can hit.
_TOGETHER = 48  # rays in a block
_SHOWN, _HIDDEN = 0, 1  # geom groups


class StaticGeoms:
    """Casts rays against a group of static geoms, whose poses and sizes are the same in all simulations.

    Rays against static geoms are cast in a model without the robot, because MuJoCo tests each ray against every geom.
    At the first ray cast, ``alone()`` makes a model of only the static geoms, which keep their names.
    """

    def __init__(self, model: mujoco.MjModel, group: int, alone: Callable[[], mujoco.MjModel], nthread: int) -> None:
        self._model, self._group, self._make, self._nthread = model, group, alone, nthread
        self._batch: Batch | None = None
        self._reach: GeomBoxes | None = None
        self._is_same: bool | None = None

    def are_still(self, expanded: Collection[str]) -> bool:
        """Return False if an event has edited a static geom, because rays must then be cast in the complete model."""
        if self._is_same is None:
            alone, here = self._make(), np.flatnonzero(self._model.geom_group == self._group)
            self._is_same = len(here) == alone.ngeom
            there = [alone.geom(self._model.geom(g).name).id for g in here if self._is_same]
            for name in _GEOM_FIELDS:
                own, other = getattr(self._model, name)[here], getattr(alone, name)[there]
                self._is_same = self._is_same and np.array_equal(own, other)
            if self._is_same:
                self._batch = Batch(alone, self._nthread * _ROWS, nthread=self._nthread)
                if alone.ngeom >= _MANY:
                    self._reach, self._groups = GeomBoxes(alone), self._batch.expand("geom_group")
        return self._is_same and not any(name in expanded for name in _GEOM_FIELDS)

    def ray(self, origins: Floats, directions: Floats) -> Floats:
        """Cast rays (n, R, 3); return the distance to each ray's first hit, (n, R), like the method ``Engine.ray``."""
        rows, shape = self._nthread * _ROWS, origins.shape[:-1]
        count = int(np.prod(shape))
        together = _TOGETHER if self._reach else max(1, -(-count // rows))
        blocks = -(-count // together)
        flat = (np.resize(rays.reshape(-1, 3), (blocks * together, 3)) for rays in (origins, directions))
        starts, ways = (rays.reshape(blocks, together, 3) for rays in flat)
        far = np.empty((blocks, together))
        assert self._batch is not None
        for some in (slice(first, min(first + rows, blocks)) for first in range(0, blocks, rows)):
            # Each simulation of the MuJoCo batch casts one row of the rays in ``starts[some]`` and ``ways[some]``.
            ids, shown = np.arange(some.stop - some.start), None
            if self._reach is not None:
                self._groups[: len(ids)] = np.where(self._reach.reached(starts[some], ways[some]), _SHOWN, _HIDDEN)
                shown = np.arange(mujoco.mjNGROUP) == _SHOWN
            far[some] = self._batch.ray(starts[some], ways[some], geomgroup=shown, ids=ids)[0]
        return far.reshape(-1)[:count].reshape(shape)
