"""A robot as plain data: bodies, joints, shapes and drives in SI units and radians, z up.

Quaternions are (w, x, y, z). Nothing here knows USD or MuJoCo; the reader makes it and the writer prints it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Vec3 = tuple[float, float, float]
Quat = tuple[float, float, float, float]
Rgba = tuple[float, float, float, float]
ShapeKind = Literal["box", "sphere", "capsule", "cylinder", "ellipsoid", "plane", "mesh"]
DofKind = Literal["hinge", "slide", "ball"]
DriveKind = Literal["position", "velocity", "motor"]
BaseMode = Literal["auto", "floating", "fixed"]


@dataclass(frozen=True)
class Pose:
    """Position (m) and rotation of one frame in another."""

    position: Vec3 = (0.0, 0.0, 0.0)
    rotation: Quat = (1.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Inertial:
    """Mass (kg), centre of mass (m, body frame), principal moments (kg m²) and the rotation of their axes."""

    mass: float
    center_of_mass: Vec3
    moments: Vec3
    axes: Quat


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles: vertices (n, 3) in m and faces (k, 3) of indices; ``solid`` when it is for collisions."""

    name: str
    vertices: NDArray[np.float64]
    faces: NDArray[np.int64]
    solid: bool


@dataclass(frozen=True)
class Material:
    """A surface colour, with metallic and roughness in 0..1."""

    name: str
    rgba: Rgba
    metallic: float | None = None
    roughness: float | None = None


@dataclass(frozen=True)
class Geom:
    """One shape of a body.

    ``size`` is what the kind needs, in m: box half extents; sphere radius; capsule and cylinder radius and
    half length along z; ellipsoid half axes; plane and mesh nothing.
    """

    name: str
    path: str
    kind: ShapeKind
    size: tuple[float, ...]
    pose: Pose
    collides: bool
    drawn: bool
    mesh: str | None = None
    material: str | None = None
    rgba: Rgba | None = None
    friction: float | None = None


@dataclass(frozen=True)
class Drive:
    """A motor on one degree of freedom.

    ``stiffness`` in N·m/rad (N/m), ``damping`` in N·m·s/rad (N·s/m), ``effort`` in N·m (N) or None without a
    limit; targets in rad (m). With ``acceleration`` the gains multiply the joint's effective inertia.
    """

    kind: DriveKind
    stiffness: float
    damping: float
    effort: float | None
    target_position: float = 0.0
    target_velocity: float = 0.0
    acceleration: bool = False


@dataclass(frozen=True)
class Dof:
    """One degree of freedom (three for a ball) of a body in its parent, about ``axis`` through ``anchor``.

    Axis and anchor (m) are in the body's frame. ``range`` in rad (m) or None; ``position`` and ``velocity``
    are the saved state; ``ref`` is the coordinate at which the body stands in its ``pose``. ``force_range`` in
    N·m (N) limits the sum of all motors. ``max_velocity`` in rad/s (m/s) is kept for whoever drives the joint,
    because MuJoCo has no such limit.
    """

    name: str
    path: str
    kind: DofKind
    axis: Vec3
    anchor: Vec3
    range: tuple[float, float] | None = None
    armature: float = 0.0
    damping: float = 0.0
    stiffness: float = 0.0
    frictionloss: float = 0.0
    max_velocity: float | None = None
    force_range: tuple[float, float] | None = None
    drive: Drive | None = None
    position: float = 0.0
    velocity: float = 0.0
    ref: float = 0.0


@dataclass(frozen=True)
class Actuator:
    """A MuJoCo actuator on a joint, as its authors wrote it: parameters, gear and ranges of ``general``."""

    name: str
    path: str
    joint: str
    gain: tuple[float, ...]
    bias: tuple[float, ...]
    bias_type: str = "none"
    gear: tuple[float, ...] = (1.0,)
    control_range: tuple[float, float] | None = None
    force_range: tuple[float, float] | None = None
    inherit_range: float = 0.0


@dataclass(frozen=True)
class Coupling:
    """A joint whose coordinate follows another's: q = c0 + c1·r + c2·r² + c3·r³ + c4·r⁴."""

    name: str
    path: str
    joint: str
    reference: str
    coefficients: tuple[float, float, float, float, float]


@dataclass(frozen=True)
class Site:
    """A named frame on a body."""

    name: str
    path: str
    pose: Pose


@dataclass(frozen=True)
class Body:
    """A rigid body; ``pose`` is in its parent (None: the world) where its joints are at their ``ref``."""

    name: str
    path: str
    parent: str | None
    pose: Pose
    inertial: Inertial
    floating: bool = False
    mocap: bool = False
    weightless: bool = False
    dofs: tuple[Dof, ...] = ()
    geoms: tuple[Geom, ...] = ()
    sites: tuple[Site, ...] = ()


@dataclass(frozen=True)
class Closure:
    """A joint that closes a loop: points on both bodies (None: the world) coincide, or frames are welded.

    A hinge has two pairs, on its axis.
    """

    name: str
    path: str
    kind: Literal["connect", "weld"]
    bodies: tuple[str | None, str | None]
    anchors: tuple[tuple[Pose, Pose], ...]


@dataclass(frozen=True)
class RobotDescription:
    """Everything that a simulator needs to know of the file. Parents stand before their children."""

    name: str
    bodies: tuple[Body, ...]
    gravity: Vec3 = (0.0, 0.0, -9.81)
    static_geoms: tuple[Geom, ...] = ()
    exclusions: tuple[tuple[str, str], ...] = ()
    closures: tuple[Closure, ...] = ()
    couplings: tuple[Coupling, ...] = ()
    actuators: tuple[Actuator, ...] = ()
    materials: tuple[Material, ...] = ()
    meshes: tuple[Mesh, ...] = ()
    self_collision: bool = True
    breadth_first_dofs: tuple[str, ...] = ()

    @property
    def mass(self) -> float:
        """Total mass in kg."""
        return sum(body.inertial.mass for body in self.bodies)

    @property
    def dofs(self) -> tuple[Dof, ...]:
        """All degrees of freedom but those of floating bases, in the order of the bodies (depth first)."""
        return tuple(dof for body in self.bodies for dof in body.dofs)

    @property
    def colliders(self) -> tuple[Geom, ...]:
        """All shapes of bodies that collide."""
        return tuple(geom for body in self.bodies for geom in body.geoms if geom.collides)

    def children(self, parent: str | None) -> Iterator[Body]:
        """Yield the bodies whose parent is ``parent`` (None: the world)."""
        return (body for body in self.bodies if body.parent == parent)
