"""Mass properties of bodies by the rules of UsdPhysics and PhysX: authored values, else what the colliders weigh."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np
from pxr import Usd

from wheelleg_exp.asset import rigid_geometry as geometry
from wheelleg_exp.asset.rigid_geometry import Array, MeshVolume, Part, Solid
from wheelleg_exp.asset.robot_description import Inertial, Quat, Vec3
from wheelleg_exp.asset.usd.bodies.rigid_bodies import Link
from wheelleg_exp.asset.usd.colliders import Piece
from wheelleg_exp.asset.usd.gprims import solid_of
from wheelleg_exp.asset.usd.ledger import Ledger
from wheelleg_exp.asset.usd.materials import physics_material
from wheelleg_exp.asset.usd.usd_stage import Stage, find_scene, given, schemas
from wheelleg_exp.errors import AssetError


def parts_of(stage: Stage, link: Link, pieces: Iterable[Piece]) -> list[Part]:
    """Return the mass, centre of mass, and inertia tensor of each collider of a body, in the body's frame.

    The MassAPI of a prim with CollisionAPI applies to all shapes below it. A collider without volume gets no mass.
    """
    shapes: dict[str, list[tuple[Piece, Solid]]] = {}
    for piece in pieces:
        if piece.carrier is None:
            continue
        if "MjcCollisionAPI" in schemas(piece.carrier) and stage.ledger.read(piece.carrier, "physics:mass") == 0:
            stage.ledger.mapped(piece.carrier.GetPath(), "physics:mass", "no mass, as MuJoCo's schemas mean it")
            continue
        if (solid := _solid(stage, piece)) is not None:
            shapes.setdefault(str(piece.carrier.GetPath()), []).append((piece, solid))
    return [_collider(stage, link, group) for group in shapes.values()]


def _collider(stage: Stage, link: Link, group: list[tuple[Piece, Solid]]) -> Part:
    carrier = group[0][0].carrier
    assert carrier is not None
    ledger, path, apart = stage.ledger, carrier.GetPath(), carrier.GetPath() != link.prim.GetPath()
    authored = ledger.read(carrier, "physics:mass") if apart else None
    weighed = given(authored)
    densities = [_density(stage, link, piece, weighed) for piece, _ in group]
    parts = [Part.of(s, (d or geometry.WATER) * s.volume) for d, (_, s) in zip(densities, group, strict=True)]
    # All shapes of one collider prim share the prim's MassAPI, so sum their masses.
    mass, center = sum(part.mass for part in parts), geometry.combined_center(parts)
    assumed = sum(part.mass for d, part in zip(densities, parts, strict=True) if d is None)
    part = Part(mass, center, geometry.combined_tensor(parts, mass, center), 0.0 if weighed else assumed)
    if not apart:
        return part
    if given(authored):
        ledger.mapped(path, "physics:mass", "mass properties of the body")
        kilograms = stage.units.mass(authored)
        part = Part(kilograms, part.center, part.tensor * (kilograms / part.mass))
    inside = link.frame.inverse().matrix() @ stage.matrix(carrier)
    moments, own = ledger.read(carrier, "physics:diagonalInertia"), None
    if given_moments(moments):
        ledger.mapped(path, "physics:diagonalInertia", "the body's inertia")
        axes, turn = ledger.read(carrier, "physics:principalAxes"), geometry.rigid_part(inside).rotation
        if axes is not None and any(axes):
            ledger.mapped(path, "physics:principalAxes", "the body's inertia")
            turn = turn @ geometry.rotation_matrix(axes)
        sizes = without_signs(ledger, str(path), moments)
        own = np.asarray(turn @ np.diag([stage.units.inertia(float(v)) for v in sizes]) @ turn.T)
    middle = _center(stage, carrier, inside, "the body's centre of mass")
    part = part if middle is None else part.about(middle)
    return part if own is None else replace(part, tensor=own)


def _solid(stage: Stage, piece: Piece) -> Solid | None:
    """Return a collider's solid, or its wall if MuJoCo's or Newton's schema makes the collider hollow.

    The solid of a mesh is its convex hull, as in PhysX, unless MuJoCo's schema says otherwise. Without a thickness, the
    density of a hollow collider is per area, as in MuJoCo: ``Solid.volume`` is the area times one unit of the stage.
    """

    def read(name: str) -> object:
        found = (stage.ledger.read(prim, name, "mass properties of the body") for prim in (piece.prim, piece.carrier))
        return next((value for value in found if value is not None), None)

    kind, newtons = read("mjc:inertia"), read("newton:massModel") == "shell"
    if newtons or kind == "shell" or read("mjc:shellinertia"):
        wall = read("newton:shellThickness")
        if isinstance(wall, (int, float)) and given(wall):
            return solid_of(piece.shape, "shell", wall * stage.units.meters)
        if newtons:
            stage.ledger.assume(piece.path, "a hollow collider without a thickness: a surface", "density per area")
        surface = solid_of(piece.shape, "shell")
        return surface and surface.scaled(stage.units.meters)
    volumes: dict[object, MeshVolume] = {"exact": "exact", "legacy": "legacy"}
    return solid_of(piece.shape, volumes.get(kind, "convex"))


def _density(stage: Stage, link: Link, piece: Piece, weighed: bool) -> float | None:
    """Return a shape's density in kg/m³; None if the file gives none. With ``weighed``, the collider has a mass."""
    assert piece.carrier is not None
    material = physics_material(stage, piece.prim)
    for prim in filter(None, (material,) if weighed else (piece.carrier, link.prim, material)):
        value = stage.ledger.read(prim, "physics:density")
        if given(value):
            stage.ledger.mapped(prim.GetPath(), "physics:density", "mass properties of the body")
            return stage.units.density(value)
        if value is not None and value < 0:
            stage.ledger.warn(f"{prim.GetPath()}: a density of {value:g} is taken for not given")
    return None


