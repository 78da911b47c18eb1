"""Fit MuJoCo's shapes to USD's gprims, and give the volume and moments of solid shapes."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray
from pxr import Usd, UsdGeom

from wheelleg_exp.asset import rigid_geometry as geometry
from wheelleg_exp.asset.rigid_geometry import Z_TO_AXIS, Array, Frame, MeshVolume, Solid
from wheelleg_exp.asset.robot_description import ShapeKind
from wheelleg_exp.asset.usd.ledger import number_of, plain

THIN = 1e-3  # m
SMALLEST_AREA = 1e-12  # m²
_SEGMENTS = 32  # polygon sides


@dataclass(frozen=True, eq=False)
class Shape:
    """A shape of a body, with MuJoCo's geom type and size (m); a mesh has points (n, 3) and triangles (k, 3).

    ``weight`` is the kind, size, and frame (in the shape's) of PhysX's solid for the mass; None means the shape itself.
    """

    kind: ShapeKind
    size: tuple[float, ...]
    frame: Frame
    vertices: Array | None = None
    faces: NDArray[np.int64] | None = None
    note: str = ""
    weight: tuple[str, tuple[float, ...], Frame] | None = None

    @property
    def points(self) -> int:
        """The number of points plus the number of triangles of the mesh."""
        return sum(len(array) for array in (self.vertices, self.faces) if array is not None)


def shape_of(prim: Usd.Prim, matrix: Array) -> Shape | None:
    """Return a gprim's shape, if it is supported and valid; ``matrix`` (4, 4) maps to the body's coordinates in m."""
    make = _MAKERS.get(str(prim.GetTypeName()))
    if make is None:
        return None
    rotation, stretch = geometry.split_scale(matrix[:3, :3])
    return make(prim, _Placing(rotation, stretch, matrix[:3, 3].copy()))


@dataclass(frozen=True, eq=False)
class _Placing:
    rotation: Array
    stretch: Array
    origin: Array

    @property
    def scale(self) -> Array | None:
        """The factors that scale a shape along its own axes; None if the transform shears the shape."""
        off = self.stretch - np.diag(np.diag(self.stretch))
        return None if np.abs(off).max() > 1e-6 * np.abs(self.stretch).max() else np.abs(np.diag(self.stretch))

    def frame(self, turn: Array | None = None) -> Frame:
        return Frame(self.rotation if turn is None else self.rotation @ turn, self.origin)


Maker = Callable[[Usd.Prim, _Placing], "Shape | None"]


def _clean(*sizes: float) -> tuple[float, ...]:
    return tuple(geometry.rounded(float(size)) for size in sizes)


def _axis(prim: Usd.Prim) -> tuple[str, str]:
    value = plain(prim.GetAttribute("axis").Get())
    if value is None or (isinstance(value, str) and value in (*Z_TO_AXIS, "")):
        return value or "Z", ""
    return "Z", f"axis '{str(value)[:20]}' is unknown: Z"


def _cube(prim: Usd.Prim, at: _Placing) -> Shape:
    half = number_of(prim, "size") / 2
    if at.scale is None:
        corners = np.array([[x, y, z] for x in (-half, half) for y in (-half, half) for z in (-half, half)])
        return _hull(corners, at, "sheared")
    return Shape("box", _clean(*(half * at.scale)), at.frame())


def _sphere(prim: Usd.Prim, at: _Placing) -> Shape:
    radius = number_of(prim, "radius")
    if at.scale is None:
        values, axes = np.linalg.eigh(at.stretch)
        axes = axes if np.linalg.det(axes) > 0 else -axes
        return Shape("ellipsoid", _clean(*(radius * np.abs(values))), at.frame(axes), note="scaled unevenly: ellipsoid")
    if np.ptp(at.scale) <= 1e-6 * at.scale.max():
        return Shape("sphere", _clean(radius * at.scale[0]), at.frame())
    weight = ("sphere", (radius * float(at.scale.max()),), Frame.identity())
    note = "scaled unevenly: ellipsoid, weighed as the sphere around it as in PhysX"
    return Shape("ellipsoid", _clean(*(radius * at.scale)), at.frame(), note=note, weight=weight)


def _round(kind: ShapeKind, prim: Usd.Prim, at: _Placing) -> Shape:
    # The USD types Capsule_1 and Cylinder_1 have a top radius and a bottom radius.
    ends = ("radiusTop", "radiusBottom") if prim.GetTypeName().endswith("_1") else ("radius", "radius")
    top, bottom = (number_of(prim, name) for name in ends)
    (axis, note), half = _axis(prim), number_of(prim, "height") / 2
    along = "XYZ".index(axis)
    across = [i for i in range(3) if i != along]
    # A capsule or cylinder becomes a convex hull if it has two radii, is sheared, or has an oval cross-section.
    tapered = abs(top - bottom) > 1e-6 * max(top, bottom)
    oval = at.scale is None or (
        kind == "cylinder" and abs(np.subtract(*at.scale[across])) > 1e-6 * at.scale[across].max()
    )
    if (tapered or oval) and min(top, bottom, half) >= 0 < max(top, bottom):
        why = "with two radii" if tapered else "scaled unevenly or sheared"
        hull = _hull(_rings(top, bottom, half, kind) @ Z_TO_AXIS[axis].T, at, why)
        return hull if tapered else _weighed(hull, "cylinder", at, axis, top, half)
    scale = np.ones(3) if at.scale is None else at.scale
    radius, length = top * scale[across].max(), half * scale[along]
    if kind == "capsule" and length == 0:
        return Shape("sphere", _clean(radius), at.frame(), note=note or "a capsule without height: a sphere")
    return Shape(kind, _clean(radius, length), at.frame(Z_TO_AXIS[axis]), note=note)


def _rings(top: float, bottom: float, half: float, kind: ShapeKind) -> Array:
    levels = [(half, top), (-half, bottom)]
    if kind == "capsule":
        tilt = np.linspace(0, math.pi / 2, 7)
        levels = [
            (side * (half + radius * math.sin(t)), radius * math.cos(t))
            for t in tilt
            for side, radius in ((1, top), (-1, bottom))
        ]
    angles = np.linspace(0, 2 * math.pi, _SEGMENTS, endpoint=False)
    return np.array([[r * math.cos(a), r * math.sin(a), z] for z, r in levels for a in angles])


def _cone(prim: Usd.Prim, at: _Placing) -> Shape:
    (axis, _), half, radius = _axis(prim), number_of(prim, "height") / 2, number_of(prim, "radius")
    angles = np.linspace(0, 2 * math.pi, _SEGMENTS, endpoint=False)
    ring = [[math.cos(a) * radius, math.sin(a) * radius, -half] for a in angles]
    hull = _hull(np.array([*ring, [0.0, 0.0, half]]) @ Z_TO_AXIS[axis].T, at, f"a cone of {_SEGMENTS} sides")
    return _weighed(hull, "cone", at, axis, radius, half)


def _plane(prim: Usd.Prim, at: _Placing) -> Shape:
    """Return an infinite plane; a transform that mirrors the USD plane also mirrors its normal."""
    axis, note = _axis(prim)
    turn = Z_TO_AXIS[axis]
    if at.scale is None or np.diag(at.stretch).min() < 0:
        normal = np.linalg.pinv(at.stretch).T @ turn[:, 2]
        direction = normal / (np.linalg.norm(normal) or 1.0)
        helper = np.eye(3)[int(np.argmin(np.abs(direction)))]
        x = np.cross(helper, direction)
        x /= np.linalg.norm(x) or 1.0
        turn = np.stack([x, np.cross(direction, x), direction], axis=1)
    return Shape("plane", (0.0, 0.0, 1.0), at.frame(turn), note=note)


def plane_as_box(prim: Usd.Prim, matrix: Array) -> Shape:
    """Return a drawn plane as a thin box, for bodies that move: MuJoCo's planes are static."""
    rotation, stretch = geometry.split_scale(matrix[:3, :3])
    along = "XYZ".index(_axis(prim)[0])
    sides = {0: (2, 1), 1: (0, 2), 2: (0, 1)}[along]  # UsdGeomPlane's width and length
    half = np.full(3, THIN / 2)
    for side, name in zip(sides, ("width", "length"), strict=True):
        half[side] = number_of(prim, name) / 2 * abs(stretch[side, side])
    return Shape("box", _clean(*half), Frame(rotation, matrix[:3, 3].copy()), note="a plane that moves: a thin box")


def _mesh(prim: Usd.Prim, at: _Placing) -> Shape | None:
    """Return a mesh's scaled points and its triangles without the mesh's holes; None if the mesh is invalid."""
    mesh = UsdGeom.Mesh(prim)
    points = _points(mesh)
    counts, indices = (_integers(a.Get()) for a in (mesh.GetFaceVertexCountsAttr(), mesh.GetFaceVertexIndicesAttr()))
    if points is None or counts is None or indices is None or (counts < 0).any() or counts.sum() != len(indices):
        return None
    if len(indices) and not (indices.min() >= 0 and indices.max() < len(points)):
        return None
    holes = _integers(mesh.GetHoleIndicesAttr().Get())
    holes = None if holes is None else holes[(holes >= 0) & (holes < len(counts))]
    faces = triangles(counts, indices, holes)
    if len(points) == 3:  # MuJoCo needs four points
        points = np.vstack([points, points.mean(axis=0)])
    with np.errstate(all="ignore"):
        vertices = points @ at.stretch.T
    if len(faces) and area(vertices, faces) < SMALLEST_AREA:
        return None
    # Left-handed orientation and mirroring each reverse the triangles of a mesh; together, they cancel out.
    flipped = (mesh.GetOrientationAttr().Get() == "leftHanded") != (np.linalg.det(at.stretch) < 0)
    return Shape("mesh", (), at.frame(), vertices, faces[:, ::-1] if flipped else faces)


def _points(mesh: UsdGeom.Mesh) -> Array | None:
    try:
        points = np.asarray(mesh.GetPointsAttr().Get(), dtype=float)
    except (TypeError, ValueError):
        return None
    return points if points.ndim == 2 and points.shape[1] == 3 and len(points) >= 3 else None


def _integers(value: object) -> NDArray[np.int64] | None:
    array = np.asarray([] if value is None else value)
    return None if array.ndim != 1 or (array.size and array.dtype.kind not in "iu") else array.astype(np.int64)


def area(vertices: Array, faces: NDArray[np.int64]) -> float:
    """Return the area of a mesh with the given points (n, 3) and triangles (k, 3)."""
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    with np.errstate(all="ignore"):
        return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum()) / 2


