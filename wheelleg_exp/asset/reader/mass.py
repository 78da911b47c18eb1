"""Mass properties by the rules of UsdPhysics and PhysX: what is authored, else what the colliders weigh."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from pxr import UsdShade

from wheelleg_exp.asset.description import Inertial
from wheelleg_exp.asset.geometry import Array, apply, quaternion, rotation_matrix, vec3
from wheelleg_exp.asset.reader.bodies import Link
from wheelleg_exp.asset.reader.colliders import Piece
from wheelleg_exp.asset.reader.stage import Stage, schemas
from wheelleg_exp.asset.reader.units import given
from wheelleg_exp.asset.solids import Solid, convex_hull, primitive

WATER = 1000.0  # kg/m³, the density of what has none
BARE_MASS, BARE_RADIUS = 1.0, 0.1  # PhysX: a body without mass and colliders is a sphere of 1 kg


@dataclass(frozen=True, eq=False)
class _Part:
    mass: float
    solid: Solid


def inertial_of(stage: Stage, link: Link, pieces: Iterable[Piece]) -> Inertial:
    """Return a body's mass, centre and principal moments.

    Args:
        stage: the open stage.
        link: the body.
        pieces: its shapes; those with a carrier count, switched off or not.
    """
    authored, center, tensor = (
        _authored_mass(stage, link),
        _center(stage, link),
        _authored_tensor(stage, link),
    )
    parts: list[_Part] = []
    if authored is None or center is None or tensor is None:  # the colliders say what the file does not
        parts = [part for piece in pieces if piece.carrier is not None and (part := _part(stage, link, piece))]
    mass = _computed_mass(stage, link, parts) if authored is None else authored
    if center is None:
        center = _combined_center(parts)
        if parts:
            stage.ledger.assume(link.path, "no centre of mass: that of the colliders", str(vec3(center)))
    moments, axes = tensor or _principal(_computed_tensor(stage, link, parts, mass, center))
    return Inertial(mass, vec3(center), moments, axes)


def _authored_mass(stage: Stage, link: Link) -> float | None:
    value = stage.ledger.read(link.prim, "physics:mass")
    if not given(value):
        return None
    stage.ledger.mapped(link.path, "physics:mass", "inertial mass")
    return stage.units.mass(value)


def _computed_mass(stage: Stage, link: Link, parts: list[_Part]) -> float:
    total = sum(part.mass for part in parts)
    if total > 0:
        stage.ledger.assume(link.path, "no mass: from the colliders' volume and density", f"{total:.6g} kg")
        return total
    stage.ledger.assume(link.path, "no mass and no collider: as PhysX", f"{BARE_MASS:g} kg")
    return BARE_MASS


def _center(stage: Stage, link: Link) -> Array | None:
    """Return the authored centre in the body's frame, stretched by the prim's scale; -inf means not given."""
    value = stage.ledger.read(link.prim, "physics:centerOfMass")
    if value is None or not all(math.isfinite(v) for v in value):
        return None
    stage.ledger.mapped(link.path, "physics:centerOfMass", "inertial pos")
    inside = link.frame.inverse().matrix() @ stage.matrix(link.prim)
    return apply(inside, np.array([value]))[0]


def _combined_center(parts: list[_Part]) -> Array:
    total = sum(part.mass for part in parts)
    if total <= 0:
        return np.zeros(3)
    return np.asarray(sum((part.mass * part.solid.center for part in parts), np.zeros(3)) / total)


def _authored_tensor(
    stage: Stage, link: Link
) -> tuple[tuple[float, float, float], tuple[float, float, float, float]] | None:
    """Return authored principal moments (kg m²) and axes, None when none are given."""
    ledger, factor = stage.ledger, stage.units.inertia(1.0)
    six = ledger.read(link.prim, "newton:inertia")
    if six is not None and any(six):
        ledger.mapped(link.path, "newton:inertia", "inertial diaginertia and quat")
        for name in ("physics:diagonalInertia", "physics:principalAxes"):
            if (value := ledger.read(link.prim, name)) is not None:
                ledger.leave(link.path, name, "newton:inertia, the full tensor, wins over it", value)
        a, b, c, d, e, f = (v * factor for v in six)
        return _principal(np.array([[a, d, e], [d, b, f], [e, f, c]]))
    moments = ledger.read(link.prim, "physics:diagonalInertia")
    if moments is None or not any(moments):
        return None
    ledger.mapped(link.path, "physics:diagonalInertia", "inertial diaginertia")
    axes = ledger.read(link.prim, "physics:principalAxes", "inertial quat")
    if axes is None or not any(axes):
        axes = (1.0, 0.0, 0.0, 0.0)
    x, y, z = (float(v) * factor for v in moments)
    return (x, y, z), quaternion(rotation_matrix(axes))


def _computed_tensor(stage: Stage, link: Link, parts: list[_Part], mass: float, center: Array) -> Array:
    """Return the colliders' tensor, scaled to the mass, about ``center`` (parallel-axis rule, as PhysX)."""
    total = sum(part.mass for part in parts)
    if total <= 0:
        stage.ledger.assume(link.path, "no inertia and no collider: a sphere of 0.1 m, as PhysX", "0.4 m r²")
        return np.eye(3) * 0.4 * mass * BARE_RADIUS**2
    stage.ledger.assume(link.path, "no inertia: from the colliders, scaled to the mass", "principal moments")
    tensor = np.zeros((3, 3))
    for part in parts:
        share = part.mass / total * mass
        tensor += part.solid.inertia / part.solid.volume * share + _moved(share, part.solid.center - center)
    return tensor


