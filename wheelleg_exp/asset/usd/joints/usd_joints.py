"""Read the USD joints: the bodies that each joint connects, the joint frames, and the free axes with their ranges."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from pxr import Sdf, Usd, UsdPhysics

from wheelleg_exp.asset.rigid_geometry import Frame, apply, rigid_part, rotation_matrix, turned
from wheelleg_exp.asset.robot_description import Vec3
from wheelleg_exp.asset.usd.bodies.rigid_bodies import Link, Links, named
from wheelleg_exp.asset.usd.usd_stage import Stage, Units, endless, schemas

DISTANCE = "PhysicsDistanceJoint"
WELD = "a weld to the parent body"
UNIT: dict[str, Vec3] = {"X": (1.0, 0.0, 0.0), "Y": (0.0, 1.0, 0.0), "Z": (0.0, 0.0, 1.0)}
SLIDES, TURNS = ("transX", "transY", "transZ"), ("rotX", "rotY", "rotZ")


@dataclass(frozen=True)
class FreeAxis:
    """An axis of motion of a USD joint, in the joint's frame; ``token`` is its USD name, such as ``rotX``."""

    kind: Literal["hinge", "slide", "ball"]
    axis: Vec3
    token: str
    suffix: str = ""


@dataclass(eq=False)
class Joint:
    """A joint as authored: body0 and body1 (None: the world), and its frame in each; ``closes``: outside the tree."""

    path: str
    prim: Usd.Prim
    name: str
    links: tuple[Link | None, Link | None]
    frames: tuple[Frame, Frame]
    axes: list[FreeAxis] = field(default_factory=list)
    excluded: bool = False
    may_collide: bool = False
    closes: bool = False

    @property
    def kind(self) -> str:
        """The USD type of the joint, such as ``PhysicsRevoluteJoint``."""
        return str(self.prim.GetTypeName())

    @property
    def welds(self) -> bool:
        """Whether the joint has no free axis, so that it welds two bodies together."""
        return not self.axes

    def side(self, link: Link | None) -> int:
        """Return the index of the body ``link`` in the USD joint: 0 for body0, 1 for body1."""
        return 0 if self.links[0] is link else 1

    def other(self, link: Link | None) -> Link | None:
        """Return the link that the joint connects to ``link``; None is the world."""
        return self.links[1 - self.side(link)]


def read_joints(stage: Stage, links: Links) -> Iterator[Joint]:
    """Yield the enabled joints of a USD stage whose bodies exist, in the order of the stage."""
    for prim, name in named([prim for prim in stage.prims if prim.IsA(UsdPhysics.Joint)]):
        ledger, path = stage.ledger, prim.GetPath()
        enabled = ledger.read(prim, "physics:jointEnabled", "the choice of joints") is not False
        if not enabled and not {"MjcEqualityWeldAPI", "MjcEqualityConnectAPI"} & set(schemas(prim)):
            ledger.leave(path, str(prim.GetTypeName()), "the joint is switched off")
            continue
        ends = _ends(stage, links, prim)
        if ends is None:
            continue
        (link0, frame0), (link1, frame1) = ends
        found = _axes(stage, prim)
        if found is None:
            continue
        axes, offset = found
        joint = Joint(str(path), prim, name, (link0, link1), (frame0 @ offset, frame1), axes)
        joint.excluded = bool(ledger.read(prim, "physics:excludeFromArticulation", "the choice of loop joints"))
        joint.closes = joint.excluded or not enabled
        joint.may_collide = bool(ledger.read(prim, "physics:collisionEnabled", "contact exclude"))
        yield joint


def _axes(stage: Stage, prim: Usd.Prim) -> tuple[list[FreeAxis], Frame] | None:
    kind, same = str(prim.GetTypeName()), Frame.identity()
    if kind == "PhysicsRevoluteJoint":
        return [FreeAxis("hinge", UNIT[axis_name(stage, prim)], "angular")], same
    if kind == "PhysicsPrismaticJoint":
        return [FreeAxis("slide", UNIT[axis_name(stage, prim)], "linear")], same
    if kind == "PhysicsSphericalJoint":
        return ball_axes(stage, prim), same
    if kind == "PhysicsFixedJoint":
        stage.ledger.mapped(prim.GetPath(), kind, WELD)
        return [], same
    if kind == "PhysicsJoint":
        axes, offset = generic_axes(stage, prim)
        if not axes:
            stage.ledger.mapped(prim.GetPath(), kind, WELD)
        return axes, offset
    if kind == DISTANCE:
        return [], same
    stage.ledger.leave(prim.GetPath(), kind, "this kind of joint is not supported")
    stage.ledger.warn(f"{prim.GetPath()}: a {kind} is not supported and was left out")
    return None