def triangles(
    counts: NDArray[np.int64], indices: NDArray[np.int64], holes: NDArray[np.int64] | None = None
) -> NDArray[np.int64]:
    """Return triangles (k, 3): each polygon except holes as a fan around its first corner, in order."""
    # A polygon with n corners gives n - 2 triangles; all polygons of the mesh are split at once.
    starts = np.cumsum(counts) - counts
    fans = np.maximum(counts - 2, 0)
    if holes is not None:
        fans[holes] = 0
    first = np.repeat(starts, fans)
    corner = np.arange(len(first)) - np.repeat(np.cumsum(fans) - fans, fans) + 1
    return np.stack([indices[first], indices[first + corner], indices[first + corner + 1]], axis=1).astype(np.int64)


def _weighed(hull: Shape, kind: str, at: _Placing, axis: str, radius: float, half: float) -> Shape:
    """Give a hull the mass of PhysX's round solid: the larger scale across the axis counts."""
    if at.scale is None:
        return hull
    along = "XYZ".index(axis)
    size = radius * float(np.delete(at.scale, along).max()), half * float(at.scale[along])
    mirrored = -1.0 if np.trace(at.stretch) < 0 else 1.0
    return replace(hull, weight=(kind, size, Frame(mirrored * Z_TO_AXIS[axis], np.zeros(3))))


