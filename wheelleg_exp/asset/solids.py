"""Volume, centre and inertia of solid shapes, and of bodies put together from them.

Closed forms; for a mesh the solid of its convex hull, or what the caller asks MuJoCo's compiler for.
Formulas: any table of moments of inertia; for the capsule, a cylinder and two half spheres moved to its ends.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Literal

import mujoco
import numpy as np
from numpy.typing import NDArray

from wheelleg_exp.asset.rigid_geometry import Array, Frame, quaternion, rotation_matrix
from wheelleg_exp.asset.robot_description import Quat, Vec3

WATER = 1000.0  # kg/m³, the density of what has none
BARE_MASS, BARE_RADIUS = 1.0, 0.1  # PhysX: a body without mass and colliders is a sphere of 1 kg
MeshVolume = Literal["convex", "exact", "legacy", "shell"]


@dataclass(frozen=True, eq=False)
class Solid:
    """Volume (m³), centre (3,) in m, and inertia (3, 3) of density 1 about that centre, in m⁵."""

    volume: float
    center: Array
    inertia: Array

    def seen_from(self, frame: Frame) -> Solid:
        """Return the solid in the coordinates that ``frame`` is given in."""
        r = frame.rotation
        return Solid(self.volume, r @ self.center + frame.translation, r @ self.inertia @ r.T)


@dataclass(frozen=True, eq=False)
class Part:
    """A piece of a body: mass (kg), centre (3,) in m, and tensor (3, 3) about that centre in kg m²."""

    mass: float
    center: Array
    tensor: Array

    @staticmethod
    def of(solid: Solid, mass: float) -> Part:
        """Return a solid of uniform density that weighs ``mass``."""
        return Part(mass, solid.center, solid.inertia * (mass / solid.volume))

    def about(self, center: Array) -> Part:
        """Return the part as if its centre were at ``center`` (parallel-axis rule)."""
        return Part(self.mass, center, self.tensor + parallel_axis(self.mass, self.center - center))


def parallel_axis(mass: float, offset: Array) -> Array:
    """Return what a tensor (3, 3) grows by when its point is moved by ``offset`` (3,) off the centre of mass."""
    return np.asarray(mass * ((offset @ offset) * np.eye(3) - np.outer(offset, offset)))


def combined_center(parts: Iterable[Part]) -> Array:
    """Return the centre of mass (3,) of parts; the origin when they weigh nothing."""
    parts = list(parts)
    total = sum(part.mass for part in parts)
    if total <= 0:
        return np.zeros(3)
    return np.asarray(sum((part.mass * part.center for part in parts), np.zeros(3)) / total)


def combined_tensor(parts: Sequence[Part], mass: float, center: Array) -> Array:
    """Return the parts' tensor (3, 3) in kg m², scaled to ``mass`` (kg), about ``center`` (3,)."""
    total = sum(part.mass for part in parts)
    tensor = sum((part.about(center).tensor for part in parts), np.zeros((3, 3)))
    return np.asarray(tensor * (mass / total))


def principal(tensor: Array) -> tuple[Vec3, Quat]:
    """Return principal moments of a tensor (3, 3) and the rotation (w, x, y, z) of their axes.

    By Jacobi's method: the largest element off the diagonal is rotated away, by at most 45°, until none is left.
    PhysX does the same, and so the order of the moments is its order.
    """
    turn, left = np.eye(3), np.array(tensor, dtype=float)
    smallest = 1e-15 * np.abs(left).max()
    for _ in range(60):
        p, q = max(((1, 2), (0, 2), (0, 1)), key=lambda pair: abs(left[pair]))
        if abs(left[p, q]) <= smallest:
            break
        step = _jacobi(left, p, q)
        left, turn = step.T @ left @ step, turn @ step
    x, y, z = (float(v) for v in np.diag(left))
    return (x, y, z), quaternion(turn)


def _jacobi(matrix: Array, p: int, q: int) -> Array:
    """Return the rotation that brings element (p, q) of a symmetric matrix to zero, by the smaller angle."""
    cot = (matrix[q, q] - matrix[p, p]) / (2 * matrix[p, q])
    tan = math.copysign(1.0, cot) / (abs(cot) + math.hypot(cot, 1.0))
    cos = 1 / math.hypot(tan, 1.0)
    out = np.eye(3)
    out[p, p] = out[q, q] = cos
    out[p, q], out[q, p] = tan * cos, -tan * cos
    return out


