"""Convert between compiled MuJoCo models and scenes, which contain the visible geoms of a model."""

from __future__ import annotations

from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from wheelleg_exp.rendering.render_scene import FOV, Array, Ground, Scene, Shape

VISUAL_GROUP = 2  # By MuJoCo's convention, geom group 2 contains the visual geoms of a robot.
_DEFAULT_RGBA = (0.5, 0.5, 0.5, 1.0)
_SIZES = {"box": 3, "ellipsoid": 3, "cylinder": 2, "capsule": 2}  # MuJoCo uses 2 or 3 sizes for each type of solid.
_KINDS = {name: getattr(mujoco.mjtGeom, f"mjGEOM_{name.upper()}") for name in (*_SIZES, "mesh")}
_SOLIDS = {int(_KINDS[name]): (name, count) for name, count in _SIZES.items()}
_SURFACES = (int(mujoco.mjtGeom.mjGEOM_MESH), int(mujoco.mjtGeom.mjGEOM_HFIELD))
_TILES_PER_HEIGHT = 2.0


class Surface(NamedTuple):
    """A triangle mesh: corners (n, 3), m, triangles (m, 3), and normals at the corners, (n, 3)."""

    vertices: Array
    faces: NDArray[np.int64]
    normals: Array


def scene_of_model(model: mujoco.MjModel, root: int, size: float) -> Scene:
    """Return the scene of a model's bodies in order; the camera follows ``root``; ``size`` is the robot's height, m."""
    bodies = {str(b): _shapes(model, b) for b in range(1, model.nbody)}
    planes = [g for g in range(model.ngeom) if is_plane(model, g) and model.geom_bodyid[g] == 0]
    ground = Ground(float(model.geom_pos[planes[0], 2]), size / _TILES_PER_HEIGHT) if planes else None
    return Scene(bodies, _shapes(model, 0), ground, root - 1, size)


def _shapes(model: mujoco.MjModel, body: int) -> list[Shape]:
    return [shape for shape in (shape_of(model, geom) for geom in body_geoms(model, body)[0]) if shape is not None]


def shape_of(model: mujoco.MjModel, geom: int) -> Shape | None:
    """Return a MuJoCo geom's shape in the frame of its body; None for a signed distance field, which is not drawn."""
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
    """Return a geom's colour (4,), 0 to 255: its own, or its material's if its own is MuJoCo's default."""
    rgba = model.geom_rgba[geom]
    material = int(model.geom_matid[geom])
    if material >= 0 and np.allclose(rgba, _DEFAULT_RGBA):
        rgba = model.mat_rgba[material]
    return np.asarray(np.round(np.clip(rgba, 0.0, 1.0) * 255), dtype=np.uint8)


def is_plane(model: mujoco.MjModel, geom: int) -> bool:
    """Return whether a MuJoCo geom is an infinite plane, which is drawn as ground, not as a shape."""
    return bool(model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_PLANE)


def body_geoms(model: mujoco.MjModel, body: int) -> tuple[list[int], list[int]]:
    """Return the drawn geoms and the hidden colliders of a body; a body without visual geoms shows its colliders."""
    first, count = int(model.body_geomadr[body]), int(model.body_geomnum[body])
    geoms = [g for g in range(first, first + count) if not is_plane(model, g)]
    visual = [g for g in geoms if model.geom_group[g] == VISUAL_GROUP]
    colliders = [g for g in geoms if model.geom_contype[g] or model.geom_conaffinity[g]]
    return (visual, colliders) if visual else (colliders, [])


def mesh(model: mujoco.MjModel, geom: int) -> Surface:
    """Return the surface of a geom with a mesh or a height field, in the frame of the geom."""
    is_field = model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_HFIELD
    return _height_field(model, geom) if is_field else _mesh(model, geom)


def _mesh(model: mujoco.MjModel, geom: int) -> Surface:
    """Return a geom's mesh with one normal per face, because MuJoCo's averaged normals are wrong at sharp edges."""
    number = int(model.geom_dataid[geom])
    faces = slice(model.mesh_faceadr[number], model.mesh_faceadr[number] + model.mesh_facenum[number])
    corners = model.mesh_vertadr[number] + model.mesh_face[faces].ravel()
    vertices = model.mesh_vert[corners].astype(float)
    a, b, c = vertices.reshape(-1, 3, 3).transpose(1, 0, 2)
    normals = np.cross(b - a, c - a)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    return Surface(vertices, np.arange(len(corners)).reshape(-1, 3), np.repeat(normals, 3, axis=0))


