"""How far down colliding shapes reach."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import mujoco
import numpy as np

_GEOM = mujoco.mjtGeom


def lowest_point(model: mujoco.MjModel, data: mujoco.MjData, bodies: Sequence[int]) -> float:
    """Return the world height of the lowest point of the bodies' colliding shapes, m; inf without one."""
    lows = [
        float(data.geom_xpos[geom][2]) - _reach(model, data, geom)
        for geom in range(model.ngeom)
        if model.geom_bodyid[geom] in bodies and (model.geom_contype[geom] or model.geom_conaffinity[geom])
    ]
    return min(lows, default=math.inf)


def _reach(model: mujoco.MjModel, data: mujoco.MjData, geom: int) -> float:
    """Return how far a shape reaches below its centre: its support function in the direction of gravity."""
    down = data.geom_xmat[geom].reshape(3, 3)[2]  # the world's vertical in the shape's axes, up to its sign
    size = model.geom_size[geom]
    if model.geom_type[geom] == _GEOM.mjGEOM_MESH:
        return _mesh_reach(model, int(model.geom_dataid[geom]), down)
    shape = _SHAPES.get(int(model.geom_type[geom]))
    return float(shape(size, down)) if shape is not None else 0.0


def _mesh_reach(model: mujoco.MjModel, mesh: int, down: np.ndarray) -> float:
    start, count = int(model.mesh_vertadr[mesh]), int(model.mesh_vertnum[mesh])
    return -float((model.mesh_vert[start : start + count] @ down).min())


_SHAPES: dict[int, Callable[[np.ndarray, np.ndarray], float]] = {
    int(_GEOM.mjGEOM_SPHERE): lambda size, _: size[0],
    int(_GEOM.mjGEOM_CAPSULE): lambda size, d: size[0] + size[1] * abs(d[2]),
    int(_GEOM.mjGEOM_CYLINDER): lambda size, d: size[0] * math.hypot(d[0], d[1]) + size[1] * abs(d[2]),
    int(_GEOM.mjGEOM_BOX): lambda size, d: float(np.abs(d) @ size),
    int(_GEOM.mjGEOM_ELLIPSOID): lambda size, d: float(np.linalg.norm(size * d)),
}
