"""What a compiled MuJoCo model looks like: which of its geoms are drawn, their colours and surfaces."""

from __future__ import annotations

from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from wheelleg_exp.rendering.scene import Ground, Scene
from wheelleg_exp.rendering.shapes import Array, Shape

VISUAL_GROUP = 2  # MuJoCo's convention for geoms that are only looked at
_DEFAULT_RGBA = (0.5, 0.5, 0.5, 1.0)
_PLANE_TYPES = (int(mujoco.mjtGeom.mjGEOM_PLANE),)
_SOLIDS = {
    int(mujoco.mjtGeom.mjGEOM_BOX): ("box", 3),
    int(mujoco.mjtGeom.mjGEOM_ELLIPSOID): ("ellipsoid", 3),
    int(mujoco.mjtGeom.mjGEOM_CYLINDER): ("cylinder", 2),
    int(mujoco.mjtGeom.mjGEOM_CAPSULE): ("capsule", 2),
}
_SURFACES = (int(mujoco.mjtGeom.mjGEOM_MESH), int(mujoco.mjtGeom.mjGEOM_HFIELD))
_TILES_PER_HEIGHT = 2.0


class Surface(NamedTuple):
    """A surface of triangles: corners (n, 3), m, triangles (m, 3), and the normals at the corners, (n, 3)."""

    vertices: Array
    faces: NDArray[np.int64]
    normals: Array


def scene_of_model(model: mujoco.MjModel, root: int, size: float) -> Scene:
    """Return what is drawn of a compiled scene.

    Args:
        model: the scene; its bodies but the world are the scene's, in order.
        root: the body that the eye follows.
        size: how tall the robot stands, m.
    """
    bodies = {str(b): _shapes(model, b) for b in range(1, model.nbody)}
    planes = [g for g in range(model.ngeom) if is_plane(model, g) and model.geom_bodyid[g] == 0]
    ground = Ground(float(model.geom_pos[planes[0], 2]), size / _TILES_PER_HEIGHT) if planes else None
    return Scene(bodies, _shapes(model, 0), ground, root - 1, size)


def _shapes(model: mujoco.MjModel, body: int) -> list[Shape]:
    found = (shape_of(model, geom) for geom in body_geoms(model, body)[0])
    return [shape for shape in found if shape is not None]


def shape_of(model: mujoco.MjModel, geom: int) -> Shape | None:
    """Return a geom's shape in the frame of its body; None for a type that is not drawn (signed distance fields)."""
    kind = int(model.geom_type[geom])
    pos, quat = tuple(model.geom_pos[geom].tolist()), tuple(model.geom_quat[geom].tolist())
    rgba = tuple((colour(model, geom) / 255).tolist())
    size = model.geom_size[geom].tolist()
    if kind == mujoco.mjtGeom.mjGEOM_SPHERE:
        return Shape("ellipsoid", (size[0],) * 3, pos, quat, rgba)
    if kind in _SOLIDS:
        name, count = _SOLIDS[kind]
        return Shape(name, tuple(size[:count]), pos, quat, rgba)
    return Shape("mesh", (), pos, quat, rgba, *mesh(model, geom)) if kind in _SURFACES else None


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


def mesh(model: mujoco.MjModel, geom: int) -> Surface:
    """Return the surface of a mesh or of a height field, in the frame of the geom."""
    is_field = model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_HFIELD
    return _height_field(model, geom) if is_field else _mesh(model, geom)


def _mesh(model: mujoco.MjModel, geom: int) -> Surface:
    """Return a mesh with one normal a face; MuJoCo's averaged ones are wrong at sharp edges."""
    number = int(model.geom_dataid[geom])
    faces = slice(model.mesh_faceadr[number], model.mesh_faceadr[number] + model.mesh_facenum[number])
    corners = model.mesh_vertadr[number] + model.mesh_face[faces].ravel()
    vertices = model.mesh_vert[corners].astype(float)
    a, b, c = vertices.reshape(-1, 3, 3).transpose(1, 0, 2)
    normals = np.cross(b - a, c - a)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    return Surface(vertices, np.arange(len(corners)).reshape(-1, 3), np.repeat(normals, 3, axis=0))


def _height_field(model: mujoco.MjModel, geom: int) -> Surface:
    """Return the surface of a height field as a mesh; data is row by row along x, scaled by the elevation."""
    field = int(model.geom_dataid[geom])
    rows, columns = int(model.hfield_nrow[field]), int(model.hfield_ncol[field])
    radius_x, radius_y, elevation, _ = model.hfield_size[field]
    start = int(model.hfield_adr[field])
    height = model.hfield_data[start : start + rows * columns] * elevation
    x, y = np.meshgrid(np.linspace(-radius_x, radius_x, columns), np.linspace(-radius_y, radius_y, rows))
    low = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
    triangles = np.stack((low, low + 1, low + columns + 1, low, low + columns + 1, low + columns), axis=1)
    vertices = np.column_stack((x.ravel(), y.ravel(), height))
    return Surface(vertices, triangles.reshape(-1, 3), _grid_normals(height.reshape(rows, columns), x, y))


def _grid_normals(height: Array, x: Array, y: Array) -> Array:
    slope_y, slope_x = np.gradient(height, y[:, 0], x[0])
    normals = np.stack((-slope_x, -slope_y, np.ones_like(height)), axis=-1).reshape(-1, 3)
    return normals / np.linalg.norm(normals, axis=1, keepdims=True)