SMALLEST = 1e-15  # kg or kg m²
NOISE = 1e-6  # relative error of a computed moment


def inertial_of(stage: Stage, link: Link, pieces: Iterable[Piece], welded: bool = False) -> Inertial:
    """Return a body's mass, centre of mass, and principal moments of inertia.

    Disabled colliders count, too. Only a ``welded`` body, which cannot move relative to its parent, can have zero mass.
    """
    inside = link.frame.inverse().matrix() @ stage.matrix(link.prim)
    authored, center = _authored_mass(stage, link), _center(stage, link.prim, inside, "inertial pos")
    moments = _authored_moments(stage, link)
    parts: list[Part] = []
    if authored is None or center is None or moments is None:
        parts = parts_of(stage, link, pieces)
    if authored is None and not parts and moments is None and welded and find_scene(stage) is not None:
        stage.ledger.assume(link.path, "no mass and no collider: none, as MuJoCo", "0 kg")
        return Inertial(0.0, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))
    mass = _computed_mass(stage, link, parts) if authored is None else authored
    if mass < SMALLEST and not welded:
        raise AssetError(f"the mass of {mass:g} kg is too small", key=link.path, expected=f"more than {SMALLEST:g} kg")
    missing = {"mass": authored, "pos": center, "diaginertia": moments}
    if parts:  # UsdPhysics defines these values, so the converter does not assume them.
        names = ", ".join(name for name, value in missing.items() if value is None)
        stage.ledger.mapped(link.path, "colliders", f"inertial {names}, computed from the shapes")
    if center is None:
        center = geometry.combined_center(parts)
    values, axes = _moments(stage, link, parts, mass, center, moments)
    x, y, z = (geometry.plain_float(value) for value in values)
    if max(x, y, z) < SMALLEST:
        tiny = Inertial(geometry.plain_float(mass), geometry.vec3(center), (x, y, z), axes)
        return _tiny(stage, link, tiny, None if welded else parts or parts_of(stage, link, pieces))
    able = geometry.balanced((x, y, z))
    if able != (x, y, z):
        stage.ledger.assume(link.path, "moments that no body can have (A + B < C): the largest is cut", f"{able}")
        stage.ledger.find("impossible_inertia", link.name, link.path, a=x, b=y, c=z, cut_to=max(able))
        if not np.allclose(able, (x, y, z), rtol=0.01, atol=0):
            text = f"MuJoCo refuses its principal moments {x, y, z}; {able} stand in the model"
            stage.ledger.warn(f"{link.path}: {text}")
    return Inertial(geometry.plain_float(mass), geometry.vec3(center), able, axes)


def _tiny(stage: Stage, link: Link, found: Inertial, parts: list[Part] | None) -> Inertial:
    """Return a body whose moments MuJoCo refuses if it moves: unchanged without ``parts``, else those of the parts."""
    largest = max(found.moments)
    stage.ledger.find("tiny_inertia", link.name, link.path, mass=found.mass, largest=largest)
    if parts is None:
        return replace(found, moments=geometry.balanced(found.moments) if largest > 0 else found.moments)
    rule = f"moments below {SMALLEST:g} kg m² on a body that moves: as if they were not given"
    stage.ledger.assume(link.path, rule, f"{largest:g}")
    center = np.array(found.center_of_mass)
    moments, axes = geometry.principal(_computed_tensor(stage, link, parts, found.mass, center))
    if max(moments) < SMALLEST:
        message = f"principal moments of {found.moments} kg m² are too small"
        raise AssetError(message, key=link.path, expected=f"more than {SMALLEST:g}")
    stage.ledger.warn(f"{link.path}: {rule}; the model has {moments}")
    return replace(found, moments=moments, axes=axes)


def _moments(
    stage: Stage, link: Link, parts: list[Part], mass: float, center: Array, authored: tuple[Vec3, Quat | None] | None
) -> tuple[Vec3, Quat]:
    """Return a body's principal moments and axes; unauthored values are computed from the colliders, as in PhysX."""
    if authored is not None and authored[1] is not None:
        return authored[0], authored[1]
    if authored is not None and not parts:
        return authored[0], (1.0, 0.0, 0.0, 0.0)
    moments, axes = geometry.principal(_computed_tensor(stage, link, parts, mass, center))
    if authored is not None:
        if axes != (1.0, 0.0, 0.0, 0.0):
            stage.ledger.assume(link.path, "no principal axes: those of the colliders, as PhysX", str(axes))
        return authored[0], axes
    return moments, _authored_axes(stage, link) or axes


