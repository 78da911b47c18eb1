"""Read distance joints, which become tendons, and PhysX's mimic joints, which become couplings."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

from pxr import Usd

from wheelleg_exp.asset.robot_description import Closure, Coupling, Dof, Extra, Site, Tendon, TendonPoint
from wheelleg_exp.asset.usd.joints.usd_joints import DISTANCE, FAR, Joint, Range
from wheelleg_exp.asset.usd.usd_stage import Stage, schemas

ROD = 1e-4
DISTANCES = ("physics:minDistance", "physics:maxDistance")
SPRING = "physxPhysicsDistanceJoint:"


@dataclass
class Ropes:
    """Tendons, their sites by body (None: the world), and distances of zero, which are closures."""

    tendons: list[Tendon] = field(default_factory=list)
    sites: dict[str | None, list[Site]] = field(default_factory=dict)
    closures: list[Closure] = field(default_factory=list)


def read_ropes(stage: Stage, joints: list[Joint]) -> Ropes:
    """Convert USD distance joints, and distance limits of generic USD joints, to tendons."""
    ropes = Ropes()
    for joint in joints:
        if joint.kind == DISTANCE or (joint.kind == "PhysicsJoint" and any(a.kind == "slide" for a in joint.axes)):
            names = (
                DISTANCES if joint.kind == DISTANCE else ("limit:distance:physics:low", "limit:distance:physics:high")
            )
            low, high = (stage.ledger.read(joint.prim, name, "tendon range") for name in names)
            _add(stage, joint, _range(stage, low, high), ropes)
    return ropes


def _range(stage: Stage, low: float | None, high: float | None) -> Range | None:
    no_low, no_high = low is None or not low > 0, high is None or not 0 <= high < FAR
    if no_low and no_high:
        return None
    units = stage.units
    return (
        0.0 if no_low or low is None else units.coordinate(low, False),
        FAR if no_high or high is None else units.coordinate(high, False),
    )


def _add(stage: Stage, joint: Joint, limits: Range | None, ropes: Ropes) -> None:
    names = tuple(link.name if link else None for link in joint.links)
    if limits is None or limits[0] > limits[1]:
        if joint.kind == DISTANCE:
            stage.ledger.leave(joint.path, joint.kind, "it limits no distance")
            stage.ledger.warn(f"{joint.path}: a distance joint without distances was left out")
        return
    if limits[1] == 0:
        anchors = ((joint.frames[0].pose(), joint.frames[1].pose()),)
        ropes.closures.append(Closure(joint.name, joint.path, "connect", (names[0], names[1]), anchors))
        stage.ledger.mapped(joint.path, joint.kind, "equality connect: the distance is 0")
        return
    points = []
    for side, name in enumerate(names):
        site = Site(f"{joint.name}_end_{'ab'[side]}", joint.path, joint.frames[side].pose())
        ropes.sites.setdefault(name, []).append(site)
        points.append(TendonPoint("site", site.name))
    stage.ledger.mapped(joint.path, joint.kind, f"spatial tendon {joint.name}")
    extra = _spring(stage, joint.prim, limits)
    wide = limits if limits[0] < limits[1] else (limits[0] * (1 - ROD), limits[1] * (1 + ROD))
    reach = None if extra else wide
    ropes.tendons.append(Tendon(joint.name, joint.path, points=tuple(points), range=reach, extra=extra))


def _spring(stage: Stage, prim: Usd.Prim, limits: Range) -> Extra:
    """Return the MJCF attributes of a tendon's spring, which acts only outside the distance range, as in PhysX."""
    read, units = stage.ledger.read, stage.units
    if read(prim, f"{SPRING}springEnabled", "tendon stiffness") is not True:
        return {}
    stiffness = units.gain(read(prim, f"{SPRING}springStiffness", "tendon stiffness") or 0.0, False)
    damping = units.gain(read(prim, f"{SPRING}springDamping", "tendon damping") or 0.0, False)
    if "PhysxPhysicsDistanceJointAPI" not in schemas(prim) or stiffness <= 0:
        return {}
    return {"stiffness": stiffness, "damping": damping, "springlength": limits}


SCHEMA = "PhysxMimicJointAPI:"


def read_mimics(stage: Stage, dofs: Sequence[Dof]) -> Iterator[Coupling]:
    """Yield a joint coupling for each PhysxMimicJointAPI of the stage."""
    by_path: dict[str, list[Dof]] = {}
    for dof in dofs:
        by_path.setdefault(dof.path, []).append(dof)
    applied = [(prim, name) for prim in stage.prims for name in schemas(prim) if name.startswith(SCHEMA)]
    for prim, schema in applied:
        axis = schema.removeprefix(SCHEMA)
        read, prefix = stage.ledger.read, f"physxMimicJoint:{axis}:"
        targets = stage.ledger.targets(prim, f"{prefix}referenceJoint", "equality joint")
        token = read(prim, f"{prefix}referenceJointAxis", "equality joint")
        leader = _dof(by_path, str(targets[0]) if targets else "", token)
        follower = _dof(by_path, str(prim.GetPath()), axis)
        if leader is None or follower is None or leader.name == follower.name:
            stage.ledger.leave(prim.GetPath(), SCHEMA + axis, "it follows no coordinate of the model")
            stage.ledger.warn(f"{prim.GetPath()}: follows no joint of the robot, so the coupling was left out")
            continue
        gearing, offset = read(prim, f"{prefix}gearing", "polycoef"), read(prim, f"{prefix}offset", "polycoef")
        ratio = (1.0 if gearing is None else gearing) * _unit(stage, follower) / _unit(stage, leader)
        start = (offset or 0.0) * _unit(stage, follower)
        for name in ("naturalFrequency", "dampingRatio"):
            if (value := read(prim, prefix + name)) is not None:
                stage.ledger.leave(prim.GetPath(), prefix + name, "PhysX's compliance; MuJoCo's is solref", value)
        stage.ledger.mapped(prim.GetPath(), SCHEMA + axis, f"equality joint: {follower.name} follows {leader.name}")
        name = f"{follower.name}_mimic"
        yield Coupling(name, str(prim.GetPath()), follower.name, leader.name, (-start, -ratio, 0.0, 0.0, 0.0))


def _dof(dofs: Mapping[str, list[Dof]], path: str, axis: str | None) -> Dof | None:
    found = [dof for dof in dofs.get(path, ()) if dof.kind != "ball"]
    if len(found) == 1:
        return found[0]
    return next((dof for dof in found if axis and dof.name.endswith(f"_{axis}")), None)


def _unit(stage: Stage, dof: Dof) -> float:
    return stage.units.meters if dof.kind == "slide" else math.pi / 180
