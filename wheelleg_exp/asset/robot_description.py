"""A robot as plain data: bodies, joints, shapes, and drives in SI units and radians, z up; and unique names for them.

Quaternions are (w, x, y, z). This module does not know USD: a reader makes the description and the MJCF writer prints
it. Each mapping ``extra`` contains MJCF attributes that the MJCF writer prints unchanged.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from typing import Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

Vec3 = tuple[float, float, float]
Quat = tuple[float, float, float, float]
Rgba = tuple[float, float, float, float]
ShapeKind = Literal["box", "sphere", "capsule", "cylinder", "ellipsoid", "plane", "mesh"]
DofKind = Literal["hinge", "slide", "ball"]
DriveKind = Literal["position", "velocity", "motor"]
BaseMode = Literal["auto", "floating", "fixed"]
Extra = dict[str, str | int | float | bool | tuple[float, ...]]


@dataclass(frozen=True)
class Pose:
    """Position (m) and rotation of one frame in another frame."""

    position: Vec3 = (0.0, 0.0, 0.0)
    rotation: Quat = (1.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Inertial:
    """A body's mass (kg), centre of mass (m, body frame), principal moments (kg m²), and principal axes' rotation."""

    mass: float
    center_of_mass: Vec3
    moments: Vec3
    axes: Quat


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles: vertices (n, 3) in m and faces (k, 3) of indices; ``solid`` is true for colliders."""

    name: str
    vertices: NDArray[np.float64]
    faces: NDArray[np.int64]
    solid: bool
    extra: Extra = field(default_factory=dict)


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

    ``size`` depends on the kind, in m: box half extents; sphere radius; capsule and cylinder radius and half length
    along z; ellipsoid half axes; nothing for plane and mesh.
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
    extra: Extra = field(default_factory=dict)


@dataclass(frozen=True)
class Drive:
    """A motor on one degree of freedom.

    Of a hinge (slide): ``stiffness`` N·m/rad (N/m), ``damping`` N·m·s/rad (N·s/m), ``target_position`` rad (m), largest
    torque ``effort`` N·m (N), None if unlimited. With ``acceleration``, gains are multiplied by the joint's inertia.
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
    """A MuJoCo joint (hinge, slide, or ball) between a body and its parent body.

    Axis and anchor (m) are in the body's frame. ``range``, rad (m), is None if unlimited. ``position`` and ``velocity``
    are for the keyframe ``home``; ``ref`` is the position in ``Body.pose``. ``force_range``, N·m (N), limits the sum of
    the motors' torques. ``max_velocity``, rad/s (m/s), is for controllers, because MuJoCo does not limit velocities.
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
    extra: Extra = field(default_factory=dict)

    @property
    def effort(self) -> float | None:
        """The largest effort of the joint's motors, in N·m or N; None means unlimited."""
        limits = [] if self.force_range is None else [max(map(abs, self.force_range))]
        limits += [] if self.drive is None or self.drive.effort is None else [self.drive.effort]
        return min(limits, default=None)


@dataclass(frozen=True)
class Actuator:
    """A MuJoCo actuator: its target, the attribute ``transmission`` that names it, and attributes of ``general``."""

    name: str
    path: str
    transmission: Literal["joint", "jointinparent", "tendon", "site", "body", "cranksite"]
    target: str
    extra: Extra = field(default_factory=dict)


@dataclass(frozen=True)
class TendonPoint:
    """A point of a spatial tendon: a site, a geom (``side`` is MJCF's ``sidesite``), or a pulley that divides it."""

    kind: Literal["site", "geom", "pulley"]
    name: str = ""
    side: str | None = None
    divisor: float = 1.0


@dataclass(frozen=True)
class Tendon:
    """A length, limited to ``range``: of a path through ``points`` in m, or a weighted sum of joint coordinates."""

    name: str
    path: str
    points: tuple[TendonPoint, ...] = ()
    joints: tuple[tuple[str, float], ...] = ()
    range: tuple[float, float] | None = None
    extra: Extra = field(default_factory=dict)


@dataclass(frozen=True)
class Coupling:
    """A joint whose coordinate follows another's: q = c0 + c1·r + c2·r² + c3·r³ + c4·r⁴."""

    name: str
    path: str
    joint: str
    reference: str
    coefficients: tuple[float, float, float, float, float]
    extra: Extra = field(default_factory=dict)


@dataclass(frozen=True)
class Site:
    """A named frame on a body; ``extra`` contains the shape, size, and colour of the frame's marker."""

    name: str
    path: str
    pose: Pose
    extra: Extra = field(default_factory=dict)


