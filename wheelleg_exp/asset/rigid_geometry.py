"""Rotations, rigid frames, rounded numbers, and volume, centre, and inertia of solids and of compound bodies."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from wheelleg_exp.asset.robot_description import Pose, Quat, Vec3

Array = NDArray[np.float64]


def single(value: float) -> float:
    """Return the shortest decimal equal to ``value`` in single precision, as 0.0425 for 0.04249999970197678."""
    return float(str(np.float32(value))) if math.isfinite(value) and abs(value) < 3.4e38 else float(value)


SHORT_DIGITS = 5  # digits
NOTHING = 1e-8  # m
NOISE = 1e-14  # relative error


def rounded(value: float, scale: float | None = None) -> float:
    """Return a short decimal within single precision's rounding error of ``value`` (relative to ``scale``), if any."""
    size = abs(value) if scale is None else scale
    if abs(value) <= size * 2.0**-23:
        return 0.0
    for digits in range(1, 16):
        short = float(f"{value:.{digits}g}")
        if abs(short - value) <= size * (2.0**-23 if digits <= SHORT_DIGITS else NOISE):
            return short
    return value


def plain_float(value: float) -> float:
    """Return a number without the rounding error of a few operations: -0.29624999999999996 becomes -0.29625."""
    return float(f"{value:.15g}")


def vec3(values: Array) -> Vec3:
    """Return a vector (3,) in m as floats, without single-precision rounding errors and without values below 10 nm."""
    scale = float(np.abs(values).max())
    if scale < NOTHING:
        return 0.0, 0.0, 0.0
    x, y, z = (rounded(float(v), scale) for v in values)
    return x, y, z


def rotation_matrix(quat: ArrayLike) -> Array:
    """Return the 3x3 rotation matrix of a quaternion (w, x, y, z), which may have any length."""
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
    # Shepperd's method first finds the quaternion's largest component, because division by it has the smallest error.
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
    """A rigid transform that rotates by ``rotation`` (3, 3), then moves by ``translation`` (3,) in m."""

    rotation: Array
    translation: Array

    @staticmethod
    def identity() -> Frame:
        return Frame(np.eye(3), np.zeros(3))

    @staticmethod
    def of(pose: Pose) -> Frame:
        """Return the rigid frame with the position and rotation of a pose."""
        return Frame(rotation_matrix(pose.rotation), np.array(pose.position))

    def __matmul__(self, other: Frame) -> Frame:
        return Frame(self.rotation @ other.rotation, self.rotation @ other.translation + self.translation)

    def inverse(self) -> Frame:
        return Frame(self.rotation.T, -self.rotation.T @ self.translation)

    def pose(self) -> Pose:
        """Convert the rigid transform to a ``Pose``, with numbers rounded to single precision."""
        w, x, y, z = (rounded(v, 1.0) for v in quaternion(self.rotation))
        return Pose(vec3(self.translation), (w, x, y, z))

    def matrix(self) -> Array:
        out = np.eye(4)
        out[:3, :3], out[:3, 3] = self.rotation, self.translation
        return out

    def distance(self, other: Frame) -> tuple[float, float]:
        """Return the distance (m) and the angle (rad) between two rigid frames."""
        chord = float(np.linalg.norm(self.rotation - other.rotation)) / math.sqrt(8)
        return float(np.linalg.norm(self.translation - other.translation)), 2 * math.asin(min(1.0, chord))


def split_scale(linear: Array) -> tuple[Array, Array]:
    """Split a 3x3 matrix: ``linear = rotation @ stretch`` (polar decomposition), with det(rotation) = 1."""
    u, values, vt = np.linalg.svd(linear)
    rotation = u @ vt
    stretch = vt.T @ np.diag(values) @ vt
    return (-rotation, -stretch) if np.linalg.det(rotation) < 0 else (rotation, stretch)


def turned(axis: Array, angle: float) -> Array:
    """Return the 3x3 rotation about a unit axis (3,) by an angle in rad (Rodrigues' formula)."""
    x, y, z = axis
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.asarray(np.eye(3) + math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross)


def rigid_part(matrix: Array) -> Frame:
    """Return the rigid part of a 4x4 transform, without scale, shear, and mirroring."""
    return Frame(split_scale(matrix[:3, :3])[0], matrix[:3, 3].copy())


def apply(matrix: Array, points: Array) -> Array:
    """Transform points (n, 3) by an affine 4x4 matrix."""
    return np.asarray(points @ matrix[:3, :3].T + matrix[:3, 3])


Z_TO_AXIS = {  # rotation matrices
    "X": rotation_matrix((math.sqrt(0.5), 0.0, math.sqrt(0.5), 0.0)),
    "Y": rotation_matrix((math.sqrt(0.5), -math.sqrt(0.5), 0.0, 0.0)),
    "Z": np.eye(3),
}


