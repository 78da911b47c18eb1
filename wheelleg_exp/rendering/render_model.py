"""A MuJoCo model of a recorded scene: every body a mocap body, a checkered floor, a light that follows the robot."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np

from wheelleg_exp.rendering.scene import Scene
from wheelleg_exp.rendering.shapes import Shape

FOV = 30.0  # degrees, as MuJoCo wants it: a long lens, so that small robots are not distorted
RIG = "rig"
_FINE_SHADOWS_FROM = 800  # px
_FLOOR_LIGHT, _FLOOR_DARK = (0.80, 0.815, 0.83), (0.70, 0.725, 0.75)
_SKY_TOP, _SKY_HORIZON = (0.74, 0.83, 0.93), (0.95, 0.965, 0.98)
_KINDS = {
    "box": mujoco.mjtGeom.mjGEOM_BOX,
    "ellipsoid": mujoco.mjtGeom.mjGEOM_ELLIPSOID,
    "cylinder": mujoco.mjtGeom.mjGEOM_CYLINDER,
    "capsule": mujoco.mjtGeom.mjGEOM_CAPSULE,
    "mesh": mujoco.mjtGeom.mjGEOM_MESH,
}


def build(scene: Scene, width: int, height: int, samples: int) -> mujoco.MjModel:
    """Return the compiled model.

    Args:
        scene: the shapes; the mocap bodies stand in their order, after the light's rig.
        width: of the pictures, px.
        height: of the pictures, px.
        samples: of a pixel, against jagged edges; 0 when the driver can do none.
    """
    spec = mujoco.MjSpec()
    _look(spec, scene.size, width, height, samples)
    _shadows(spec.visual, is_fine=height > _FINE_SHADOWS_FROM, is_wide=bool(scene.fixed))
    if scene.ground is not None:
        _floor(spec, scene.ground.height, scene.ground.tile)
    _lights(spec, scene.size)
    for i, shape in enumerate(scene.fixed):
        _add(spec, spec.worldbody, shape, f"fixed_{i}")
    for b, shapes in enumerate(scene.bodies.values()):
        body = spec.worldbody.add_body(name=f"body_{b}", mocap=True)
        for i, shape in enumerate(shapes):
            _add(spec, body, shape, f"body_{b}_{i}")
    return spec.compile()


def _look(spec: Any, size: float, width: int, height: int, samples: int) -> None:
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


def _shadows(visual: Any, *, is_fine: bool, is_wide: bool) -> None:
    """Set how far around the robot there are shadows: on a terrain their border shows, and has to be out of sight."""
    visual.map.shadowclip = 8.0 if is_wide else 2.5
    visual.quality.shadowsize = 4096 if is_fine or is_wide else 2048


def _floor(spec: Any, height: float, tile: float) -> None:
    texture = spec.add_texture(
        name="tiles", type=mujoco.mjtTexture.mjTEXTURE_2D, builtin=mujoco.mjtBuiltin.mjBUILTIN_CHECKER,
        width=512, height=512, rgb1=_FLOOR_LIGHT, rgb2=_FLOOR_DARK,
    )  # fmt: skip
    # A texture holds two tiles along an edge.
    material = spec.add_material(name="floor", texuniform=True, texrepeat=[0.5 / tile, 0.5 / tile], specular=0.05)
    material.textures[int(mujoco.mjtTextureRole.mjTEXROLE_RGB)] = texture.name
    spec.worldbody.add_geom(
        name="floor", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 1], pos=[0, 0, height], material="floor",
        contype=0, conaffinity=0,
    )  # fmt: skip


def _lights(spec: Any, size: float) -> None:
    """Add a key light with shadows and a fill light from the other side, both at a rig that follows the robot."""
    rig = spec.worldbody.add_body(name=RIG, mocap=True)
    for place, strength, shadow in (((-1.1, -1.5, 3.0), 0.62, True), ((1.8, 1.2, 1.6), 0.16, False)):
        position = np.array(place) * 4.0 * size
        rig.add_light(
            type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL, pos=position, dir=-position / np.linalg.norm(position),
            castshadow=shadow, ambient=[0, 0, 0], diffuse=[strength] * 3, specular=[0.25 * shadow] * 3,
        )  # fmt: skip


def _add(spec: Any, body: Any, shape: Shape, name: str) -> None:
    fields: dict[str, Any] = {"contype": 0, "conaffinity": 0, "mass": 0.0}
    if shape.kind == "mesh":
        if not _mesh(spec, shape, name):
            return
        fields["meshname"] = name
    else:
        fields["size"] = _three([max(float(part), 1e-6) for part in shape.size])
    body.add_geom(type=_KINDS[shape.kind], pos=shape.pos, quat=shape.quat, rgba=shape.rgba, **fields)


def _mesh(spec: Any, shape: Shape, name: str) -> bool:
    """Add a mesh as an open shell, since a terrain has no volume; a mesh without an area is left out."""
    if shape.vertices is None or shape.faces is None or len(shape.vertices) < 4:
        return False
    a, b, c = shape.vertices[shape.faces].transpose(1, 0, 2)
    if not np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() > 0:
        return False
    mesh = spec.add_mesh(
        name=name,
        uservert=shape.vertices.ravel(),
        userface=shape.faces.ravel(),
        inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL,
    )
    if shape.normals is not None:
        mesh.usernormal = shape.normals.ravel()
    return True


def _three(size: Sequence[float]) -> list[float]:
    return [*size, 0.0, 0.0, 0.0][:3]