def _hull(points: Array, at: _Placing, note: str) -> Shape:
    return Shape("mesh", (), at.frame(), points @ at.stretch.T, None, f"{note}: a mesh")


_MAKERS: dict[str, Maker] = {
    "Cube": _cube,
    "Sphere": _sphere,
    **dict.fromkeys(("Capsule", "Capsule_1"), partial(_round, "capsule")),
    **dict.fromkeys(("Cylinder", "Cylinder_1"), partial(_round, "cylinder")),
    "Cone": _cone,
    "Plane": _plane,
    "Mesh": _mesh,
}


def solid_of(shape: Shape, volume: MeshVolume = "convex", wall: float | None = None) -> Solid | None:
    """Return the solid of a shape, in the frame of the shape's body; None if the shape has no volume.

    ``volume`` is the volume mode of a mesh, a value of the MJCF mesh attribute ``inertia``. A ``shell`` is hollow, also
    if the shape is not a mesh. Its wall has the depth ``wall`` (m); None means that ``Solid.volume`` is the area.
    """
    if shape.kind == "plane":
        return None
    shell, itself = volume == "shell", (shape.kind, shape.size, Frame.identity())
    kind, size, frame = itself if shape.weight is None or (shell and shape.vertices is None) else shape.weight
    try:
        if kind != "mesh":
            solid = (geometry.hollow(kind, size, wall) if shell else geometry.primitive(kind, size)).seen_from(frame)
        else:
            assert shape.vertices is not None
            solid = geometry.mesh_solid(shape.vertices, shape.faces, volume).scaled(wall or 1.0)
            if wall:  # A mesh weighs at most as much as its hull.
                solid = min(solid, geometry.mesh_solid(shape.vertices, shape.faces, "convex"), key=lambda s: s.volume)
    except ValueError:
        return None
    return solid.seen_from(shape.frame) if solid.volume > 0 else None


