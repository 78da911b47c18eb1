"""Reads distance joints: a tendon between two points, with a range, or with springs at its ends."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

from pxr import Usd

from wheelleg_exp.asset.description import Closure, Extra, Site, Tendon, TendonPoint
from wheelleg_exp.asset.usd.joints.joints import DISTANCE, Joint
from wheelleg_exp.asset.usd.joints.limits import FAR, Range
from wheelleg_exp.asset.usd.stage import Stage, schemas

ROD = 1e-4  # share of a rigid rod's length by which MuJoCo's range is wider, because it has to have a width
SPRING = "physxPhysicsDistanceJoint:"


@dataclass
class Ropes:
    """Tendons, their sites by body (None: the world), and distances of zero, which are closures."""

    tendons: list[Tendon] = field(default_factory=list)
    sites: dict[str | None, list[Site]] = field(default_factory=dict)
    closures: list[Closure] = field(default_factory=list)


def read_ropes(stage: Stage, joints: list[Joint]) -> Ropes:
    """Return what stands for the distance joints, and for distance limits of generic joints."""
    ropes = Ropes()
    for joint in joints:
        if joint.kind == DISTANCE:
            _add(stage, joint, _distances(stage, joint.prim), ropes)
        elif joint.kind == "PhysicsJoint" and any(axis.kind == "slide" for axis in joint.axes):
            high = stage.ledger.read(joint.prim, "limit:distance:physics:high", "tendon range")
            low = stage.ledger.read(joint.prim, "limit:distance:physics:low", "tendon range")
            _add(stage, joint, _range(stage, low, high), ropes, quiet=True)
    return ropes


def _distances(stage: Stage, prim: Usd.Prim) -> Range | None:
    low = stage.ledger.read(prim, "physics:minDistance", "tendon range")
    high = stage.ledger.read(prim, "physics:maxDistance", "tendon range")
    return _range(stage, low, high)


def _range(stage: Stage, low: float | None, high: float | None) -> Range | None:
    """Return the distances in m; a negative one is none."""
    no_low, no_high = low is None or not low > 0, high is None or not 0 <= high < FAR
    if no_low and no_high:
        return None
    units = stage.units
    return (
        0.0 if no_low or low is None else units.coordinate(low, False),
        FAR if no_high or high is None else units.coordinate(high, False),
    )


def _add(stage: Stage, joint: Joint, limits: Range | None, ropes: Ropes, quiet: bool = False) -> None:
    names = tuple(link.name if link else None for link in joint.links)
    if limits is None or limits[0] > limits[1]:
        if not quiet:
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
    reach = None if extra else _wide(limits)
    ropes.tendons.append(Tendon(joint.name, joint.path, points=tuple(points), range=reach, extra=extra))


def _wide(limits: Range) -> Range:
    if limits[0] < limits[1]:
        return limits
    return limits[0] * (1 - ROD), limits[1] * (1 + ROD)


def _spring(stage: Stage, prim: Usd.Prim, limits: Range) -> Extra:
    """Return PhysX's springs at the ends of the range, which MuJoCo has as springs with a dead band."""
    read, units = stage.ledger.read, stage.units
    if read(prim, f"{SPRING}springEnabled", "tendon stiffness") is not True:
        return {}
    stiffness = units.gain(read(prim, f"{SPRING}springStiffness", "tendon stiffness") or 0.0, False)
    damping = units.gain(read(prim, f"{SPRING}springDamping", "tendon damping") or 0.0, False)
    if "PhysxPhysicsDistanceJointAPI" not in schemas(prim) or stiffness <= 0:
        return {}
    return {"stiffness": stiffness, "damping": damping, "springlength": limits}


def ends(ropes: Ropes) -> Iterator[str]:
    """Yield the names of all sites."""
    return (site.name for sites in ropes.sites.values() for site in sites)
