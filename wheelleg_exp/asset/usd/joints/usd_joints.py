"""Read the USD joints: the bodies that each joint connects, the joint frames, and the free axes."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
from pxr import Sdf, Usd, UsdPhysics

from wheelleg_exp.asset.rigid_geometry import Frame, apply, rigid_part, rotation_matrix
from wheelleg_exp.asset.usd.bodies.rigid_bodies import Link, Links, named
from wheelleg_exp.asset.usd.joints.joint_axes import UNIT, FreeAxis, axis_name, ball_axes, generic_axes
from wheelleg_exp.asset.usd.usd_stage import Stage, schemas

DISTANCE = "PhysicsDistanceJoint"

WELD = "a weld to the parent body"


@dataclass(eq=False)
class Joint:
    """A joint as authored: body0 and body1 (None: the world), and the joint's frame in each of them.

    ``excluded`` is USD's excludeFromArticulation. If ``closes`` is true, the joint is outside the spanning tree of
    bodies.
    """

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
