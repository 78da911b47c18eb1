"""Finds what collides and what is only drawn: gprims, and all of them below a prim with CollisionAPI."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pxr import Usd, UsdGeom

from wheelleg_exp.asset.reader.bodies import Link, Links
from wheelleg_exp.asset.reader.shapes import Shape, bounding_box, bounding_sphere, flat_to_box, shape_of
from wheelleg_exp.asset.reader.sites import is_site
from wheelleg_exp.asset.reader.stage import Stage, schemas
from wheelleg_exp.errors import AssetError

SHAPED = {"Cube", "Sphere", "Capsule", "Cylinder", "Cone", "Plane", "Mesh"}


@dataclass(eq=False)
class Piece:
    """A gprim of a body (None: the world). ``carrier`` has CollisionAPI, None for a visual."""

    prim: Usd.Prim
    link: Link | None
    shape: Shape
    carrier: Usd.Prim | None
    collides: bool
    drawn: bool

    @property
    def path(self) -> str:
        """Return the gprim's path."""
        return str(self.prim.GetPath())


def find_pieces(stage: Stage, links: Links) -> list[Piece]:
    """Return all shapes, in the order of the stage. Shapes that nothing can be made of are reported."""
    carriers: dict[str, Usd.Prim] = {}
    pieces = []
    for prim in stage.prims:
        path = str(prim.GetPath())
        above = carriers.get(str(prim.GetPath().GetParentPath()))
        carrier = prim if "PhysicsCollisionAPI" in schemas(prim) else above
        if carrier is not None:
            carriers[path] = carrier
        if prim.IsA(UsdGeom.Gprim) and not is_site(prim):
            piece = _piece(stage, links, prim, carrier)
            if piece is not None:
                pieces.append(piece)
    return pieces


def _piece(stage: Stage, links: Links, prim: Usd.Prim, carrier: Usd.Prim | None) -> Piece | None:
    solid = carrier is not None and stage.ledger.read(carrier, "physics:collisionEnabled", "the choice of colliders")
    collides = carrier is not None and solid is not False
    drawn = _drawn(prim)
    if carrier is None and not drawn:
        stage.ledger.leave(prim.GetPath(), str(prim.GetTypeName()), "neither drawn nor solid")
        return None
    link = links.owner(prim.GetPath())
    inside = link.frame.inverse().matrix() @ stage.matrix(prim) if link else stage.matrix(prim)
    shape = shape_of(prim, inside)
    if shape is not None:
        _require_finite(prim, shape)
        if carrier is not None:
            shape = _approximated(stage, prim, carrier, shape, link is None)
            stage.ledger.mapped(carrier.GetPath(), "PhysicsCollisionAPI", "colliders")
    if shape is None or _empty(shape):
        _unsupported(stage, prim, collides, "it has no size" if shape else "")
        return None
    if shape.note:
        stage.ledger.assume(prim.GetPath(), f"{prim.GetTypeName()}: {shape.note}", shape.kind)
    if not collides and carrier is not None:
        stage.ledger.assume(prim.GetPath(), "collisionEnabled is 0: no contact, but it counts for the mass", "visual")
    return Piece(prim, link, shape, carrier, collides, drawn)


def _drawn(prim: Usd.Prim) -> bool:
    imageable = UsdGeom.Imageable(prim)
    if imageable.ComputePurpose() not in (UsdGeom.Tokens.default_, UsdGeom.Tokens.render):
        return False
    return bool(imageable.ComputeVisibility() != UsdGeom.Tokens.invisible)


def _empty(shape: Shape) -> bool:
    return shape.kind != "plane" and any(size <= 0 for size in shape.size)


def _unsupported(stage: Stage, prim: Usd.Prim, collides: bool, reason: str) -> None:
    kind = str(prim.GetTypeName())
    if not reason:
        reason = "it has no valid triangles" if kind in SHAPED else "this kind of shape is not supported"
    stage.ledger.leave(prim.GetPath(), kind, reason)
    if collides:
        stage.ledger.warn(f"{prim.GetPath()}: a collider was left out: {reason} ({kind})")


def _approximated(stage: Stage, prim: Usd.Prim, carrier: Usd.Prim, shape: Shape, static: bool) -> Shape:
    """Return what a mesh collides as. MuJoCo always takes a mesh's convex hull."""
    wanted = stage.ledger.read(carrier, "physics:approximation", "the collider's shape")
    if prim.GetPath() != carrier.GetPath():
        wanted = stage.ledger.read(prim, "physics:approximation", "the collider's shape") or wanted
    if prim.GetTypeName() != "Mesh" or shape.vertices is None:
        return shape
    if wanted == "boundingCube":
        return bounding_box(shape)
    if wanted == "boundingSphere":
        return bounding_sphere(shape)
    if wanted not in ("convexHull", None):
        stage.ledger.warn(f"{prim.GetPath()}: approximation '{wanted}' became the mesh's convex hull")
    flat = flat_to_box(shape)
    if flat is not shape and not static:
        stage.ledger.warn(f"{prim.GetPath()}: a flat collider on a moving body became a thin box")
    return flat


def _require_finite(prim: Usd.Prim, shape: Shape) -> None:
    vertices = shape.vertices
    if not np.isfinite(shape.size).all() or (vertices is not None and not np.isfinite(vertices).all()):
        message = "the shape's size or points are not finite"
        raise AssetError(message, key=str(prim.GetPath()), expected="finite numbers")