def balanced(moments: Vec3) -> Vec3:
    """Return moments that a body can have: each positive, and none larger than the sum of the other two.

    MuJoCo refuses others. A moment of zero, or of less than 1e-9 of the largest, becomes a thousandth of that; one
    that is too large becomes the sum of the other two.
    """
    largest = max(moments)
    values = [value if value > 1e-9 * largest else 1e-3 * largest for value in moments]
    index = int(np.argmax(values))
    others = sum(values) - values[index]
    if values[index] > others:
        values[index] = others * (1 - 1e-12)  # the sum itself would fail by rounding
    return values[0], values[1], values[2]


def cone(radius: float, half: float) -> Solid:
    """Return the solid of a cone along z, its tip at ``half`` and its base at ``-half`` (m)."""
    volume, moments = _cone(radius, half)
    return Solid(volume, np.array([0.0, 0.0, -half / 2]), np.diag(moments))


def primitive(kind: str, size: tuple[float, ...]) -> Solid:
    """Return the solid of a box, sphere, ellipsoid, capsule or cylinder (``size`` as in MuJoCo)."""
    volume, moments = _FORMS[kind](*size)
    return Solid(volume, np.zeros(3), np.diag(moments))


def _box(a: float, b: float, c: float) -> tuple[float, tuple[float, float, float]]:
    v = 8 * a * b * c
    return v, (v / 3 * (b * b + c * c), v / 3 * (a * a + c * c), v / 3 * (a * a + b * b))


def _ellipsoid(a: float, b: float, c: float) -> tuple[float, tuple[float, float, float]]:
    v = 4 / 3 * math.pi * a * b * c
    return v, (v / 5 * (b * b + c * c), v / 5 * (a * a + c * c), v / 5 * (a * a + b * b))


def _cylinder(r: float, half: float) -> tuple[float, tuple[float, float, float]]:
    v = 2 * math.pi * r * r * half
    side = v * (3 * r * r + 4 * half * half) / 12
    return v, (side, side, v * r * r / 2)


def _capsule(r: float, half: float) -> tuple[float, tuple[float, float, float]]:
    tube, ends = 2 * math.pi * r * r * half, 4 / 3 * math.pi * r**3
    side = tube * (half * half / 3 + r * r / 4) + ends * (2 / 5 * r * r + half * half + 3 / 4 * half * r)
    return tube + ends, (side, side, tube * r * r / 2 + ends * 2 / 5 * r * r)


def _cone(r: float, half: float) -> tuple[float, tuple[float, float, float]]:
    v, height = 2 / 3 * math.pi * r * r * half, 2 * half
    side = v * (3 / 20 * r * r + 3 / 80 * height * height)
    return v, (side, side, v * 3 / 10 * r * r)


_FORMS: dict[str, Callable[..., tuple[float, tuple[float, float, float]]]] = {
    "box": _box,
    "sphere": lambda r: _ellipsoid(r, r, r),
    "ellipsoid": _ellipsoid,
    "cylinder": _cylinder,
    "capsule": _capsule,
}


def mesh_solid(vertices: Array, faces: NDArray[np.int64] | None, volume: MeshVolume) -> Solid:
    """Return the solid of a mesh, by MuJoCo's compiler.

    Args:
        vertices: points (n, 3) in m.
        faces: triangles (k, 3) of indices; None for those of the convex hull.
        volume: MuJoCo's ways to take a mesh: its ``convex`` hull, ``exact`` or ``legacy`` integrals over its
            triangles, or its surface as a ``shell`` (the volume is then an area in m²).

    Raises:
        ValueError: there is no volume.
    """
    size = float(np.ptp(vertices, axis=0).max()) or 1.0  # the compiler has an absolute smallest volume
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    mesh = spec.add_mesh(name="mesh", uservert=(vertices / size).ravel())
    if faces is not None and len(faces):
        mesh.userface = faces.astype(np.int32).ravel()
    mesh.inertia = getattr(mujoco.mjtMeshInertia, f"mjMESH_INERTIA_{volume.upper()}")
    body = spec.worldbody.add_body()
    body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname="mesh", density=1.0)
    model = spec.compile()
    axes = rotation_matrix(tuple(model.body_iquat[1]))
    inertia = axes @ np.diag(model.body_inertia[1]) @ axes.T
    power = 2 if volume == "shell" else 3
    return Solid(float(model.body_mass[1]) * size**power, model.body_ipos[1] * size, inertia * size ** (power + 2))