WATER = 1000.0  # kg/m³, the default density
BARE_MASS, BARE_RADIUS = 1.0, 0.1  # As in PhysX, a body without mass and colliders counts as a sphere of 1 kg.
MeshVolume = Literal["convex", "exact", "legacy", "shell"]


@dataclass(frozen=True, eq=False)
class Solid:
    """A solid's volume (m³), centre (3,) in m, and inertia tensor (3, 3) about the centre in m⁵, for the density 1."""

    volume: float
    center: Array
    inertia: Array

    def seen_from(self, frame: Frame) -> Solid:
        """Return the solid transformed by ``frame``, from the solid's own coordinates to parent coordinates."""
        r = frame.rotation
        return Solid(self.volume, r @ self.center + frame.translation, r @ self.inertia @ r.T)

    def scaled(self, factor: float) -> Solid:
        """Return the solid with the density ``factor`` instead of 1."""
        return Solid(self.volume * factor, self.center, self.inertia * factor)


@dataclass(frozen=True, eq=False)
class Part:
    """A piece of a body: mass (kg), centre (3,) in m, and tensor (3, 3) about that centre in kg m².

    ``assumed`` (kg) is the share of the mass that no number of the robot file gives.
    """

    mass: float
    center: Array
    tensor: Array
    assumed: float = 0.0

    @staticmethod
    def of(solid: Solid, mass: float) -> Part:
        """Return a body part: a solid of uniform density whose mass is ``mass`` (kg)."""
        return Part(mass, solid.center, solid.inertia * (mass / solid.volume))

    def about(self, center: Array) -> Part:
        """Return a copy of the body part whose inertia tensor is about the point ``center`` (parallel-axis theorem)."""
        offset = self.center - center
        shift = self.mass * ((offset @ offset) * np.eye(3) - np.outer(offset, offset))
        return Part(self.mass, center, self.tensor + shift, self.assumed)


def combined_center(parts: Iterable[Part]) -> Array:
    """Return the centre of mass (3,) of a body that consists of ``parts``; the origin if the parts have no mass."""
    parts = list(parts)
    total = sum(part.mass for part in parts)
    if total <= 0:
        return np.zeros(3)
    return np.asarray(sum((part.mass * part.center for part in parts), np.zeros(3)) / total)


def combined_tensor(parts: Sequence[Part], mass: float, center: Array) -> Array:
    """Return the inertia tensor (3, 3) of a body's parts about ``center``, scaled to ``mass`` (kg), in kg m²."""
    total = sum(part.mass for part in parts)
    tensor = sum((part.about(center).tensor for part in parts), np.zeros((3, 3)))
    return np.asarray(tensor * (mass / total))


def tensor_of(moments: ArrayLike, axes: ArrayLike) -> Array:
    """Return the inertia tensor (3, 3) with the given principal moments (3,) and principal axes (w, x, y, z)."""
    turn = rotation_matrix(axes)
    return np.asarray(turn @ np.diag(np.asarray(moments, dtype=float)) @ turn.T)


def principal(tensor: Array) -> tuple[Vec3, Quat]:
    """Return an inertia tensor's principal moments and axes (w, x, y, z), by Jacobi's method, in PhysX's order."""
    turn, left = np.eye(3), np.array(tensor, dtype=float)
    smallest = 1e-15 * np.abs(left).max()
    for _ in range(60):
        p, q = max(((1, 2), (0, 2), (0, 1)), key=lambda pair: abs(left[pair]))
        if abs(left[p, q]) <= smallest:
            break
        # Two rotation angles make the matrix element (p, q) zero; Jacobi's method uses the smaller angle.
        cot = (left[q, q] - left[p, p]) / (2 * left[p, q])
        tan = math.copysign(1.0, cot) / (abs(cot) + math.hypot(cot, 1.0))
        cos = 1 / math.hypot(tan, 1.0)
        step = np.eye(3)
        step[p, p] = step[q, q] = cos
        step[p, q], step[q, p] = tan * cos, -tan * cos
        left, turn = step.T @ left @ step, turn @ step
    x, y, z = (float(v) for v in np.diag(left))
    return (x, y, z), quaternion(turn)


def balanced(moments: Vec3) -> Vec3:
    """Return physically possible moments: each positive, and none larger than the sum of the other two.

    MuJoCo refuses impossible moments. A principal moment of inertia below 1e-9 times the largest becomes 1e-3 times the
    largest. A principal moment of inertia above the sum of the other two becomes equal to that sum.
    """
    largest = max(moments)
    values = [value if value > 1e-9 * largest else 1e-3 * largest for value in moments]
    index = int(np.argmax(values))
    others = sum(values) - values[index]
    if values[index] > others:
        values[index] = others * (1 - 1e-12)
    return values[0], values[1], values[2]


