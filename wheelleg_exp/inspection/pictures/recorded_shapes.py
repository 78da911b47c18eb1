"""Shapes of a recording, as plain arrays."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_GREY = (0.6, 0.62, 0.65, 1.0)
_IDENTITY = (1.0, 0.0, 0.0, 0.0)
FAR = 1e6  # m, from where on nothing is drawn


@dataclass(frozen=True)
class Shape:
    """One shape in the frame of its body.

    Attributes:
        kind: box, ellipsoid, cylinder, capsule or mesh.
        size: half sizes, m; radius and half length of what is round; empty for a mesh.
        pos: centre, m.
        quat: orientation, wxyz.
        rgba: colour, 0 to 1.
        vertices: of a mesh, (n, 3), m.
        faces: of a mesh, (m, 3).
        normals: of a mesh, (n, 3), or None.
    """

    kind: str
    size: tuple[float, ...]
    pos: tuple[float, ...]
    quat: tuple[float, ...]
    rgba: tuple[float, ...]
    vertices: NDArray[np.float64] | None = None
    faces: NDArray[np.int64] | None = None
    normals: NDArray[np.float64] | None = None

    def corners(self) -> Array:
        """Return points (n, 3), m, in the body's frame, between which the shape lies."""
        if self.vertices is not None:
            low, high = self.vertices.min(axis=0), self.vertices.max(axis=0)
        else:
            half = np.asarray(self.size if len(self.size) == 3 else (self.size[0], self.size[0], sum(self.size)))
            if self.kind == "cylinder":
                half = np.asarray((self.size[0], self.size[0], self.size[1]))
            low, high = -half, half
        signs = np.array(np.meshgrid([0, 1], [0, 1], [0, 1])).reshape(3, 8).T
        return rotated(self.quat, np.where(signs == 1, high, low)) + np.asarray(self.pos)


def rotated(quat: Sequence[float] | Array, vectors: Array) -> Array:
    """Return vectors (..., 3) turned by a unit quaternion, wxyz."""
    w, axis = quat[0], np.asarray(quat[1:])
    cross = np.cross(axis, vectors)
    return np.asarray(vectors + 2 * (w * cross + np.cross(axis, cross)))


def shapes_in(statics: Mapping[str, list[Any]], archetypes: Collection[str]) -> Iterator[Shape]:
    """Yield the shapes of one entity, which may hold several of a kind; what has no size or place is left out."""
    found = _meshes(statics) if "vertex_positions" in statics else _solids(statics, archetypes)
    return filter(_is_drawable, found)


def _is_drawable(shape: Shape) -> bool:
    numbers = np.asarray([*shape.size, *shape.pos], dtype=np.float64)
    if shape.vertices is None or shape.faces is None:
        return bool((np.abs(numbers) < FAR).all())
    corners, faces = np.append(shape.vertices.ravel(), numbers), shape.faces
    return bool(faces.size and (np.abs(corners) < FAR).all() and faces.max() < len(shape.vertices))


def _solids(statics: Mapping[str, list[Any]], archetypes: Collection[str]) -> Iterator[Shape]:
    sizes = statics.get("half_sizes") or list(zip(*(statics.get(n) or [] for n in ("radii", "lengths")), strict=False))
    for i in range(len(sizes)):
        pos = tuple(_at(statics, ("centers", "translations"), i, (0.0, 0.0, 0.0)))
        quat = _wxyz(_at(statics, ("quaternions",), i, (0.0, 0.0, 0.0, 1.0)))
        rgba = rgba_of(_at(statics, ("colors",), i, None))
        if "half_sizes" in statics:  # boxes and ellipsoids differ by name alone
            kind = "ellipsoid" if "Ellipsoids3D" in archetypes else "box"
            yield Shape(kind, tuple(statics["half_sizes"][i]), pos, quat, rgba)
        else:
            yield _round(statics, i, pos, quat, rgba)


def _round(
    statics: Mapping[str, list[Any]], i: int, pos: tuple[float, ...], quat: tuple[float, ...], rgba: tuple[float, ...]
) -> Shape:
    radius, half = float(statics["radii"][i]), float(statics["lengths"][i]) / 2
    if "centers" in statics:
        return Shape("cylinder", (radius, half), pos, quat, rgba)
    # A recorded capsule begins at the centre of one cap; here it is centred.
    centre = np.asarray(pos) + rotated(quat, np.array([0.0, 0.0, half]))
    return Shape("capsule", (radius, half), tuple(centre.tolist()), quat, rgba)


def _meshes(statics: Mapping[str, list[Any]]) -> Iterator[Shape]:
    vertices = np.asarray(statics["vertex_positions"], dtype=np.float64)
    own = np.arange(len(vertices) - len(vertices) % 3)
    faces = np.asarray(statics.get("triangle_indices") or own, dtype=np.int64).reshape(-1, 3)
    normals = statics.get("vertex_normals")
    normals = normals if normals is not None and len(normals) == len(vertices) else None
    shade = rgba_of((statics.get("albedo_factor") or [None])[0])
    for i in range(max(1, len(statics.get("translations") or []))):
        yield Shape(
            "mesh",
            (),
            tuple(_at(statics, ("translations",), i, (0.0, 0.0, 0.0))),
            _wxyz(_at(statics, ("quaternions",), i, (0.0, 0.0, 0.0, 1.0))),
            shade,
            vertices,
            faces,
            None if normals is None else np.asarray(normals, dtype=np.float64),
        )


def _at(statics: Mapping[str, list[Any]], names: Sequence[str], i: int, otherwise: Any) -> Any:
    for name in names:
        if values := statics.get(name):
            return values[min(i, len(values) - 1)]
    return otherwise


def rgba_of(packed: Any) -> tuple[float, ...]:
    """Return a colour, 0 to 1, of a number 0xRRGGBBAA; grey for None."""
    if packed is None:
        return _GREY
    return tuple(((int(packed) >> shift) & 255) / 255 for shift in (24, 16, 8, 0))


def _wxyz(xyzw: Any) -> tuple[float, ...]:
    x, y, z, w = (float(v) for v in xyzw)
    return (w, x, y, z) if np.isfinite((x, y, z, w)).all() and (x, y, z, w) != (0, 0, 0, 0) else _IDENTITY


def moved(shape: Shape, offset: Any) -> Shape:
    """Return a shape at a place that is ``offset`` (3,), m, away."""
    return replace(shape, pos=tuple((np.asarray(shape.pos) + np.asarray(offset)).tolist()))
