"""Fits MuJoCo's shapes to USD's gprims, and gives volumes and moments of solid shapes."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pxr import Usd, UsdGeom

from wheelleg_exp.asset.description import ShapeKind
from wheelleg_exp.asset.geometry import Z_TO_AXIS, Array, Frame, rounded, split_scale

SMALLEST_AREA = 1e-12  # m²; MuJoCo refuses meshes without a surface
_SEGMENTS = 32  # sides of a cone, and of a cylinder that is not round


@dataclass(frozen=True, eq=False)
class Shape:
    """A shape in its body: MuJoCo's kind and size (m), a frame, a mesh's points (n, 3), triangles (k, 3)."""

    kind: ShapeKind
    size: tuple[float, ...]
    frame: Frame
    vertices: Array | None = None
    faces: NDArray[np.int64] | None = None
    note: str = ""


def shape_of(prim: Usd.Prim, matrix: Array) -> Shape | None:
    """Return the shape of a gprim, None when the kind is not supported.

    Args:
        prim: a Cube, Sphere, Capsule, Cylinder, Cone, Plane or Mesh.
        matrix: 4x4, from the gprim's coordinates to its body's in metres.
    """
    make = _MAKERS.get(str(prim.GetTypeName()))
    if make is None:
        return None
    rotation, stretch = split_scale(matrix[:3, :3])
    return make(prim, _Placing(rotation, stretch, matrix[:3, 3].copy()))


@dataclass(frozen=True, eq=False)
class _Placing:
    rotation: Array
    stretch: Array
    origin: Array

    @property
    def scale(self) -> Array | None:
        """Scale along the shape's own axes, None when it is sheared."""
        off = self.stretch - np.diag(np.diag(self.stretch))
        if np.abs(off).max() > 1e-6 * np.abs(self.stretch).max():
            return None
        return np.abs(np.diag(self.stretch))

    def frame(self, turn: Array | None = None) -> Frame:
        return Frame(self.rotation if turn is None else self.rotation @ turn, self.origin)


Maker = Callable[[Usd.Prim, _Placing], "Shape | None"]


def _clean(*sizes: float) -> tuple[float, ...]:
    return tuple(rounded(float(size)) for size in sizes)


def _get(prim: Usd.Prim, name: str) -> float:
    return float(prim.GetAttribute(name).Get())


def _cube(prim: Usd.Prim, at: _Placing) -> Shape:
    half = _get(prim, "size") / 2
    if at.scale is None:
        corners = np.array([[x, y, z] for x in (-half, half) for y in (-half, half) for z in (-half, half)])
        return _hull(corners, at, "sheared")
    return Shape("box", _clean(*(half * at.scale)), at.frame())


def _sphere(prim: Usd.Prim, at: _Placing) -> Shape:
    radius = _get(prim, "radius")
    if at.scale is None:
        values, axes = np.linalg.eigh(at.stretch)
        axes = axes if np.linalg.det(axes) > 0 else -axes
        return Shape("ellipsoid", _clean(*(radius * np.abs(values))), at.frame(axes), note="scaled unevenly: ellipsoid")
    if np.ptp(at.scale) <= 1e-6 * at.scale.max():
        return Shape("sphere", _clean(radius * at.scale[0]), at.frame())
    return Shape("ellipsoid", _clean(*(radius * at.scale)), at.frame(), note="scaled unevenly: ellipsoid")


def _round(kind: ShapeKind) -> Maker:
    def make(prim: Usd.Prim, at: _Placing) -> Shape:
        axis = prim.GetAttribute("axis").Get() or "Z"
        radius, half = _get(prim, "radius"), _get(prim, "height") / 2
        along = "XYZ".index(axis)
        across = [i for i in range(3) if i != along]
        if at.scale is None or (
            kind == "cylinder" and abs(np.subtract(*at.scale[across])) > 1e-6 * at.scale[across].max()
        ):
            return _hull(_rings(radius, half, kind) @ Z_TO_AXIS[axis].T, at, "scaled unevenly or sheared")
        size = _clean(radius * at.scale[across].max(), half * at.scale[along])
        return Shape(kind, size, at.frame(Z_TO_AXIS[axis]))

    return make


def _rings(radius: float, half: float, kind: ShapeKind) -> Array:
    """Return points of a cylinder or a capsule about z."""
    levels = [(half, radius), (-half, radius)]
    if kind == "capsule":
        tilt = np.linspace(0, math.pi / 2, 7)
        levels = [(s * (half + radius * math.sin(t)), radius * math.cos(t)) for t in tilt for s in (1, -1)]
    angles = np.linspace(0, 2 * math.pi, _SEGMENTS, endpoint=False)
    return np.array([[r * math.cos(a), r * math.sin(a), z] for z, r in levels for a in angles])