def _moved(mass: float, offset: Array) -> Array:
    return np.asarray(mass * ((offset @ offset) * np.eye(3) - np.outer(offset, offset)))


def _principal(tensor: Array) -> tuple[tuple[float, float, float], tuple[float, float, float, float]]:
    off = tensor - np.diag(np.diag(tensor))
    if np.abs(off).max() < 1e-9 * np.abs(tensor).max():
        x, y, z = (float(v) for v in np.diag(tensor))
        return (x, y, z), (1.0, 0.0, 0.0, 0.0)
    values, axes = np.linalg.eigh(tensor)
    axes = axes if np.linalg.det(axes) > 0 else -axes
    x, y, z = (float(v) for v in values)
    return (x, y, z), quaternion(axes)


def _part(stage: Stage, link: Link, piece: Piece) -> _Part | None:
    """Return what one collider weighs, None when it has no volume."""
    solid = _solid(piece)
    if solid is None:
        return None
    assert piece.carrier is not None
    own = stage.ledger.read(piece.carrier, "physics:mass")
    if given(own) and piece.carrier.GetPath() != link.prim.GetPath():
        stage.ledger.mapped(piece.carrier.GetPath(), "physics:mass", "the body's mass")
        return _Part(stage.units.mass(own), solid)
    return _Part(_density(stage, link, piece) * solid.volume, solid)


def _solid(piece: Piece) -> Solid | None:
    if piece.shape.kind == "plane":
        return None
    if piece.shape.vertices is None:
        return primitive(piece.shape.kind, piece.shape.size).seen_from(piece.shape.frame)
    try:
        return convex_hull(piece.shape.vertices).seen_from(piece.shape.frame)
    except ValueError:
        return None


def _density(stage: Stage, link: Link, piece: Piece) -> float:
    """Return kg/m³: the collider's own, else the body's, else the bound material's, else water."""
    assert piece.carrier is not None
    for prim in (piece.carrier, link.prim):
        value = stage.ledger.read(prim, "physics:density", "the body's mass")
        if given(value):
            return stage.units.density(value)
    material = UsdShade.MaterialBindingAPI(piece.prim).ComputeBoundMaterial("physics")[0]
    if material and "PhysicsMaterialAPI" in schemas(material.GetPrim()):
        value = stage.ledger.read(material.GetPrim(), "physics:density", "the body's mass")
        if given(value):
            return stage.units.density(value)
    if not given(stage.ledger.read(link.prim, "physics:mass")):
        stage.ledger.assume(link.path, "no density: water", f"{WATER:g} kg/m³")
    return WATER
