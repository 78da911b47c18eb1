"""Rays onto geoms that never move, in a model of these alone: a robot's geoms cost each ray time."""

from __future__ import annotations

from collections.abc import Callable, Collection

import mujoco
import numpy as np
import numpy.typing as npt
from mujoco.batch import Batch

_PLACES = ("geom_type", "geom_size", "geom_pos", "geom_quat")
_ROWS = 32  # a thread: how finely rays are shared out


class StillGeoms:
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
        self._is_same: bool | None = None

    def are_still(self, expanded: Collection[str]) -> bool:
        """Return whether the model of them alone shows them: nobody has edited them, in all simulations or in one."""
        if self._is_same is None:
            alone = self._make()
            self._is_same = self._same(alone)
            if self._is_same:
                self._batch = Batch(alone, self._nthread * _ROWS, nthread=self._nthread)
        return self._is_same and not any(name in expanded for name in _PLACES)

    def ray(self, origins: npt.NDArray[np.float64], directions: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """Return how far rays (n, R, 3) go, (n, R), as ``Engine.ray`` does."""
        assert self._batch is not None
        rows, shape = self._nthread * _ROWS, origins.shape[:-1]
        count = int(np.prod(shape))
        padded = -(-count // rows) * rows
        starts, ways = (
            np.resize(rays.reshape(-1, 3), (padded, 3)).reshape(rows, -1, 3) for rays in (origins, directions)
        )
        distances = self._batch.ray(starts, ways)[0] if count else np.empty((rows, 0))
        return np.asarray(distances).reshape(-1)[:count].reshape(shape)

    def _same(self, alone: mujoco.MjModel) -> bool:
        here = np.flatnonzero(self._model.geom_group == self._group)
        if len(here) != alone.ngeom:
            return False
        there = [alone.geom(self._model.geom(g).name).id for g in here]
        return all(np.array_equal(getattr(self._model, name)[here], getattr(alone, name)[there]) for name in _PLACES)