def _cone(prim: Usd.Prim, at: _Placing) -> Shape:
    axis, half = prim.GetAttribute("axis").Get() or "Z", _get(prim, "height") / 2
    angles = np.linspace(0, 2 * math.pi, _SEGMENTS, endpoint=False)
    ring = [[math.cos(a) * _get(prim, "radius"), math.sin(a) * _get(prim, "radius"), -half] for a in angles]
    return _hull(np.array([*ring, [0.0, 0.0, half]]) @ Z_TO_AXIS[axis].T, at, f"a cone of {_SEGMENTS} sides")


def _plane(prim: Usd.Prim, at: _Placing) -> Shape:
    axis = prim.GetAttribute("axis").Get() or "Z"
    return Shape("plane", (0.0, 0.0, 1.0), at.frame(Z_TO_AXIS[axis]))


def _mesh(prim: Usd.Prim, at: _Placing) -> Shape | None:
    mesh = UsdGeom.Mesh(prim)
    points = np.asarray(mesh.GetPointsAttr().Get() or [], dtype=float).reshape(-1, 3)
    counts = np.asarray(mesh.GetFaceVertexCountsAttr().Get() or [], dtype=int)
    indices = np.asarray(mesh.GetFaceVertexIndicesAttr().Get() or [], dtype=int)
    if len(points) < 3 or counts.sum() != len(indices) or (len(indices) and indices.max() >= len(points)):
        return None
    faces = triangles(counts, indices)
    if len(points) == 3:  # MuJoCo wants four points
        points = np.vstack([points, points.mean(axis=0)])
    vertices = points @ at.stretch.T
    if len(faces) and _area(vertices, faces) < SMALLEST_AREA:
        return None
    flipped = (mesh.GetOrientationAttr().Get() == "leftHanded") != (np.linalg.det(at.stretch) < 0)
    return Shape("mesh", (), at.frame(), vertices, faces[:, ::-1] if flipped else faces)


def _area(vertices: Array, faces: NDArray[np.int64]) -> float:
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum()) / 2


def triangles(counts: NDArray[np.int64], indices: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return triangles (k, 3): each polygon as a fan around its first corner."""
    starts = np.concatenate([[0], np.cumsum(counts)[:-1]]) if len(counts) else np.zeros(0, dtype=int)
    out = []
    for corner in range(1, int(counts.max(initial=2)) - 1):
        first = starts[counts > corner + 1]
        out.append(np.stack([indices[first], indices[first + corner], indices[first + corner + 1]], axis=1))
    return np.concatenate(out) if out else np.zeros((0, 3), dtype=int)


def _hull(points: Array, at: _Placing, note: str) -> Shape:
    return Shape("mesh", (), at.frame(), points @ at.stretch.T, None, f"{note}: a mesh")


_MAKERS: dict[str, Maker] = {
    "Cube": _cube,
    "Sphere": _sphere,
    "Capsule": _round("capsule"),
    "Cylinder": _round("cylinder"),
    "Cone": _cone,
    "Plane": _plane,
    "Mesh": _mesh,
}


def bounding_box(shape: Shape) -> Shape:
    """Return the box around a mesh, along the mesh's axes."""
    assert shape.vertices is not None
    low, high = shape.vertices.min(axis=0), shape.vertices.max(axis=0)
    frame = shape.frame @ Frame(np.eye(3), (low + high) / 2)
    return Shape("box", _clean(*((high - low) / 2)), frame, note="box around the mesh")


def bounding_sphere(shape: Shape) -> Shape:
    """Return the sphere around a mesh, about the middle of its box."""
    assert shape.vertices is not None
    middle = (shape.vertices.min(axis=0) + shape.vertices.max(axis=0)) / 2
    radius = float(np.linalg.norm(shape.vertices - middle, axis=1).max())
    return Shape("sphere", _clean(radius), shape.frame @ Frame(np.eye(3), middle), note="sphere around the mesh")


def flat_to_box(shape: Shape, thickness: float = 1e-3) -> Shape:
    """Return a thin box for a mesh whose points lie in one plane, else the shape itself."""
    assert shape.vertices is not None
    middle = shape.vertices.mean(axis=0)
    _, spread, axes = np.linalg.svd(shape.vertices - middle, full_matrices=False)
    if spread[-1] > 1e-6 * max(spread[0], 1e-12):
        return shape
    axes = axes if np.linalg.det(axes) > 0 else -axes
    local = (shape.vertices - middle) @ axes.T
    low, high = local.min(axis=0), local.max(axis=0)
    half = (high - low) / 2
    half[2] = thickness / 2
    center = (low + high) / 2
    frame = shape.frame @ Frame(axes.T, middle + axes.T @ center)
    return Shape("box", _clean(*half), frame, note="flat: a thin box")
