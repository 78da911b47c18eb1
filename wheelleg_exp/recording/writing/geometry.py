"""From the compiled MuJoCo model to rerun's shapes: poses, sizes, colours."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
import rerun as rr
from numpy.typing import NDArray

Array = NDArray[np.float64]

VISUAL_GROUP = 2  # MuJoCo's convention for geoms that are only looked at
_DEFAULT_RGBA = (0.5, 0.5, 0.5, 1.0)
_PLANE_TYPES = (int(mujoco.mjtGeom.mjGEOM_PLANE),)


def xyzw(wxyz: Array) -> Array:
    """Return quaternions (..., 4) in rerun's order (x, y, z, w) from MuJoCo's (w, x, y, z)."""
    return np.roll(wxyz, -1, axis=-1)


def colour(model: mujoco.MjModel, geom: int) -> NDArray[np.uint8]:
    """Return a geom's colour (4,), 0 to 255: its own unless that is MuJoCo's default, else its material's."""
    rgba = model.geom_rgba[geom]
    material = int(model.geom_matid[geom])
    if material >= 0 and np.allclose(rgba, _DEFAULT_RGBA):
        rgba = model.mat_rgba[material]
    return np.round(np.clip(rgba, 0.0, 1.0) * 255).astype(np.uint8)


def is_collider(model: mujoco.MjModel, geom: int) -> bool:
    """Return whether a geom can touch others."""
    return bool(model.geom_contype[geom] or model.geom_conaffinity[geom])


def is_plane(model: mujoco.MjModel, geom: int) -> bool:
    """Return whether a geom is an (infinite) plane, which is drawn as ground and not as a shape."""
    return int(model.geom_type[geom]) in _PLANE_TYPES


def body_geoms(model: mujoco.MjModel, body: int) -> tuple[list[int], list[int]]:
    """Return a body's geoms to be drawn, and its colliders when they are not those.

    Drawn are the geoms of the visual group; a body without any is drawn by its colliders.
    """
    first, count = int(model.body_geomadr[body]), int(model.body_geomnum[body])
    geoms = [g for g in range(first, first + count) if not is_plane(model, g)]
    visual = [g for g in geoms if model.geom_group[g] == VISUAL_GROUP]
    colliders = [g for g in geoms if is_collider(model, g)]
    return (visual, colliders) if visual else (colliders, [])


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
    """Return a mesh with one normal a face; MuJoCo's averaged ones are wrong at sharp edges."""
    mesh = int(model.geom_dataid[geom])
    faces = slice(model.mesh_faceadr[mesh], model.mesh_faceadr[mesh] + model.mesh_facenum[mesh])
    corners = model.mesh_vertadr[mesh] + model.mesh_face[faces].ravel()
    vertices = model.mesh_vert[corners].astype(float)
    a, b, c = vertices.reshape(-1, 3, 3).transpose(1, 0, 2)
    normals = np.cross(b - a, c - a)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    return [
        rr.Mesh3D(
            vertex_positions=vertices,
            vertex_normals=np.repeat(normals, 3, axis=0),
            triangle_indices=np.arange(len(corners)).reshape(-1, 3),
            albedo_factor=colour(model, geom),
        ),
        rr.InstancePoses3D(translations=[model.geom_pos[geom]], quaternions=[xyzw(model.geom_quat[geom])]),
    ]


def _height_field(model: mujoco.MjModel, geom: int) -> list[Any]:
    """Return the surface of a height field as a mesh; data is row by row along x, scaled by the elevation."""
    field = int(model.geom_dataid[geom])
    rows, columns = int(model.hfield_nrow[field]), int(model.hfield_ncol[field])
    radius_x, radius_y, elevation, _ = model.hfield_size[field]
    start = int(model.hfield_adr[field])
    height = model.hfield_data[start : start + rows * columns] * elevation
    x, y = np.meshgrid(np.linspace(-radius_x, radius_x, columns), np.linspace(-radius_y, radius_y, rows))
    low = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
    triangles = np.stack((low, low + 1, low + columns + 1, low, low + columns + 1, low + columns), axis=1)
    return [
        rr.Mesh3D(
            vertex_positions=np.column_stack((x.ravel(), y.ravel(), height)),
            vertex_normals=_grid_normals(height.reshape(rows, columns), x, y),
            triangle_indices=triangles.reshape(-1, 3),
            albedo_factor=colour(model, geom),
        ),
        rr.InstancePoses3D(translations=[model.geom_pos[geom]], quaternions=[xyzw(model.geom_quat[geom])]),
    ]


def _grid_normals(height: Array, x: Array, y: Array) -> Array:
    slope_y, slope_x = np.gradient(height, y[:, 0], x[0])
    normals = np.stack((-slope_x, -slope_y, np.ones_like(height)), axis=-1).reshape(-1, 3)
    return normals / np.linalg.norm(normals, axis=1, keepdims=True)


_SHAPES = {
    mujoco.mjtGeom.mjGEOM_BOX: _box,
    mujoco.mjtGeom.mjGEOM_SPHERE: _ellipsoid,
    mujoco.mjtGeom.mjGEOM_ELLIPSOID: _ellipsoid,
    mujoco.mjtGeom.mjGEOM_CYLINDER: _cylinder,
    mujoco.mjtGeom.mjGEOM_CAPSULE: _capsule,
    mujoco.mjtGeom.mjGEOM_MESH: _mesh,
    mujoco.mjtGeom.mjGEOM_HFIELD: _height_field,
}