def primitive(kind: str, size: tuple[float, ...]) -> Solid:
    """Return a primitive's solid (``size`` as in MuJoCo); a cone's tip is at z = ``half``, its base at -``half``."""
    center = np.zeros(3)
    if kind in ("box", "sphere", "ellipsoid"):
        a, b, c = size if len(size) == 3 else size * 3
        volume, share = (8 * a * b * c, 3) if kind == "box" else (4 / 3 * math.pi * a * b * c, 5)
        v = volume / share
        moments = (v * (b * b + c * c), v * (a * a + c * c), v * (a * a + b * b))
        return Solid(volume, center, np.diag(moments))
    r, half = size
    if kind == "cylinder":
        volume = 2 * math.pi * r * r * half
        side, along = volume * (3 * r * r + 4 * half * half) / 12, volume * r * r / 2
    elif kind == "capsule":
        tube, ends = 2 * math.pi * r * r * half, 4 / 3 * math.pi * r**3
        volume = tube + ends
        side = tube * (half * half / 3 + r * r / 4) + ends * (2 / 5 * r * r + half * half + 3 / 4 * half * r)
        along = tube * r * r / 2 + ends * 2 / 5 * r * r
    else:
        volume, height, center[2] = 2 / 3 * math.pi * r * r * half, 2 * half, -half / 2
        side, along = volume * (3 / 20 * r * r + 3 / 80 * height * height), volume * 3 / 10 * r * r
    return Solid(volume, center, np.diag((side, side, along)))


def hollow(kind: str, size: tuple[float, ...], wall: float | None) -> Solid:
    """Return the wall of a hollow primitive, from its surface inward to the depth ``wall`` (m).

    Without ``wall``, ``Solid.volume`` is the area of the surface in m², as for MuJoCo's shells.
    """
    depth = 1e-5 * min(size)  # A central difference over this depth has a relative error of about 1e-11.
    start, end = (-depth / 2, depth / 2) if wall is None else (0.0, wall)
    outer, inner = _inset(kind, size, start), _inset(kind, size, end)
    assert outer is not None
    if inner is None:
        return outer
    parts = [Part.of(outer, outer.volume), Part.of(inner, -inner.volume)]
    volume, center = outer.volume - inner.volume, combined_center(parts)
    found = Solid(volume, center, combined_tensor(parts, volume, center))
    if wall is not None:
        return found
    if kind == "ellipsoid":  # The wall's depth is not constant, so the area is that of Thomsen's formula, as in MuJoCo.
        (a, b, c), power = size, 1.6075
        mean = ((a * b) ** power + (a * c) ** power + (b * c) ** power) / 3
        depth = volume / (4 * math.pi * mean ** (1 / power))
    return found.scaled(1 / depth)


def _inset(kind: str, size: tuple[float, ...], depth: float) -> Solid | None:
    """Return the solid whose surface is ``depth`` (m) below a primitive's surface; None if the solid is empty."""
    inside, shift = tuple(value - depth for value in size), 0.0
    if kind == "capsule":  # The half spheres have the same centres.
        inside = (size[0] - depth, size[1])
    elif kind == "cone":  # The cones are similar, and the centres of their inscribed spheres coincide.
        radius, half = size
        inscribed = 2 * half * radius / (radius + math.hypot(radius, 2 * half))
        ratio = 1 - depth / inscribed
        inside, shift = (radius * ratio, half * ratio), (1 - ratio) * (inscribed - half)
    frame = Frame(np.eye(3), np.array([0.0, 0.0, shift]))
    return primitive(kind, inside).seen_from(frame) if min(inside) > 0 else None


def mesh_solid(vertices: Array, faces: NDArray[np.int64] | None, volume: MeshVolume) -> Solid:
    """Return the solid of a mesh with points in m, from MuJoCo's compiler; ValueError if the mesh has no volume.

    ``faces`` (k, 3) are indices of points; None means the convex hull. ``volume`` is a value of the MJCF mesh attribute
    ``inertia``; with ``shell``, ``Solid.volume`` is the mesh's area in m².
    """
    import mujoco

    size = float(np.ptp(vertices, axis=0).max()) or 1.0
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    mesh = spec.add_mesh(name="mesh", uservert=(vertices / size).ravel())
    if faces is not None and len(faces):
        mesh.userface = faces.astype(np.int32).ravel()
    mesh.inertia = getattr(mujoco.mjtMeshInertia, f"mjMESH_INERTIA_{volume.upper()}")
    body = spec.worldbody.add_body()
    body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname="mesh", density=1.0)
    # MuJoCo compiles a mesh of size 1, so the results are multiplied by powers of the mesh's real ``size``.
    model = spec.compile()
    inertia = tensor_of(model.body_inertia[1], model.body_iquat[1])
    power = 2 if volume == "shell" else 3
    return Solid(float(model.body_mass[1]) * size**power, model.body_ipos[1] * size, inertia * size ** (power + 2))
