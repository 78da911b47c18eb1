"""What the colliders of a body weigh: their own mass, else a density times their volume."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import cast

import numpy as np
from pxr import Usd

from wheelleg_exp.asset.geometry import Array, apply, rigid_part, rotation_matrix
from wheelleg_exp.asset.solids import WATER, MeshVolume, Part, Solid, combined_center, combined_tensor, primitive
from wheelleg_exp.asset.solids import mesh_solid as solid_of_mesh
from wheelleg_exp.asset.usd.bodies.rigid_bodies import Link
from wheelleg_exp.asset.usd.shapes.colliders import Piece
from wheelleg_exp.asset.usd.shapes.materials import physics_material
from wheelleg_exp.asset.usd.stage import Stage, schemas
from wheelleg_exp.asset.usd.units import given

NO_DENSITY = "no density: water"


def parts_of(stage: Stage, link: Link, pieces: Iterable[Piece]) -> list[Part]:
    """Return what each collider of a body weighs, in the body's frame.

    A collider is the prim with CollisionAPI: its MassAPI goes for all shapes below it together. Shapes without
    volume weigh nothing.
    """
    shapes: dict[str, list[tuple[Piece, Solid]]] = {}
    for piece in pieces:
        if piece.carrier is None or _weightless(stage, piece.carrier):
            continue
        if (solid := _solid(piece)) is not None:
            shapes.setdefault(str(piece.carrier.GetPath()), []).append((piece, solid))
    return [_collider(stage, link, group) for group in shapes.values()]


def _weightless(stage: Stage, carrier: Usd.Prim) -> bool:
    """Return whether a collider of MuJoCo's schemas weighs nothing: there a mass of 0 is one."""
    if "MjcCollisionAPI" not in schemas(carrier) or stage.ledger.read(carrier, "physics:mass") != 0:
        return False
    stage.ledger.mapped(carrier.GetPath(), "physics:mass", "no mass, as MuJoCo's schemas mean it")
    return True


def _collider(stage: Stage, link: Link, group: list[tuple[Piece, Solid]]) -> Part:
    carrier = group[0][0].carrier
    assert carrier is not None
    parts = [Part.of(solid, _density(stage, link, piece) * solid.volume) for piece, solid in group]
    center = combined_center(parts)
    whole = Part(sum(p.mass for p in parts), center, combined_tensor(parts, sum(p.mass for p in parts), center))
    if carrier.GetPath() == link.prim.GetPath():  # what is authored there is the body's
        return whole
    return _with_own(stage, link, carrier, whole)


def _with_own(stage: Stage, link: Link, carrier: Usd.Prim, part: Part) -> Part:
    """Return a collider with what its own MassAPI says of mass, centre and moments."""
    ledger, path = stage.ledger, carrier.GetPath()
    mass, tensor = ledger.read(carrier, "physics:mass"), part.tensor
    if given(mass):
        ledger.mapped(path, "physics:mass", "the body's mass")
        part = Part(stage.units.mass(mass), part.center, tensor * (stage.units.mass(mass) / part.mass))
    inside = link.frame.inverse().matrix() @ stage.matrix(carrier)
    own = _own_tensor(stage, carrier, inside)
    center = ledger.read(carrier, "physics:centerOfMass")
    if center is not None and all(math.isfinite(v) for v in center):
        ledger.mapped(path, "physics:centerOfMass", "the body's centre of mass")
        part = part.about(apply(inside, np.array([center]))[0])
    return part if own is None else Part(part.mass, part.center, own)


def _own_tensor(stage: Stage, carrier: Usd.Prim, inside: Array) -> Array | None:
    moments = stage.ledger.read(carrier, "physics:diagonalInertia")
    if moments is None or not any(v > 0 for v in moments) or not all(math.isfinite(v) for v in moments):
        return None
    stage.ledger.mapped(carrier.GetPath(), "physics:diagonalInertia", "the body's inertia")
    axes = stage.ledger.read(carrier, "physics:principalAxes")
    turn = rigid_part(inside).rotation
    if axes is not None and any(axes):
        stage.ledger.mapped(carrier.GetPath(), "physics:principalAxes", "the body's inertia")
        turn = turn @ rotation_matrix(axes)
    return np.asarray(turn @ np.diag([stage.units.inertia(float(v)) for v in moments]) @ turn.T)


def _solid(piece: Piece) -> Solid | None:
    shape = piece.shape
    if shape.kind == "plane":
        return None
    try:
        if shape.weight is not None:
            solid = shape.weight
        elif shape.vertices is None:
            solid = primitive(shape.kind, shape.size)
        else:
            solid = solid_of_mesh(shape.vertices, shape.faces, _volume(piece))
    except ValueError:
        return None
    return solid.seen_from(shape.frame) if solid.volume > 0 else None


def _volume(piece: Piece) -> MeshVolume:
    """Return how a mesh weighs: PhysX takes its hull; MuJoCo's and Newton's schemas may say otherwise."""
    assert piece.carrier is not None
    for prim in (piece.prim, piece.carrier):
        model = prim.GetAttribute("newton:massModel")
        if model and model.HasAuthoredValue() and model.Get() == "shell":
            return "shell"
        kind = prim.GetAttribute("mjc:inertia")
        value = kind.Get() if kind and kind.HasAuthoredValue() else None
        if value in ("exact", "legacy", "shell", "convex"):
            return cast(MeshVolume, value)
    return "convex"


def _density(stage: Stage, link: Link, piece: Piece) -> float:
    """Return kg/m³: the collider's own, else the body's, else the bound material's, else water."""
    assert piece.carrier is not None
    for prim in (piece.carrier, link.prim):
        value = stage.ledger.read(prim, "physics:density", "the body's mass")
        if given(value):
            return stage.units.density(value)
        if value is not None and value < 0:
            stage.ledger.warn(f"{prim.GetPath()}: a density of {value:g} is taken for not given")
    material = physics_material(stage, piece.prim)
    if material is not None:
        value = stage.ledger.read(material, "physics:density", "the body's mass")
        if given(value):
            return stage.units.density(value)
    if not given(stage.ledger.read(link.prim, "physics:mass")):
        stage.ledger.assume(link.path, NO_DENSITY, f"{WATER:g} kg/m³")
    return WATER
