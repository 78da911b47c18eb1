"""Reads couplings of joints, and how stiff joints are that close loops."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from pxr import Usd

from wheelleg_exp.asset.description import Closure, Coupling, Dof
from wheelleg_exp.asset.usd.mjc.values import Attribute, attributes
from wheelleg_exp.asset.usd.stage import Stage, schemas

LINEAR = (0.0, 1.0, 0.0, 0.0, 0.0)  # a coupling without coefficients: the same coordinate
SOLVER = {"mjc:solref": "solref", "mjc:solimp": "solimp"}
COUPLED = {"NewtonMimicAPI", "MjcEqualityJointAPI"}
CLOSED = {"MjcEqualityAPI", "MjcEqualityConnectAPI", "MjcEqualityWeldAPI"}


def with_extra(stage: Stage, closure: Closure) -> Closure:
    """Return a loop's joint with the stiffness of its constraint, and whether it is active."""
    prim = stage.usd.GetPrimAtPath(closure.path)
    if not CLOSED & set(schemas(prim)):
        return closure
    found = attributes(stage, prim, SOLVER)
    if closure.kind == "weld":
        found |= attributes(stage, prim, {"mjc:torqueScale": "torquescale"})
    if stage.ledger.read(prim, "physics:jointEnabled", "active") is False:
        found["active"] = False
    return replace(closure, extra={**closure.extra, **found})


def read_couplings(stage: Stage, dofs: Mapping[str, Dof]) -> tuple[Coupling, ...]:
    """Return the joints that follow another one, by NewtonMimicAPI and MjcEqualityJointAPI; ``dofs`` by prim path."""
    found = []
    for prim in stage.prims:
        dof = dofs.get(str(prim.GetPath()))
        if dof is None or not COUPLED & set(schemas(prim)):
            continue
        leaders = stage.ledger.targets(prim, "newton:mimicJoint", "equality joint")
        leaders += stage.ledger.targets(prim, "mjc:target", "equality joint")
        leader = dofs.get(str(leaders[0])) if leaders else None
        if leader is None:
            stage.ledger.warn(f"{prim.GetPath()}: follows no joint of the robot, so the coupling was left out")
            continue
        found.append(_coupling(stage, prim, dof, leader))
    return tuple(found)


def _coupling(stage: Stage, prim: Usd.Prim, dof: Dof, leader: Dof) -> Coupling:
    extra: dict[str, Attribute] = attributes(stage, prim, SOLVER)
    if stage.ledger.read(prim, "newton:mimicEnabled", "active") is False:
        extra["active"] = False
    name = f"{dof.name}_coupling"
    return Coupling(name, dof.path, dof.name, leader.name, _coefficients(stage, prim, dof), extra)


def _coefficients(stage: Stage, prim: Usd.Prim, dof: Dof) -> tuple[float, float, float, float, float]:
    """Return the polynomial in rad and m. Newton's offset is in the unit of USD's coordinate, MuJoCo's is not."""
    values = list(LINEAR)
    for index in range(2):
        value = stage.ledger.read(prim, f"newton:mimicCoef{index}", "equality joint polycoef")
        if value is not None:
            values[index] = float(value) if index else stage.units.coordinate(value, dof.kind == "hinge")
    for index in range(5):
        value = stage.ledger.read(prim, f"mjc:coef{index}", "equality joint polycoef")
        if value is not None:
            values[index] = float(value)
    a, b, c, d, e = values
    return a, b, c, d, e
