"""Rays onto geoms that never move, in a model of these alone: a robot's geoms cost each ray time."""

from __future__ import annotations

from collections.abc import Callable, Collection

import mujoco
import numpy as np
from mujoco.batch import Batch

from wheelleg_exp.sim.rays.reach import Floats, RayReach

_PLACES = ("geom_type", "geom_size", "geom_pos", "geom_quat")
_ROWS = 32  # a thread: how finely rays are shared out
_MANY = 8  # geoms from which on rays are shown those alone that they may meet
_TOGETHER = 48  # rays that are shown the same geoms
_SHOWN, _HIDDEN = 0, 1  # groups


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
        self._reach: RayReach | None = None
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
            self._reach, self._groups = RayReach(alone), self._batch.expand("geom_group")

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
