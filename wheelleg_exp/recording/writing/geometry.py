"""From the compiled MuJoCo model to rerun's shapes: poses, sizes, colours."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
import rerun as rr

from wheelleg_exp.rendering.compiled import colour, mesh
from wheelleg_exp.rendering.shapes import Array


def xyzw(wxyz: Array) -> Array:
    """Return quaternions (..., 4) in rerun's order (x, y, z, w) from MuJoCo's (w, x, y, z)."""
    return np.roll(wxyz, -1, axis=-1)


def geom_name(model: mujoco.MjModel, geom: int) -> str:
    """Return a geom's name, or one made of its number."""
    return model.geom(geom).name or f"geom_{geom}"


def shape(model: mujoco.MjModel, geom: int) -> list[Any]:
    """Return what draws a geom in the frame of its body: one archetype, and a pose where that has none itself.

    MuJoCo sizes are half sizes. A rerun capsule begins at the centre of one cap and extends along its z axis; a
    MuJoCo capsule is centred, so that the origin is shifted by half the length along the geom's z axis.

    Returns:
        Archetypes for one entity; empty for a type that is not drawn (planes, signed distance fields).
    """
    kind = mujoco.mjtGeom(int(model.geom_type[geom]))
    make = _SHAPES.get(kind)
    return [] if make is None else make(model, geom)


def _common(model: mujoco.MjModel, geom: int) -> dict[str, Any]:
    return {
        "quaternions": [xyzw(model.geom_quat[geom])],
        "colors": [colour(model, geom)],
        "fill_mode": "solid",
    }


def _box(model: mujoco.MjModel, geom: int) -> list[Any]:
    return [rr.Boxes3D(half_sizes=[model.geom_size[geom]], centers=[model.geom_pos[geom]], **_common(model, geom))]


def _ellipsoid(model: mujoco.MjModel, geom: int) -> list[Any]:
    size = model.geom_size[geom]
    half = np.full(3, size[0]) if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_SPHERE else size
    return [rr.Ellipsoids3D(half_sizes=[half], centers=[model.geom_pos[geom]], **_common(model, geom))]


def _cylinder(model: mujoco.MjModel, geom: int) -> list[Any]:
    radius, half_length = model.geom_size[geom][:2]
    centre = model.geom_pos[geom]
    return [rr.Cylinders3D(lengths=[2 * half_length], radii=[radius], centers=[centre], **_common(model, geom))]


def _capsule(model: mujoco.MjModel, geom: int) -> list[Any]:
    radius, half_length = model.geom_size[geom][:2]
    axis = np.zeros(3)
    mujoco.mju_rotVecQuat(axis, np.array([0.0, 0.0, 1.0]), model.geom_quat[geom])
    origin = model.geom_pos[geom] - half_length * axis
    return [rr.Capsules3D(lengths=[2 * half_length], radii=[radius], translations=[origin], **_common(model, geom))]


def _mesh(model: mujoco.MjModel, geom: int) -> list[Any]:
    surface = mesh(model, geom)
    return [
        rr.Mesh3D(
            vertex_positions=surface.vertices,
            vertex_normals=surface.normals,
            triangle_indices=surface.faces,
            albedo_factor=colour(model, geom),
        ),
        rr.InstancePoses3D(translations=[model.geom_pos[geom]], quaternions=[xyzw(model.geom_quat[geom])]),
    ]


_SHAPES = {
    mujoco.mjtGeom.mjGEOM_BOX: _box,
    mujoco.mjtGeom.mjGEOM_SPHERE: _ellipsoid,
    mujoco.mjtGeom.mjGEOM_ELLIPSOID: _ellipsoid,
    mujoco.mjtGeom.mjGEOM_CYLINDER: _cylinder,
    mujoco.mjtGeom.mjGEOM_CAPSULE: _capsule,
    mujoco.mjtGeom.mjGEOM_MESH: _mesh,
    mujoco.mjtGeom.mjGEOM_HFIELD: _mesh,
}
