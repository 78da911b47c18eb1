"""Ray casts on the CPU against geoms that never move, such as the ground, in a model of these geoms alone."""

from __future__ import annotations

from collections.abc import Callable, Collection

import mujoco
import numpy as np
import numpy.typing as npt
from mujoco.batch import Batch

_MARGIN = 1e-6  # m, by which boxes are taken larger than they are computed

Floats = npt.NDArray[np.float64]


class GeomBoxes:
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


_PLACES = ("geom_type", "geom_size", "geom_pos", "geom_quat")
_ROWS = 32  # a thread: how finely rays are shared out
_MANY = 8  # geoms from which on rays are shown those alone that they may meet
_TOGETHER = 48  # rays that are shown the same geoms
_SHOWN, _HIDDEN = 0, 1  # groups


class StaticGeoms:
    """A group of geoms that is the same in all simulations, so that any of them can cast any ray.

    Args:
        model: the whole model.
        group: the geoms' group.
        alone: returns a model of these geoms alone, by the same names; called with the first ray.
        nthread: threads that cast.
    """

    def __init__(self, model: mujoco.MjModel, group: int, alone: Callable[[], mujoco.MjModel], nthread: int) -> None:
        self._model, self._group, self._make, self._nthread = model, group, alone, nthread
        self._batch: Batch | None = None
        self._reach: GeomBoxes | None = None
        self._is_same: bool | None = None

    def are_still(self, expanded: Collection[str]) -> bool:
        """Return whether the model of them alone shows them: nobody has edited them, in all simulations or in one."""
        if self._is_same is None:
            alone = self._make()
            self._is_same = self._same(alone)
            if self._is_same:
                self._prepare(alone)
        return self._is_same and not any(name in expanded for name in _PLACES)

    def _prepare(self, alone: mujoco.MjModel) -> None:
        self._batch = Batch(alone, self._nthread * _ROWS, nthread=self._nthread)
        if alone.ngeom >= _MANY:
            self._reach, self._groups = GeomBoxes(alone), self._batch.expand("geom_group")

    def ray(self, origins: Floats, directions: Floats) -> Floats:
        """Return how far rays (n, R, 3) go, (n, R), as ``Engine.ray`` does."""
        rows, shape = self._nthread * _ROWS, origins.shape[:-1]
        count = int(np.prod(shape))
        together = _TOGETHER if self._reach else max(1, -(-count // rows))
        blocks = -(-count // together)
        starts, ways = (
            np.resize(rays.reshape(-1, 3), (blocks * together, 3)).reshape(blocks, together, 3)
            for rays in (origins, directions)
        )
        far = np.empty((blocks, together))
        for some in (slice(first, min(first + rows, blocks)) for first in range(0, blocks, rows)):
            far[some] = self._cast(starts[some], ways[some])
        return far.reshape(-1)[:count].reshape(shape)

    def _cast(self, origins: Floats, directions: Floats) -> Floats:
        """Return how far a row of rays in each of the first simulations go."""
        assert self._batch is not None
        ids, shown = np.arange(len(origins)), None
        if self._reach is not None:
            reached = self._reach.reached(origins, directions)
            self._groups[: len(ids)] = np.where(reached, _SHOWN, _HIDDEN)
            shown = np.arange(mujoco.mjNGROUP) == _SHOWN
        return np.asarray(self._batch.ray(origins, directions, geomgroup=shown, ids=ids)[0])

    def _same(self, alone: mujoco.MjModel) -> bool:
        here = np.flatnonzero(self._model.geom_group == self._group)
        if len(here) != alone.ngeom:
            return False
        there = [alone.geom(self._model.geom(g).name).id for g in here]
        return all(np.array_equal(getattr(self._model, name)[here], getattr(alone, name)[there]) for name in _PLACES)