def bounding_box(shape: Shape) -> Shape:
    """Return the bounding box of a mesh, along the mesh's axes."""
    assert shape.vertices is not None
    low, high = shape.vertices.min(axis=0), shape.vertices.max(axis=0)
    frame = shape.frame @ Frame(np.eye(3), (low + high) / 2)
    return Shape("box", _clean(*((high - low) / 2)), frame, note="box around the mesh")


def bounding_sphere(shape: Shape) -> Shape:
    """Return the bounding sphere of a mesh, about the centre of the mesh's bounding box."""
    assert shape.vertices is not None
    middle = (shape.vertices.min(axis=0) + shape.vertices.max(axis=0)) / 2
    radius = float(np.linalg.norm(shape.vertices - middle, axis=1).max())
    return Shape("sphere", _clean(radius), shape.frame @ Frame(np.eye(3), middle), note="sphere around the mesh")


def flat_to_box(shape: Shape) -> Shape:
    """Return a thin box for a mesh whose points are in one plane, else the shape itself."""
    assert shape.vertices is not None
    middle = shape.vertices.mean(axis=0)
    _, spread, axes = np.linalg.svd(shape.vertices - middle, full_matrices=False)
    if spread[-1] > 1e-6 * max(spread[0], 1e-12):
        return shape
    axes = axes if np.linalg.det(axes) > 0 else -axes
    local = (shape.vertices - middle) @ axes.T
    low, high = local.min(axis=0), local.max(axis=0)
    half = (high - low) / 2
    half[2] = THIN / 2
    center = (low + high) / 2
    frame = shape.frame @ Frame(axes.T, middle + axes.T @ center)
    return Shape("box", _clean(*half), frame, note="flat: a thin box")
