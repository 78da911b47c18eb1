"""Volume, centre and inertia of solid shapes: closed forms, and for a mesh the solid of its convex hull.

Formulas: any table of moments of inertia; for the capsule, a cylinder and two half spheres moved to its ends.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import mujoco
import numpy as np

from wheelleg_exp.asset.geometry import Array, Frame, rotation_matrix


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


_FORMS: dict[str, Callable[..., tuple[float, tuple[float, float, float]]]] = {
    "box": _box,
    "sphere": lambda r: _ellipsoid(r, r, r),
    "ellipsoid": _ellipsoid,
    "cylinder": _cylinder,
    "capsule": _capsule,
}


def convex_hull(vertices: Array) -> Solid:
    """Return the solid of the convex hull of points (n, 3), by MuJoCo's compiler.

    Raises:
        ValueError: the points span no volume.
    """
    size = float(np.ptp(vertices, axis=0).max()) or 1.0  # the compiler has an absolute smallest volume
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    mesh = spec.add_mesh(name="hull", uservert=(vertices / size).ravel())
    mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX
    body = spec.worldbody.add_body()
    body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname="hull", density=1.0)
    model = spec.compile()
    axes = rotation_matrix(tuple(model.body_iquat[1]))
    inertia = axes @ np.diag(model.body_inertia[1]) @ axes.T
    return Solid(float(model.body_mass[1]) * size**3, model.body_ipos[1] * size, inertia * size**5)
