"""Compute the extents of colliders along directions, and find overlapping bodies with MuJoCo's collision detection."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_GEOM = mujoco.mjtGeom


def colliders(model: mujoco.MjModel, bodies: Iterable[int]) -> list[int]:
    """Return the colliding shapes of bodies, except infinite shapes such as planes."""
    wanted = set(bodies)
    solid = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
    return [
        geom
        for geom in np.flatnonzero(solid).tolist()
        if int(model.geom_bodyid[geom]) in wanted and int(model.geom_type[geom]) in _SHAPES
    ]


def lowest_point(model: mujoco.MjModel, data: mujoco.MjData, bodies: Sequence[int]) -> float:
    """Return the world height (m) of the lowest point of the bodies' colliders; inf if the bodies have no colliders."""
    down = np.array([[0.0, 0.0, -1.0]])
    return -float(reach(model, data, colliders(model, bodies), np.zeros(3), down)[0])


def reach(model: mujoco.MjModel, data: mujoco.MjData, geoms: Sequence[int], origin: Array, directions: Array) -> Array:
    """Return how far ``geoms`` reach from ``origin`` along unit ``directions`` (n, 3), world, (n,) in m; -inf: none."""
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
    int(_GEOM.mjGEOM_MESH): lambda _, d: np.zeros(len(d)),  # ``_extent`` computes how far meshes extend.
}


@dataclass(frozen=True)
class Overlap:
    """Two bodies, parent first, whose colliders overlap by ``depth`` (m); ``neighbours``: joined; ``acts``: touch."""

    bodies: tuple[str, str]
    depth: float
    neighbours: bool
    acts: bool


def find_overlaps(model: mujoco.MjModel, qpos: np.ndarray, names: Collection[str]) -> list[Overlap]:
    """Return the pairs of bodies that overlap at ``qpos``, the deepest first, without welded and excluded pairs."""
    bodies = {model.body(name).id for name in names}
    acting = set(_depths(model, qpos, bodies))
    free = copy.copy(model)
    solid = colliders(model, bodies)
    free.geom_contype[:] = free.geom_conaffinity[:] = 0
    free.geom_contype[solid] = free.geom_conaffinity[solid] = 1
    # MuJoCo filters contacts first by the collision bits of bodies, then by those of geoms.
    free.body_contype[:] = free.body_conaffinity[:] = 1
    free.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_FILTERPARENT
    pairs = sorted(_depths(free, qpos, bodies).items(), key=lambda item: -item[1])
    found = []
    for (one, other), depth in pairs:
        if model.body_weldid[one] == model.body_weldid[other]:
            continue
        ends = model.body_weldid[[one, other]]
        parents = model.body_weldid[model.body_parentid[ends]]
        neighbours = bool(parents[0] == ends[1] or parents[1] == ends[0])
        names_of = model.body(one).name, model.body(other).name
        found.append(Overlap(names_of, depth, neighbours, (one, other) in acting))
    return found


def _depths(model: mujoco.MjModel, qpos: np.ndarray, bodies: set[int]) -> dict[tuple[int, int], float]:
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    mujoco.mj_collision(model, data)
    return overlap_depths(model, data, bodies)


def overlap_depths(model: mujoco.MjModel, data: mujoco.MjData, bodies: Collection[int]) -> dict[tuple[int, int], float]:
    """Return the overlap depth, m, of each pair of body ids. ``data`` must contain the contacts."""
    found: dict[tuple[int, int], float] = {}
    for contact in data.contact[: data.ncon]:
        one, other = sorted(int(model.geom_bodyid[geom]) for geom in contact.geom)
        if one in bodies and other in bodies and contact.dist < 0:
            found[one, other] = max(found.get((one, other), 0.0), -float(contact.dist))
    return found