End = tuple[Link | None, Frame]


def _ends(stage: Stage, links: Links, prim: Usd.Prim) -> tuple[End, End] | None:
    ledger, path, kind = stage.ledger, prim.GetPath(), str(prim.GetTypeName())
    first, second = _end(stage, links, prim, 0), _end(stage, links, prim, 1)
    if first is None or second is None:
        ledger.leave(path, kind, "its target does not exist")
        ledger.warn(f"{path}: left out, because a body that it names does not exist")
        return None
    if first[0] is second[0]:
        ledger.leave(path, kind, "joins nothing: both ends are on one body, or on the world")
        return None
    return first, second


def _end(stage: Stage, links: Links, prim: Usd.Prim, i: int) -> End | None:
    targets = stage.ledger.targets(prim, f"physics:body{i}", "the body tree")
    if len(targets) > 1:
        stage.ledger.assume(prim.GetPath(), f"physics:body{i} names several prims: the first", str(targets[0]))
    target = stage.usd.GetPrimAtPath(targets[0].GetPrimPath()) if targets else None
    if targets and not target:
        return None
    link = links.owner(target.GetPath() if target else Sdf.Path.absoluteRootPath)
    position = stage.ledger.read(prim, f"physics:localPos{i}", "joint frame") or (0.0, 0.0, 0.0)
    rotation = stage.ledger.read(prim, f"physics:localRot{i}", "joint frame")
    rotation = rotation_matrix(rotation) if rotation is not None and any(rotation) else np.eye(3)
    matrix = stage.matrix(target)
    # A scaled USD body also scales the position ``physics:localPos`` of its joint.
    at_joint = Frame(rigid_part(matrix).rotation @ rotation, apply(matrix, np.array([position]))[0])
    return link, (link.frame.inverse() if link else Frame.identity()) @ at_joint


def axis_name(stage: Stage, prim: Usd.Prim) -> str:
    """Return X, Y, or Z."""
    name = stage.ledger.read(prim, "physics:axis", "axis")
    if name in UNIT:
        return str(name)
    what = "unknown" if name else "not given"
    stage.ledger.assume(prim.GetPath(), f"physics:axis is {what}: X", repr(name))
    return "X"


def ball_axes(stage: Stage, prim: Usd.Prim) -> list[FreeAxis]:
    """Return the free axes of a spherical joint: a ball, or a hinge if both cone angles are zero."""
    angles = [stage.ledger.read(prim, f"physics:coneAngle{i}Limit", "range of the ball") for i in (0, 1)]
    if angles == [0, 0]:
        stage.ledger.assume(prim.GetPath(), "a spherical joint whose cone is closed turns about its axis", "hinge")
        return [FreeAxis("hinge", UNIT[axis_name(stage, prim)], "twist")]
    stage.ledger.read(prim, "physics:axis", "the ball's cone axis; a ball has none")
    return [FreeAxis("ball", UNIT["X"], "rot")]


def generic_axes(stage: Stage, prim: Usd.Prim) -> tuple[list[FreeAxis], Frame]:
    """Return the free axes of a generic joint, slides before hinges, and the positions of the locked axes.

    A low limit above the high one locks an axis at 0; equal limits lock it at their value. Three free rotations become
    a ball joint, unless one of them has its own limits, drive, state, or friction.
    """
    free, offset = [], Frame.identity()
    for token in (*SLIDES, *TURNS):
        low, high = _limits(stage, prim, token)
        if low is not None and high is not None and low >= high:
            offset = offset @ _at(stage, prim, token, low if low == high else 0.0)
            continue
        kind: Literal["hinge", "slide"] = "slide" if token in SLIDES else "hinge"
        free.append(FreeAxis(kind, UNIT[token[-1]], token, f"_{token}"))
    turns = [axis for axis in free if axis.kind == "hinge"]
    limits = [value for axis in turns for value in _limits(stage, prim, axis.token)]
    spaces = [f"{space}:{axis.token}" for axis in turns for space in ("drive", "state", "physxJointAxis")]
    own = [prim.GetAuthoredPropertiesInNamespace(space) for space in spaces]
    if len(turns) == 3 and all(endless(v, True) for v in limits) and not any(own):
        free = [axis for axis in free if axis.kind == "slide"]
        free.append(FreeAxis("ball", UNIT["X"], "rot", "_rot" if free else ""))
    return free, offset


