"""The shapes of a body, as plain arrays."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

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


def moved(shape: Shape, offset: Any) -> Shape:
    """Return a shape at a place that is ``offset`` (3,), m, away."""
    return replace(shape, pos=tuple((np.asarray(shape.pos) + np.asarray(offset)).tolist()))
