"""Rotations, rigid frames, the polar decomposition of an affine map, and rounding. Arrays hold column vectors."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from wheelleg_exp.asset.robot_description import Pose, Quat, Vec3

Array = NDArray[np.float64]


def single(value: float) -> float:
    """Return the shortest decimal that is the same number in single precision.

    USD stores most physics in single precision. 0.0425 read back as 0.04249999970197678 becomes 0.0425 again;
    the change is below the precision of the source.
    """
    return float(str(np.float32(value))) if math.isfinite(value) and abs(value) < 3.4e38 else float(value)


SHORT_DIGITS = 5  # a decimal this short, within single precision, is what was meant and not an accident
NOTHING = 1e-8  # m; less is the noise of single precision at the size of a link
NOISE = 1e-14  # relative error of a few operations in double precision


def rounded(value: float, scale: float | None = None) -> float:
    """Return the short decimal that was meant, where there is one; else the number itself.

    -28.64789 degrees are -0.5000000058 rad; what was meant is -0.5. Nothing changes by more than the single
    precision in which USD stores most physics, and what is no short decimal stays as it is.

    Args:
        value: the number.
        scale: size that the precision is relative to, such as a vector's length; by default the number's own.
    """
    size = abs(value) if scale is None else scale
    if abs(value) <= size * 2.0**-23:
        return 0.0
    for digits in range(1, 16):
        short = float(f"{value:.{digits}g}")
        if abs(short - value) <= size * (2.0**-23 if digits <= SHORT_DIGITS else NOISE):
            return short
    return value


def plain_float(value: float) -> float:
    """Return a number without the noise of the few operations that made it: -0.29624999999999996 is -0.29625."""
    return float(f"{value:.15g}")


def vec3(values: Array) -> Vec3:
    """Return three plain floats in m, without the noise below single precision of the largest and below 10 nm."""
    scale = float(np.abs(values).max())
    if scale < NOTHING:
        return 0.0, 0.0, 0.0
    x, y, z = (rounded(float(v), scale) for v in values)
    return x, y, z


def rotation_matrix(quat: Quat) -> Array:
    """Return the 3x3 matrix of a quaternion (w, x, y, z), which need not be of unit length."""
    q = np.asarray(quat, dtype=float)
    w, x, y, z = q / np.linalg.norm(q)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def quaternion(matrix: Array) -> Quat:
    """Return the quaternion (w, x, y, z) of a rotation matrix, w not negative (Shepperd's method)."""
    m = matrix
    diagonal = [np.trace(m), m[0, 0], m[1, 1], m[2, 2]]
    largest = int(np.argmax(diagonal))
    if largest == 0:
        q = np.array([1 + diagonal[0], m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]])
    else:
        i = largest - 1
        j, k = (i + 1) % 3, (i + 2) % 3
        q = np.zeros(4)
        q[0] = m[k, j] - m[j, k]
        q[1 + i] = 1 + m[i, i] - m[j, j] - m[k, k]
        q[1 + j] = m[j, i] + m[i, j]
        q[1 + k] = m[k, i] + m[i, k]
    q = q / np.linalg.norm(q)
    w, x, y, z = (round(float(v), 12) + 0.0 for v in (q if q[0] >= 0 else -q))
    return w, x, y, z


@dataclass(frozen=True, eq=False)
class Frame:
    """A rigid transform: ``rotation`` (3, 3), then ``translation`` (3,)."""

    rotation: Array
    translation: Array

    @staticmethod
    def identity() -> Frame:
        """Return the frame that changes nothing."""
        return Frame(np.eye(3), np.zeros(3))

    @staticmethod
    def of(pose: Pose) -> Frame:
        """Return the frame of a pose."""
        return Frame(rotation_matrix(pose.rotation), np.array(pose.position))

    def __matmul__(self, other: Frame) -> Frame:
        """Return ``other`` seen through this frame."""
        return Frame(self.rotation @ other.rotation, self.rotation @ other.translation + self.translation)

    def inverse(self) -> Frame:
        """Return the frame that undoes this one."""
        return Frame(self.rotation.T, -self.rotation.T @ self.translation)

    def pose(self) -> Pose:
        """Return plain numbers, rounded to single precision."""
        w, x, y, z = (rounded(v, 1.0) for v in quaternion(self.rotation))
        return Pose(vec3(self.translation), (w, x, y, z))

    def matrix(self) -> Array:
        """Return the 4x4 matrix."""
        out = np.eye(4)
        out[:3, :3], out[:3, 3] = self.rotation, self.translation
        return out

    def distance(self, other: Frame) -> tuple[float, float]:
        """Return how far two frames are apart: m and rad."""
        chord = float(np.linalg.norm(self.rotation - other.rotation)) / math.sqrt(8)
        return float(np.linalg.norm(self.translation - other.translation)), 2 * math.asin(min(1.0, chord))


def split_scale(linear: Array) -> tuple[Array, Array]:
    """Split a 3x3 map into rotation and stretch, ``linear = rotation @ stretch`` (polar decomposition).

    A mirrored map keeps a proper rotation; its stretch is then negative (the map times -1).
    """
    u, values, vt = np.linalg.svd(linear)
    rotation = u @ vt
    stretch = vt.T @ np.diag(values) @ vt
    if np.linalg.det(rotation) < 0:
        return -rotation, -stretch
    return rotation, stretch


def rigid_part(matrix: Array) -> Frame:
    """Return a 4x4 map's frame, without scale, shear and mirroring."""
    return Frame(split_scale(matrix[:3, :3])[0], matrix[:3, 3].copy())


def apply(matrix: Array, points: Array) -> Array:
    """Map points (n, 3) by a 4x4 matrix."""
    return np.asarray(points @ matrix[:3, :3].T + matrix[:3, 3])


Z_TO_AXIS = {  # rotations that carry z onto the axis of a capsule, cylinder, cone or plane
    "X": rotation_matrix((math.sqrt(0.5), 0.0, math.sqrt(0.5), 0.0)),
    "Y": rotation_matrix((math.sqrt(0.5), -math.sqrt(0.5), 0.0, 0.0)),
    "Z": np.eye(3),
}