def _authored_mass(stage: Stage, link: Link) -> float | None:
    value = stage.ledger.read(link.prim, "physics:mass")
    if not given(value):
        if value is not None and value < 0:
            stage.ledger.leave(link.path, "physics:mass", "a negative mass is taken for not given", value)
            stage.ledger.warn(f"{link.path}: a mass of {value:g} is taken for not given")
        return None
    stage.ledger.mapped(link.path, "physics:mass", "inertial mass")
    return stage.units.mass(value)


def _computed_mass(stage: Stage, link: Link, parts: list[Part]) -> float:
    total, assumed = sum(part.mass for part in parts), sum(part.assumed for part in parts)
    if total > 0:
        if assumed > 0:
            rule = f"no mass and no density: the colliders' volume, {geometry.WATER:g} kg/m³"
            stage.ledger.assume(link.path, rule, f"{assumed:.6g} of {total:.6g} kg")
            stage.ledger.find("no_inertial", link.name, link.path, mass=assumed)
        return total
    mass = stage.units.mass(geometry.BARE_MASS)
    stage.ledger.assume(link.path, "no mass and no collider: as PhysX, one unit of the stage", f"{mass:g} kg")
    stage.ledger.find("no_inertial", link.name, link.path, mass=mass)
    return mass


def _center(stage: Stage, prim: Usd.Prim, inside: Array, became: str) -> Array | None:
    """Return a prim's centre of mass, if given, in its body's frame; ``inside`` (4, 4) maps points there, in m."""
    value = stage.ledger.read(prim, "physics:centerOfMass")
    if value is None or not all(math.isfinite(v) for v in value):
        return None
    stage.ledger.mapped(prim.GetPath(), "physics:centerOfMass", became)
    return np.asarray(geometry.apply(inside, np.array([value]))[0])


def _authored_moments(stage: Stage, link: Link) -> tuple[Vec3, Quat | None] | None:
    """Return authored principal moments (kg m²) and axes (None: not authored); None if no moments are given."""
    ledger, factor = stage.ledger, stage.units.inertia(1.0)
    six = ledger.read(link.prim, "newton:inertia")
    if six is not None and len(six) == 6 and any(six):
        ledger.mapped(link.path, "newton:inertia", "inertial diaginertia and quat")
        for name in ("physics:diagonalInertia", "physics:principalAxes"):
            if (value := ledger.read(link.prim, name)) is not None:
                ledger.leave(link.path, name, "newton:inertia, the full tensor, wins over it", value)
        a, b, c, d, e, f = (v * factor for v in six)
        six_moments, axes = geometry.principal(np.array([[a, d, e], [d, b, f], [e, f, c]]))
        return without_signs(ledger, link.path, six_moments), axes
    moments = ledger.read(link.prim, "physics:diagonalInertia")
    if not given_moments(moments):
        return None
    ledger.mapped(link.path, "physics:diagonalInertia", "inertial diaginertia")
    x, y, z = (float(v) * factor for v in without_signs(ledger, link.path, moments))
    return (x, y, z), _authored_axes(stage, link)


def without_signs(ledger: Ledger, path: str, moments: Vec3) -> Vec3:
    """Return principal moments without their signs, as PhysX reads them; report a negative moment."""
    if min(moments) < -NOISE * max(map(abs, moments)):
        shown = "(" + ", ".join(f"{value:.6g}" for value in moments) + ")"
        ledger.assume(path, "a negative moment of inertia: its size counts", shown)
        ledger.warn(f"{path}: the moments of inertia {shown} are read without their signs")
    x, y, z = map(abs, moments)
    return x, y, z


def given_moments(value: Sequence[float] | None) -> bool:
    """Return whether authored moments are given: all finite, and at least one positive."""
    return value is not None and any(v > 0 for v in value) and all(math.isfinite(v) for v in value)


def _authored_axes(stage: Stage, link: Link) -> Quat | None:
    axes = stage.ledger.read(link.prim, "physics:principalAxes")
    if axes is None or not any(axes):
        return None
    stage.ledger.mapped(link.path, "physics:principalAxes", "inertial quat")
    return geometry.quaternion(geometry.rotation_matrix(axes))


def _computed_tensor(stage: Stage, link: Link, parts: list[Part], mass: float, center: Array) -> Array:
    if sum(part.mass for part in parts) <= 0:
        stage.ledger.assume(link.path, "no inertia and no collider: a sphere of 0.1 m, as PhysX", "0.4 m r²")
        stage.ledger.find("no_inertia", link.name, link.path, mass=mass)
        return np.eye(3) * 0.4 * mass * geometry.BARE_RADIUS**2
    return geometry.combined_tensor(parts, mass, center)