def _height_field(model: mujoco.MjModel, geom: int) -> Surface:
    field = int(model.geom_dataid[geom])
    rows, columns = int(model.hfield_nrow[field]), int(model.hfield_ncol[field])
    radius_x, radius_y, elevation, _ = model.hfield_size[field]
    start = int(model.hfield_adr[field])
    height = model.hfield_data[start : start + rows * columns] * elevation
    x, y = np.meshgrid(np.linspace(-radius_x, radius_x, columns), np.linspace(-radius_y, radius_y, rows))
    # Split each cell of the height field into two triangles; ``low`` contains the index of each cell's first vertex.
    low = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
    triangles = np.stack((low, low + 1, low + columns + 1, low, low + columns + 1, low + columns), axis=1)
    vertices = np.column_stack((x.ravel(), y.ravel(), height))
    slope_y, slope_x = np.gradient(height.reshape(rows, columns), y[:, 0], x[0])
    normals = np.stack((-slope_x, -slope_y, np.ones_like(slope_x)), axis=-1).reshape(-1, 3)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return Surface(vertices, triangles.reshape(-1, 3), normals)


class Kinematics:
    """Computes body poses from joint positions with its own ``MjData``, so that the simulation stays unchanged."""

    def __init__(self, model: mujoco.MjModel) -> None:
        self._model = model
        self._data = mujoco.MjData(model)
        self.xpos: Array = self._data.xpos
        self.xquat: Array = self._data.xquat

    def update(self, qpos: Array) -> None:
        """Compute the body poses ``xpos`` (B, 3), m, and ``xquat`` (B, 4), wxyz, at joint positions ``qpos`` (nq,)."""
        self._data.qpos[:] = qpos
        mujoco.mj_kinematics(self._model, self._data)

    def poses(self, qpos: Array) -> tuple[Array, Array]:
        """Return all body positions (n, B, 3), m, and orientations (n, B, 4), wxyz, for n rows of ``qpos`` (n, nq)."""
        count = len(qpos)
        positions, orientations = np.empty((count, *self.xpos.shape)), np.empty((count, *self.xquat.shape))
        for i, row in enumerate(qpos):
            self.update(row)
            positions[i], orientations[i] = self.xpos, self.xquat
        return positions, orientations

    def height(self, root: int, qpos: Array) -> float:
        """Return the height, m, of the robot with base ``root`` at joint positions ``qpos``; the minimum is 0.01 m."""
        self.update(qpos)
        # ``bodies`` lists the body ``root`` and all its descendants.
        bodies = [root]
        for body in range(root + 1, self._model.nbody):
            if int(self._model.body_parentid[body]) in bodies:
                bodies.append(body)
        below = np.flatnonzero(np.isin(self._model.geom_bodyid, bodies)).tolist()
        geoms = [g for g in below if not is_plane(self._model, g)]
        if not geoms:
            return 0.1
        centre, radius = self._data.geom_xpos[geoms, 2], self._model.geom_rbound[geoms]
        return max(float((centre + radius).max() - (centre - radius).min()), 0.01)


RIG = "rig"
_FINE_SHADOWS_FROM = 800  # px
_FLOOR_LIGHT, _FLOOR_DARK = (0.80, 0.815, 0.83), (0.70, 0.725, 0.75)
_SKY_TOP, _SKY_HORIZON = (0.74, 0.83, 0.93), (0.95, 0.965, 0.98)


