"""Reads PhysX's mimic joints: coordinates that follow another joint's."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from pxr import Usd

from wheelleg_exp.asset.description import Coupling, Dof
from wheelleg_exp.asset.usd.stage import Stage, schemas

SCHEMA = "PhysxMimicJointAPI:"


def read_mimics(stage: Stage, dofs: Sequence[Dof]) -> tuple[Coupling, ...]:
    """Return a coupling for each PhysxMimicJointAPI, of any axis."""
    by_path: dict[str, list[Dof]] = {}
    for dof in dofs:
        by_path.setdefault(dof.path, []).append(dof)
    found = []
    for prim in stage.prims:
        instances = [name.removeprefix(SCHEMA) for name in schemas(prim) if name.startswith(SCHEMA)]
        found += [_mimic(stage, prim, axis, by_path) for axis in instances]
    return tuple(coupling for coupling in found if coupling is not None)


def _mimic(stage: Stage, prim: Usd.Prim, axis: str, dofs: Mapping[str, list[Dof]]) -> Coupling | None:
    read, prefix = stage.ledger.read, f"physxMimicJoint:{axis}:"
    targets = stage.ledger.targets(prim, f"{prefix}referenceJoint", "equality joint")
    token = read(prim, f"{prefix}referenceJointAxis", "equality joint")
    leader = _dof(dofs, str(targets[0]) if targets else "", token)
    follower = _dof(dofs, str(prim.GetPath()), axis)
    if leader is None or follower is None or leader.name == follower.name:
        stage.ledger.leave(prim.GetPath(), SCHEMA + axis, "it follows no coordinate of the model")
        stage.ledger.warn(f"{prim.GetPath()}: follows no joint of the robot, so the coupling was left out")
        return None
    gearing, offset = read(prim, f"{prefix}gearing", "polycoef"), read(prim, f"{prefix}offset", "polycoef")
    ratio = (1.0 if gearing is None else gearing) * _unit(stage, follower) / _unit(stage, leader)
    start = (offset or 0.0) * _unit(stage, follower)
    for name in ("naturalFrequency", "dampingRatio"):
        if (value := read(prim, prefix + name)) is not None:
            stage.ledger.leave(prim.GetPath(), prefix + name, "PhysX's compliance; MuJoCo's is solref", value)
    stage.ledger.mapped(prim.GetPath(), SCHEMA + axis, f"equality joint: {follower.name} follows {leader.name}")
    name = f"{follower.name}_mimic"
    return Coupling(name, str(prim.GetPath()), follower.name, leader.name, (-start, -ratio, 0.0, 0.0, 0.0))


def _dof(dofs: Mapping[str, list[Dof]], path: str, axis: str | None) -> Dof | None:
    """Return the coordinate of a joint that is meant by an axis; a joint with one coordinate needs none."""
    found = [dof for dof in dofs.get(path, ()) if dof.kind != "ball"]
    if len(found) == 1:
        return found[0]
    return next((dof for dof in found if axis and dof.name.endswith(f"_{axis}")), None)


def _unit(stage: Stage, dof: Dof) -> float:
    """Return what one unit of the file's coordinate is in rad or m."""
    return stage.units.meters if dof.kind == "slide" else math.pi / 180
