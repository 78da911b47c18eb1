"""Reads contact parameters, friction and groups of shapes from MuJoCo's and Newton's schemas."""

from __future__ import annotations

from dataclasses import replace

from pxr import Usd, UsdShade

from wheelleg_exp.asset.description import Geom
from wheelleg_exp.asset.usd.mjc.values import Attribute, attributes, leave
from wheelleg_exp.asset.usd.stage import Stage, schemas

NEWTON = {"newton:contactMargin": "margin", "newton:contactGap": "gap"}
NAMES = {
    "mjc:condim": "condim",
    "mjc:priority": "priority",
    "mjc:solref": "solref",
    "mjc:solimp": "solimp",
    "mjc:solmix": "solmix",
    "mjc:margin": "margin",
    "mjc:gap": "gap",
}
FRICTION = (0.0, 0.005, 0.0001)  # torsional and rolling are those of a geom without any
EXPLICIT = ("mjc:shellinertia", "mjc:inertia")  # how a shape weighs, where nothing asked for it
DRAWN = {"MjcCollisionAPI", "MjcImageableAPI"}  # the schemas that hold a group, 0 when it is not authored
SOLID = {"MjcCollisionAPI", "NewtonCollisionAPI"}


def with_extra(stage: Stage, geom: Geom) -> Geom:
    """Return a geom with MuJoCo's own attributes: those of its prim, or of the prim above that carries them."""
    prim = stage.usd.GetPrimAtPath(geom.path)
    found: dict[str, Attribute] = {}
    drawn = _carrier(prim, DRAWN)
    if drawn:
        found["group"] = int(stage.ledger.read(drawn, "mjc:group", "group") or 0)
    solid = _carrier(prim, SOLID) if geom.collides else None
    if solid:
        found |= attributes(stage, solid, NEWTON) | attributes(stage, solid, NAMES)
        found |= _friction(stage, prim, geom)
        for name in EXPLICIT:
            leave(stage, solid, name, "masses and inertias are written explicitly")
    return replace(geom, extra={**geom.extra, **found}) if found else geom


def hull_size(stage: Stage, geom: Geom) -> dict[str, Attribute]:
    """Return how many vertices a mesh's convex hull may have, as the mesh's attribute."""
    prim = stage.usd.GetPrimAtPath(geom.path)
    names = {"newton:maxHullVertices": "maxhullvert", "mjc:maxhullvert": "maxhullvert"}
    found = attributes(stage, prim, names)
    return {key: value for key, value in found.items() if isinstance(value, int) and value > 0}


def _carrier(prim: Usd.Prim, wanted: set[str]) -> Usd.Prim | None:
    """Return the prim, or the nearest above, that has one of the schemas; bodies end the search."""
    while prim and not prim.IsPseudoRoot():
        found = set(schemas(prim))
        if wanted & found:
            return prim
        if "PhysicsRigidBodyAPI" in found:
            return None
        prim = prim.GetParent()
    return None


def _friction(stage: Stage, prim: Usd.Prim, geom: Geom) -> dict[str, Attribute]:
    """Return three friction coefficients where the bound material has more than the sliding one."""
    bound = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial("physics")[0]
    if not bound or geom.friction is None:
        return {}
    material = bound.GetPrim()
    values = [geom.friction, *FRICTION[1:]]
    for schema, suffix in (("newton:", "Friction"), ("mjc:", "friction")):
        for index, kind in enumerate(("torsional", "rolling"), start=1):
            value = stage.ledger.read(material, f"{schema}{kind}{suffix}", f"geom friction[{index}]")
            if value is not None and value >= 0:
                values[index] = float(value)
    return {} if tuple(values[1:]) == FRICTION[1:] else {"friction": tuple(values)}
