"""A scene to draw, as plain arrays: shapes, moving bodies, the ground, and a camera that follows the robot."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

FAR = 1e6  # Objects with coordinates above 1e6 m are not drawn.


@dataclass(frozen=True)
class Shape:
    """One shape in the frame of its body: box, ellipsoid, cylinder, capsule, or mesh."""

    kind: str
    # ``size``, m: half edges of a box, semi-axes of an ellipsoid, radius and half length of a cylinder or capsule
    size: tuple[float, ...]
    pos: tuple[float, ...]
    quat: tuple[float, ...]  # wxyz
    rgba: tuple[float, ...]  # 0 to 1
    vertices: NDArray[np.float64] | None = None  # Row i of ``vertices``, (n, 3), is the position of vertex i, m.
    faces: NDArray[np.int64] | None = None  # Row i of ``faces``, (m, 3), lists the three vertices of triangle i.
    normals: NDArray[np.float64] | None = None  # (n, 3)

    def corners(self) -> Array:
        """Return the corners of the shape's bounding box in the body's frame, (n, 3), m."""
        if self.vertices is not None:
            low, high = self.vertices.min(axis=0), self.vertices.max(axis=0)
        else:
            tall = self.size[1] if self.kind == "cylinder" else sum(self.size)
            half = np.asarray(self.size if len(self.size) == 3 else (self.size[0], self.size[0], tall))
            low, high = -half, half
        signs = np.array(np.meshgrid([0, 1], [0, 1], [0, 1])).reshape(3, 8).T
        corners: Array = rotated(self.quat, np.where(signs == 1, high, low)) + np.asarray(self.pos)
        return corners


def rotated(quat: Sequence[float] | Array, vectors: Array) -> Array:
    """Return the vectors (..., 3), rotated by a unit quaternion, wxyz."""
    w, axis = quat[0], np.asarray(quat[1:])
    cross = np.cross(axis, vectors)
    return np.asarray(vectors + 2 * (w * cross + np.cross(axis, cross)))


def moved(shape: Shape, offset: ArrayLike) -> Shape:
    """Return a copy of ``shape``, moved by ``offset`` (3,), m."""
    return replace(shape, pos=tuple((np.asarray(shape.pos) + np.asarray(offset)).tolist()))


@dataclass(frozen=True)
class Ground:
    """The checkered plane: its height and the edge of a tile, m."""

    height: float
    tile: float


@dataclass(frozen=True)
class Scene:
    """A scene to draw: the shapes of each moving body by name, the ``fixed`` shapes, and the ground, if any."""

    bodies: Mapping[str, Sequence[Shape]]
    fixed: Sequence[Shape]
    ground: Ground | None
    root: int  # The camera follows the body with the index ``root``.
    size: float  # ``size`` is the robot's approximate height, m.


def points(scene: Scene, pos: Array, quat: Array) -> Array:
    """Return corners (n, 3), m, of boxes around shapes at body positions (B, 3), m, and orientations (B, 4), wxyz."""
    corners = {b: [shape.corners() for shape in shapes] for b, shapes in enumerate(scene.bodies.values()) if shapes}
    return np.concatenate([rotated(quat[b], np.concatenate(found)) + pos[b] for b, found in corners.items()])


AZIMUTH, ELEVATION = 142.0, -14.0  # The camera's azimuth and elevation are in degrees, as MuJoCo defines them.
FOV = 30.0  # A small vertical field of view, in degrees, avoids perspective distortion of the robot.
_FILLED = 0.64  # The robot fills 64 % of the picture's height or width.


def camera_distance(cloud: Array, aspect: float) -> float:
    """Return the camera distance, m, at which the points ``cloud`` fill 64 % of the picture's height or width."""
    right, up, back = camera_axes()
    tall = _FILLED * np.tan(np.radians(FOV) / 2)
    return float(np.max(cloud @ back + np.maximum(np.abs(cloud @ right) / (tall * aspect), np.abs(cloud @ up) / tall)))


def camera_axes() -> tuple[Array, Array, Array]:
    """Return the camera's axes in the world: right, up, and back (towards the viewer)."""
    a, e = np.radians(AZIMUTH), np.radians(ELEVATION)
    forward = np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    return right, np.cross(right, forward), -forward