def build_model(scene: Scene, width: int, height: int, samples: int) -> mujoco.MjModel:
    """Return a scene's compiled MuJoCo model; the first mocap body carries the lights, the others are scene bodies.

    ``samples`` is the number of multisamples per pixel; 0 disables multisampling for drivers that lack it.
    """
    spec = mujoco.MjSpec()
    _look(spec, scene.size, width, height, samples)
    # A terrain needs a large shadow map, so that the border of the shadows is outside the picture.
    spec.visual.map.shadowclip = 8.0 if scene.fixed else 2.5
    spec.visual.quality.shadowsize = 4096 if height > _FINE_SHADOWS_FROM or scene.fixed else 2048
    if scene.ground is not None:
        texture = spec.add_texture(
            name="tiles", type=mujoco.mjtTexture.mjTEXTURE_2D, builtin=mujoco.mjtBuiltin.mjBUILTIN_CHECKER,
            width=512, height=512, rgb1=_FLOOR_LIGHT, rgb2=_FLOOR_DARK,
        )  # fmt: skip
        # MuJoCo's checker texture has 2 x 2 squares, so a texture of width 2 * tile shows squares of width ``tile``.
        repeat = [0.5 / scene.ground.tile] * 2
        material = spec.add_material(name="floor", texuniform=True, texrepeat=repeat, specular=0.05)
        material.textures[int(mujoco.mjtTextureRole.mjTEXROLE_RGB)] = texture.name
        spec.worldbody.add_geom(
            name="floor", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 1], pos=[0, 0, scene.ground.height],
            material="floor", contype=0, conaffinity=0,
        )  # fmt: skip
    # The body ``rig`` follows the robot with a main light that casts shadows, and a weak light on the opposite side.
    rig = spec.worldbody.add_body(name=RIG, mocap=True)
    for place, strength, shadow in (((-1.1, -1.5, 3.0), 0.62, True), ((1.8, 1.2, 1.6), 0.16, False)):
        position = np.array(place) * 4.0 * scene.size
        rig.add_light(
            type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL, pos=position, dir=-position / np.linalg.norm(position),
            castshadow=shadow, ambient=[0, 0, 0], diffuse=[strength] * 3, specular=[0.25 * shadow] * 3,
        )  # fmt: skip
    for i, shape in enumerate(scene.fixed):
        _add(spec, spec.worldbody, shape, f"fixed_{i}")
    for b, shapes in enumerate(scene.bodies.values()):
        body = spec.worldbody.add_body(name=f"body_{b}", mocap=True)
        for i, shape in enumerate(shapes):
            _add(spec, body, shape, f"body_{b}_{i}")
    return spec.compile()


def _look(spec: mujoco.MjSpec, size: float, width: int, height: int, samples: int) -> None:
    spec.stat.extent = 2.5 * size
    spec.stat.center = [0.0, 0.0, 0.0]
    visual = spec.visual
    visual.global_.offwidth, visual.global_.offheight = width, height
    visual.global_.fovy = FOV
    visual.quality.offsamples = samples
    visual.quality.numslices, visual.quality.numstacks = 56, 28
    visual.map.znear, visual.map.zfar = 0.05, 120.0
    visual.map.haze = 0.35
    visual.headlight.ambient = [0.42, 0.42, 0.43]
    visual.headlight.diffuse = [0.22, 0.22, 0.22]
    visual.headlight.specular = [0.1, 0.1, 0.1]
    visual.rgba.haze = [*np.mean((_SKY_TOP, _SKY_HORIZON), axis=0), 1.0]
    spec.add_texture(
        name="sky", type=mujoco.mjtTexture.mjTEXTURE_SKYBOX, builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
        width=64, height=384, rgb1=_SKY_TOP, rgb2=_SKY_HORIZON,
    )  # fmt: skip


def _add(spec: mujoco.MjSpec, body: mujoco.MjsBody, shape: Shape, name: str) -> None:
    if shape.kind == "mesh":
        # Skip a mesh without area. Add other meshes as open shells, because a terrain has no volume.
        if shape.vertices is None or shape.faces is None or len(shape.vertices) < 4:
            return
        a, b, c = shape.vertices[shape.faces].transpose(1, 0, 2)
        if not np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() > 0:
            return
        vertices, faces = shape.vertices.ravel(), shape.faces.ravel()
        shell = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
        mesh = spec.add_mesh(name=name, uservert=vertices, userface=faces, inertia=shell)
        if shape.normals is not None:
            mesh.usernormal = shape.normals.ravel()
    size = [*(max(float(part), 1e-6) for part in shape.size), 0.0, 0.0][:3]
    form: dict[str, object] = {"meshname": name} if shape.kind == "mesh" else {"size": size}
    place, style = {"pos": shape.pos, "quat": shape.quat}, {"rgba": shape.rgba, "contype": 0, "conaffinity": 0}
    body.add_geom(type=_KINDS[shape.kind], **form, **place, **style, mass=0.0)
