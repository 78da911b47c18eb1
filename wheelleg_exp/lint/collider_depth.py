"""How far colliding shapes reach in a direction."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence

import mujoco
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_GEOM = mujoco.mjtGeom


def colliders(model: mujoco.MjModel, bodies: Iterable[int]) -> list[int]:
    """Return the colliding shapes of bodies; what has no end, such as a plane, is left out."""
    wanted = set(bodies)
    solid = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
    return [
        geom
        for geom in np.flatnonzero(solid).tolist()
        if int(model.geom_bodyid[geom]) in wanted and int(model.geom_type[geom]) in _SHAPES
    ]


def lowest_point(model: mujoco.MjModel, data: mujoco.MjData, bodies: Sequence[int]) -> float:
    """Return the world height of the lowest point of the bodies' colliding shapes, m; inf without one."""
    down = np.array([[0.0, 0.0, -1.0]])
    return -float(reach(model, data, colliders(model, bodies), np.zeros(3), down)[0])


def reach(model: mujoco.MjModel, data: mujoco.MjData, geoms: Sequence[int], origin: Array, directions: Array) -> Array:
    """Return how far shapes reach from a point: their support function.

    Args:
        model: the robot.
        data: its pose.
        geoms: the shapes.
        origin: world, m, (3,).
        directions: unit vectors in the world, (n, 3).

    Returns:
        The largest extent over all shapes, m, (n,); -inf without shapes.
    """
    farthest = np.full(len(directions), -math.inf)
    for geom in geoms:
        local = directions @ data.geom_xmat[geom].reshape(3, 3)
        centre = directions @ (data.geom_xpos[geom] - origin)
        np.maximum(farthest, centre + _extent(model, geom, local), out=farthest)
    return farthest


def _extent(model: mujoco.MjModel, geom: int, directions: Array) -> Array:
    if model.geom_type[geom] == _GEOM.mjGEOM_MESH:
        mesh = int(model.geom_dataid[geom])
        start, count = int(model.mesh_vertadr[mesh]), int(model.mesh_vertnum[mesh])
        vertices = model.mesh_vert[start : start + count].astype(np.float64)
        return np.array([(vertices @ direction).max() for direction in directions])
    return _SHAPES[int(model.geom_type[geom])](model.geom_size[geom], directions)


_SHAPES: dict[int, Callable[[Array, Array], Array]] = {
    int(_GEOM.mjGEOM_SPHERE): lambda size, d: np.full(len(d), size[0]),
    int(_GEOM.mjGEOM_CAPSULE): lambda size, d: size[0] + size[1] * np.abs(d[:, 2]),
    int(_GEOM.mjGEOM_CYLINDER): lambda size, d: size[0] * np.hypot(d[:, 0], d[:, 1]) + size[1] * np.abs(d[:, 2]),
    int(_GEOM.mjGEOM_BOX): lambda size, d: np.abs(d) @ size,
    int(_GEOM.mjGEOM_ELLIPSOID): lambda size, d: np.linalg.norm(size * d, axis=1),
    int(_GEOM.mjGEOM_MESH): lambda _, d: np.zeros(len(d)),  # its vertices say, see _extent
}
