"""Shapes of a recording, as plain arrays."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from wheelleg_exp.rendering.shapes import FAR, Shape, rotated

_GREY = (0.6, 0.62, 0.65, 1.0)
_IDENTITY = (1.0, 0.0, 0.0, 0.0)


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