def _limits(stage: Stage, prim: Usd.Prim, token: str) -> tuple[float | None, float | None]:
    low = stage.ledger.read(prim, f"limit:{token}:physics:low", "the choice of free axes")
    high = stage.ledger.read(prim, f"limit:{token}:physics:high", "the choice of free axes")
    if (low is not None or high is not None) and f"PhysicsLimitAPI:{token}" not in schemas(prim):
        stage.ledger.assume(prim.GetPath(), f"limits of {token} are authored without PhysicsLimitAPI", "honoured")
    return low, high


def _at(stage: Stage, prim: Usd.Prim, token: str, value: float) -> Frame:
    if value == 0:
        return Frame.identity()
    stage.ledger.assume(prim.GetPath(), f"limits of {token} are equal: locked there", f"{value:g}")
    unit, size = np.array(UNIT[token[-1]]), stage.units.coordinate(value, token in TURNS)
    if token in SLIDES:
        return Frame(np.eye(3), unit * size)
    return Frame(turned(unit, size), np.zeros(3))


Range = tuple[float, float]
FAR = 1e6  # rad or m
LOCKED = 1e-4  # rad or m


def read_range(stage: Stage, prim: Usd.Prim, axis: FreeAxis) -> Range | None:
    """Return the limits of one joint axis in rad or m, None if unlimited."""
    if axis.kind == "ball":
        return _cone(stage, prim)
    if axis.token == "twist":
        return None
    ledger, angular = stage.ledger, axis.kind == "hinge"
    if axis.suffix:
        low, high = (ledger.read(prim, f"limit:{axis.token}:physics:{end}", "range") for end in ("low", "high"))
        return _range(stage.units, low, high, angular, one_sided=True)
    low = ledger.read(prim, "physics:lowerLimit", "range")
    high = ledger.read(prim, "physics:upperLimit", "range")
    if low is not None and high is not None and low >= high:
        ledger.find("no_limits", prim.GetName(), prim.GetPath(), lower=low, upper=high)
        if low == high:
            ledger.assume(prim.GetPath(), "lower and upper limit are equal: no limits", f"{low:g}")
            ledger.warn(f"{prim.GetPath()}: limits {low:g} to {high:g} are read as none; PhysX locks such a joint")
            return None
        ledger.assume(prim.GetPath(), "the lower limit is above the upper one: locked, as PhysX", LOCKED)
        ledger.warn(f"{prim.GetPath()}: limits {low:g} to {high:g} are the wrong way round; the joint is locked at 0")
        return -LOCKED, LOCKED
    found = _range(stage.units, low, high, angular, one_sided=not angular)
    if found is None and (low is not None or high is not None):
        ledger.assume(prim.GetPath(), "limits are infinite, huge or one-sided: none", f"{low} to {high}")
    return found


def _range(units: Units, low: float | None, high: float | None, angular: bool, one_sided: bool) -> Range | None:
    """Return a joint axis's range in rad or m, None if unlimited; ``one_sided`` accepts a range with only one end."""
    no_low, no_high = endless(low, angular), endless(high, angular)
    if (no_low and no_high) or ((no_low or no_high) and not one_sided):
        return None
    return (
        -FAR if no_low or low is None else units.coordinate(low, angular),
        FAR if no_high or high is None else units.coordinate(high, angular),
    )


def _cone(stage: Stage, prim: Usd.Prim) -> Range | None:
    """Return a ball's range: the smaller angle of the cone. Angles below 0 mean unlimited."""
    ledger, path = stage.ledger, prim.GetPath()
    angles = [ledger.read(prim, f"physics:coneAngle{i}Limit", "range of the ball") for i in (0, 1)]
    given = [a for a in angles if a is not None and 0 <= a < 360]
    if not given:
        return None
    if len(set(given)) > 1:
        ledger.warn(f"{path}: cone angles {given} differ, the smaller one limits all directions")
    positive = [a for a in given if a > 0]
    if not positive:
        ledger.warn(f"{path}: a cone angle of 0 has no place in a ball's range; the ball is not limited")
        return None
    ledger.assume(path, "a ball's range limits turning about the cone's axis too", f"{min(positive):g} degrees")
    return 0.0, stage.units.coordinate(min(positive), True)