@dataclass(frozen=True)
class Body:
    """A rigid body; ``pose`` is in its parent (None: the world) when its joints are at their ``ref``.

    ``velocity`` is the saved velocity of a floating body: m/s in the world, then rad/s about its own axes.
    """

    name: str
    path: str
    parent: str | None
    pose: Pose
    inertial: Inertial
    floating: bool = False
    mocap: bool = False
    weightless: bool = False
    velocity: tuple[float, float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    dofs: tuple[Dof, ...] = ()
    geoms: tuple[Geom, ...] = ()
    sites: tuple[Site, ...] = ()
    extra: Extra = field(default_factory=dict)


@dataclass(frozen=True)
class Closure:
    """A joint that closes a loop: points on both bodies (None: the world) coincide, or frames are welded.

    For a hinge that closes a loop, ``anchors`` contains two pairs of points on the hinge's axis.
    """

    name: str
    path: str
    kind: Literal["connect", "weld"]
    bodies: tuple[str | None, str | None]
    anchors: tuple[tuple[Pose, Pose], ...]
    extra: Extra = field(default_factory=dict)


@dataclass(frozen=True)
class Keyframe:
    """A saved state: arrays such as ``qpos``, ``qvel``, and ``ctrl``, in the order of the MuJoCo model."""

    name: str
    path: str
    extra: Extra


Part = Body | Dof | Geom | Closure | Coupling | Tendon | Actuator | Keyframe


@dataclass(frozen=True)
class RobotDescription:
    """Everything that a simulator needs to know about a robot. ``bodies`` lists each parent body before its children.

    ``static_geoms`` and ``static_sites`` are in the world. ``option``, ``flag``, and ``compiler`` are MJCF attributes.
    """

    name: str
    bodies: tuple[Body, ...]
    gravity: Vec3 = (0.0, 0.0, -9.81)
    static_geoms: tuple[Geom, ...] = ()
    static_sites: tuple[Site, ...] = ()
    exclusions: tuple[tuple[str, str], ...] = ()
    closures: tuple[Closure, ...] = ()
    couplings: tuple[Coupling, ...] = ()
    tendons: tuple[Tendon, ...] = ()
    actuators: tuple[Actuator, ...] = ()
    keyframes: tuple[Keyframe, ...] = ()
    materials: tuple[Material, ...] = ()
    meshes: tuple[Mesh, ...] = ()
    self_collision: bool = True
    breadth_first_dofs: tuple[str, ...] = ()
    option: Extra = field(default_factory=dict)
    flag: Extra = field(default_factory=dict)
    compiler: Extra = field(default_factory=dict)

    @property
    def mass(self) -> float:
        """Total mass in kg."""
        return sum(body.inertial.mass for body in self.bodies)

    @property
    def dofs(self) -> tuple[Dof, ...]:
        """All degrees of freedom except those of floating bases, in the order of the bodies (depth first)."""
        return tuple(dof for body in self.bodies for dof in body.dofs)

    @property
    def driven(self) -> tuple[str, ...]:
        """Names of the degrees of freedom with a motor; empty for a URDF, which has no motors.

        A drive without gains is a motor only if no drive has gains: some files leave the gains to the task.
        """
        drives = {dof.name: dof.drive for dof in self.dofs if dof.drive is not None and dof.drive.effort != 0}
        return tuple(name for name, drive in drives.items() if drive.stiffness or drive.damping) or tuple(drives)

    @property
    def geoms(self) -> tuple[Geom, ...]:
        """The shapes of the world body and of all other bodies."""
        return (*self.static_geoms, *(geom for body in self.bodies for geom in body.geoms))

    @property
    def sites(self) -> tuple[Site, ...]:
        """The sites of the world body and of all other bodies."""
        return (*self.static_sites, *(site for body in self.bodies for site in body.sites))

    @property
    def colliders(self) -> tuple[Geom, ...]:
        """The colliding shapes of all bodies except the world body."""
        return tuple(geom for body in self.bodies for geom in body.geoms if geom.collides)

    def children(self, parent: str | None) -> Iterator[Body]:
        """Yield the bodies below a parent body (None: the world)."""
        return (body for body in self.bodies if body.parent == parent)


Item = TypeVar("Item")


def depth_first(
    items: Iterable[Item], name: Callable[[Item], str], parent: Callable[[Item], str | None]
) -> tuple[Item, ...]:
    """Return the bodies of a tree in depth-first order, like MuJoCo: each parent body before its children."""
    children: dict[str | None, list[Item]] = {}
    for item in items:
        children.setdefault(parent(item), []).append(item)
    ordered: list[Item] = []
    stack = children.get(None, [])[::-1]
    while stack:
        ordered.append(stack.pop())
        stack += children.get(name(ordered[-1]), [])[::-1]
    return tuple(ordered)


RESERVED = frozenset({"world"})  # MuJoCo's root body
DEEPEST = 8  # parts of a path


def unique_names(paths: Iterable[str], shown: dict[str, str] | None = None) -> dict[str, str]:
    """Return short unique names by path: the fewest last parts, joined by ``_``; ``shown`` maps to display names."""
    shown = shown or {}
    parts = {path: path.strip("/").rsplit("/", DEEPEST)[-DEEPEST:] for path in paths}
    names = {path: shown.get(path, own[-1]) for path, own in parts.items()}
    # As long as several USD prims share a name, prepend the names of their parents, level by level.
    for depth in range(2, DEEPEST + 1):
        count = Counter(names.values())
        clashing = [path for path, name in names.items() if count[name] > 1 or name in RESERVED]
        growable = [path for path in clashing if depth <= len(parts[path])]
        if not growable:
            break
        for path in growable:
            own = parts[path]
            names[path] = "_".join([*own[-depth:-1], shown.get(path, own[-1])])
    counter = Numbered(RESERVED)
    return {path: counter.take(name) for path, name in names.items()}


class Numbered:
    """A set of names in use; ``take`` appends a number to a repeated name."""

    def __init__(self, taken: Iterable[str] = ()) -> None:
        self._taken = set(taken)
        self._next: dict[str, int] = {}

    def take(self, name: str) -> str:
        """Reserve and return ``name`` or, if ``name`` is in use, the first unused one of ``name_2``, ``name_3``."""
        candidate, number = name, self._next.get(name, 2)
        while candidate in self._taken:
            candidate, number = f"{name}_{number}", number + 1
        self._next[name] = number
        self._taken.add(candidate)
        return candidate
