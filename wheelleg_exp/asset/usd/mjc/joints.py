"""Reads what MjcJointAPI says beyond what other schemas know of a joint, and MuJoCo's attributes of bodies."""

from __future__ import annotations

from dataclasses import replace

from pxr import Usd

from wheelleg_exp.asset.description import Body, Dof
from wheelleg_exp.asset.usd.mjc.angles import angle_in_radians
from wheelleg_exp.asset.usd.mjc.values import Attribute, attributes
from wheelleg_exp.asset.usd.stage import Stage

NAMES = {
    "mjc:springdamper": "springdamper",
    "mjc:margin": "margin",
    "mjc:solreflimit": "solreflimit",
    "mjc:solimplimit": "solimplimit",
    "mjc:solreffriction": "solreffriction",
    "mjc:solimpfriction": "solimpfriction",
    "mjc:actuatorgravcomp": "actuatorgravcomp",
    "mjc:group": "group",
}


def with_extra(stage: Stage, body: Body) -> Body:
    """Return a body whose joints, and itself, have MuJoCo's own attributes."""
    prim = stage.usd.GetPrimAtPath(body.path)
    found = attributes(stage, prim, {"mjc:body:gravcomp": "gravcomp"})
    dofs = tuple(_dof(stage, dof) for dof in body.dofs)
    return replace(body, dofs=dofs, extra={**body.extra, **found})


def _dof(stage: Stage, dof: Dof) -> Dof:
    prim = stage.usd.GetPrimAtPath(dof.path)
    found = attributes(stage, prim, NAMES)
    springref = stage.ledger.read(prim, "mjc:springref", "springref")
    if springref is not None:
        found["springref"] = angle_in_radians(stage, springref) if dof.kind == "hinge" else float(springref)
    found |= _unlimited(stage, prim, dof)
    return replace(dof, extra={**dof.extra, **found}) if found else dof


def _unlimited(stage: Stage, prim: Usd.Prim, dof: Dof) -> dict[str, Attribute]:
    """Return the switch that turns a range of forces off."""
    token = stage.ledger.read(prim, "mjc:actuatorfrclimited", "actuatorfrclimited")
    return {"actuatorfrclimited": False} if token == "false" and dof.force_range else {}
