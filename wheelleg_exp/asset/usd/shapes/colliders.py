"""Finds what collides and what is only drawn: gprims, and all of them below a prim with CollisionAPI."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from pxr import Sdf, Usd, UsdGeom

from wheelleg_exp.asset.geometry import Array
from wheelleg_exp.asset.sources import FARTHEST, MOST_POINTS, MOST_SHAPES, require_size
from wheelleg_exp.asset.usd.bodies.rigid_bodies import Link, Links
from wheelleg_exp.asset.usd.shapes.gprims import (
    Shape,
    bounding_box,
    bounding_sphere,
    flat_to_box,
    plane_as_box,
    shape_of,
)
from wheelleg_exp.asset.usd.shapes.instancer import placed_gprims
from wheelleg_exp.asset.usd.shapes.sites import is_site
from wheelleg_exp.asset.usd.stage import Stage, schemas
from wheelleg_exp.errors import AssetError

SHAPED = {"Cube", "Sphere", "Capsule", "Capsule_1", "Cylinder", "Cylinder_1", "Cone", "Plane", "Mesh"}


@dataclass(eq=False)
class Piece:
    """A gprim of a body (None: the world). ``carrier`` has CollisionAPI, None for a visual.

    ``instance`` numbers the copies that a PointInstancer makes of one gprim.
    """

    prim: Usd.Prim
    link: Link | None
    shape: Shape
    carrier: Usd.Prim | None
    collides: bool
    drawn: bool
    instance: int | None = None

    @property
    def path(self) -> str:
        """Return the gprim's path."""
        return str(self.prim.GetPath())

    @property
    def key(self) -> str:
        """Return what tells the piece from all others: its path, with the number of the instance."""
        return self.path if self.instance is None else f"{self.path}_{self.instance}"


def find_pieces(stage: Stage, links: Links) -> list[Piece]:
    """Return all shapes, in the order of the stage. Shapes that nothing can be made of are reported.

    Raises:
        AssetError: there are more, or more points of meshes, than a robot has; or one has no size or place.
    """
    pieces, points = [], 0
    for piece in filter(None, _pieces(stage, links)):
        pieces.append(piece)
        points += piece.shape.points
        require_size(len(pieces), MOST_SHAPES, "shapes", key=piece.path)
        require_size(points, MOST_POINTS, "points and triangles of meshes", key=piece.path)
    return pieces


def _pieces(stage: Stage, links: Links) -> Iterator[Piece | None]:
    carriers: dict[Sdf.Path, Usd.Prim] = {}
    for prim in stage.prims:
        path = prim.GetPath()
        above = carriers.get(path.GetParentPath())
        carrier = prim if "PhysicsCollisionAPI" in schemas(prim) else above
        if prim.IsA(UsdGeom.Gprim):
            if above is not None:  # a gprim's own schema goes for itself alone
                carriers[path] = above
            if not is_site(prim):
                yield _piece(stage, links.owner(path), prim, carrier, stage.matrix(prim))
        elif prim.IsA(UsdGeom.PointInstancer):
            yield from _instances(stage, links.owner(path), prim, carrier)
        elif carrier is not None:
            carriers[path] = carrier


def _instances(stage: Stage, link: Link | None, prim: Usd.Prim, above: Usd.Prim | None) -> Iterator[Piece | None]:
    for item in placed_gprims(stage, prim):
        yield _piece(stage, link, item.prim, item.carrier or above, item.matrix, item.index)


def _piece(
    stage: Stage,
    link: Link | None,
    prim: Usd.Prim,
    carrier: Usd.Prim | None,
    world: Array,
    instance: int | None = None,
) -> Piece | None:
    solid = carrier is not None and stage.ledger.read(carrier, "physics:collisionEnabled", "the choice of colliders")
    collides = carrier is not None and solid is not False
    drawn = _drawn(prim)
    if carrier is None and not drawn:
        stage.ledger.leave(prim.GetPath(), str(prim.GetTypeName()), "neither drawn nor solid")
        return None
    inside = link.frame.inverse().matrix() @ world if link else world
    shape = shape_of(prim, inside)
    reason = ""
    if shape is not None:
        _require_sane(prim, shape)
        if carrier is not None:
            shape = _approximated(stage, prim, carrier, shape, link is None)
            stage.ledger.mapped(carrier.GetPath(), "PhysicsCollisionAPI", "colliders")
        elif shape.vertices is not None and shape.faces is None:  # MuJoCo needs the hull of points alone, drawn or not
            shape = flat_to_box(shape)
        if shape.kind == "plane" and (link is not None or carrier is None):
            shape = None if collides else plane_as_box(prim, inside)
            reason = "a plane collides only where it stands still, in the world"
    if shape is None or _empty(shape):
        _unsupported(stage, prim, collides, "it has no size" if shape else reason)
        return None
    if shape.note:
        stage.ledger.assume(prim.GetPath(), f"{prim.GetTypeName()}: {shape.note}", shape.kind)
    if not collides and carrier is not None:
        stage.ledger.assume(prim.GetPath(), "collisionEnabled is 0: no contact, but it counts for the mass", "visual")
    return Piece(prim, link, shape, carrier, collides, drawn, instance)


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
    if shape.vertices is None:
        return shape
    if prim.GetTypeName() != "Mesh":
        return flat_to_box(shape)
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


def _require_sane(prim: Usd.Prim, shape: Shape) -> None:
    numbers = np.array(shape.size) if shape.vertices is None else shape.vertices
    if not np.isfinite(numbers).all():
        message, expected = "the shape's size or points are not finite", "finite numbers"
    elif numbers.size and np.abs(numbers).max() > FARTHEST:
        message = f"the shape's size or points reach {np.abs(numbers).max():.3g} m"
        expected = f"less than {FARTHEST:g} m"
    else:
        return
    raise AssetError(message, key=str(prim.GetPath()), expected=expected)
