"""A scene to draw, as plain arrays: shapes, moving bodies, the ground, and the camera's place.

The camera always sees the same side of the robot, near enough to fill the picture.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
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


@dataclass(frozen=True)
class Ground:
    """The checkered plane: its height and the edge of a tile, m."""

    height: float
    tile: float


@dataclass(frozen=True)
class Scene:
    """What is drawn.

    Attributes:
        bodies: the shapes of each moving body, by name.
        fixed: shapes that never move.
        ground: the plane, or None.
        root: which body the eye follows.
        size: about how tall the robot stands, m.
    """

    bodies: Mapping[str, Sequence[Shape]]
    fixed: Sequence[Shape]
    ground: Ground | None
    root: int
    size: float


def points(scene: Scene, pos: Array, quat: Array) -> Array:
    """Return points (n, 3), m, between which the robot lies when its bodies are at (B, 3), (B, 4)."""
    found = [
        rotated(quat[b], np.concatenate([shape.corners() for shape in shapes])) + pos[b]
        for b, shapes in enumerate(scene.bodies.values())
        if shapes
    ]
    return np.concatenate(found)


AZIMUTH, ELEVATION = 142.0, -14.0  # degrees, as MuJoCo's camera has them
_FOV = np.radians(30.0)  # upright; render_model.FOV
_FILLED = 0.64  # of the picture's height and width: the rest is for arrows and captions


def camera_distance(cloud: Array, aspect: float) -> float:
    """Return the distance at which a cloud of points about the origin fills its part of the picture."""
    right, up, back = camera_axes()
    tall = _FILLED * np.tan(_FOV / 2)
    wide = tall * aspect
    return float(np.max(cloud @ back + np.maximum(np.abs(cloud @ right) / wide, np.abs(cloud @ up) / tall)))


def camera_axes() -> tuple[Array, Array, Array]:
    """Return the camera's axes in the world: right, up, and back (towards the viewer)."""
    a, e = np.radians(AZIMUTH), np.radians(ELEVATION)
    forward = np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    return right, np.cross(right, forward), -forward
