"""Reads the joints: which bodies they join, where their frames are, and what they leave free."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from pxr import Usd, UsdPhysics

from wheelleg_exp.asset.geometry import Frame, apply, rigid_part, rotation_matrix
from wheelleg_exp.asset.naming import unique_names
from wheelleg_exp.asset.reader.bodies import Link, Links, shown_names
from wheelleg_exp.asset.reader.dofs import FreeAxis, d6_axes, single_axis
from wheelleg_exp.asset.reader.stage import Stage


@dataclass
class Joint:
    """A joint as authored: body0 and body1 (None: the world), and the joint's frame in each of them."""

    path: str
    prim: Usd.Prim
    name: str
    links: tuple[Link | None, Link | None]
    frames: tuple[Frame, Frame]
    axes: list[FreeAxis] = field(default_factory=list)
    excluded: bool = False
    may_collide: bool = False

    @property
    def welds(self) -> bool:
        """Whether nothing is left free."""
        return not self.axes

    def other(self, link: Link | None) -> Link | None:
        """Return the body on the other side."""
        return self.links[1] if self.links[0] is link else self.links[0]


def read_joints(stage: Stage, links: Links) -> list[Joint]:
    """Return the enabled joints whose bodies exist, in the order of the stage."""
    prims = [prim for prim in stage.prims if prim.IsA(UsdPhysics.Joint)]
    names = unique_names([str(prim.GetPath()) for prim in prims], shown_names(prims))
    found = (_joint(stage, links, prim, names[str(prim.GetPath())]) for prim in prims)
    return [joint for joint in found if joint is not None]


def _joint(stage: Stage, links: Links, prim: Usd.Prim, name: str) -> Joint | None:
    ledger, path = stage.ledger, prim.GetPath()
    if ledger.read(prim, "physics:jointEnabled", "the choice of joints") is False:
        ledger.leave(path, str(prim.GetTypeName()), "the joint is switched off")
        return None
    ends = [_end(stage, links, prim, i) for i in (0, 1)]
    if any(end is None for end in ends):
        ledger.leave(path, str(prim.GetTypeName()), "its target does not exist")
        ledger.warn(f"{path}: left out, because a body that it names does not exist")
        return None
    (link0, frame0), (link1, frame1) = (end for end in ends if end is not None)
    if link0 is link1:
        ledger.leave(path, str(prim.GetTypeName()), "joins nothing: both ends are on one body, or on the world")
        return None
    axes = _axes(stage, prim)
    if axes is None:
        return None
    joint = Joint(str(path), prim, name, (link0, link1), (frame0, frame1), axes)
    joint.excluded = bool(ledger.read(prim, "physics:excludeFromArticulation", "the choice of loop joints"))
    joint.may_collide = bool(ledger.read(prim, "physics:collisionEnabled", "contact exclude"))
    return joint


def _axes(stage: Stage, prim: Usd.Prim) -> list[FreeAxis] | None:
    kind = str(prim.GetTypeName())
    if kind == "PhysicsRevoluteJoint":
        return single_axis(stage, prim, angular=True)
    if kind == "PhysicsPrismaticJoint":
        return single_axis(stage, prim, angular=False)
    if kind == "PhysicsSphericalJoint":
        stage.ledger.read(prim, "physics:axis", "the ball's cone axis; a ball has none")
        return [FreeAxis("ball", (1.0, 0.0, 0.0), "rot")]
    if kind == "PhysicsFixedJoint":
        stage.ledger.mapped(prim.GetPath(), kind, "a weld to the parent body")
        return []
    if kind == "PhysicsJoint":
        return d6_axes(stage, prim)
    stage.ledger.leave(prim.GetPath(), kind, "this kind of joint is not supported")
    stage.ledger.warn(f"{prim.GetPath()}: a {kind} is not supported and was left out")
    return None


def _end(stage: Stage, links: Links, prim: Usd.Prim, i: int) -> tuple[Link | None, Frame] | None:
    """Return the body at one end and the joint's frame in it; None when the target does not exist."""
    targets = stage.ledger.targets(prim, f"physics:body{i}", "the body tree")
    target = stage.usd.GetPrimAtPath(targets[0]) if targets else None
    if targets and not target:
        return None
    link = links.owner(target.GetPath()) if target else None
    return link, _joint_frame(stage, prim, i, target, link)


def _joint_frame(stage: Stage, prim: Usd.Prim, i: int, target: Usd.Prim | None, link: Link | None) -> Frame:
    """Return the joint's frame in its body (or the world); localPos is stretched by the target's scale."""
    position = stage.ledger.read(prim, f"physics:localPos{i}", "joint frame") or (0.0, 0.0, 0.0)
    rotation = stage.ledger.read(prim, f"physics:localRot{i}", "joint frame") or (1.0, 0.0, 0.0, 0.0)
    if not any(rotation):
        rotation = (1.0, 0.0, 0.0, 0.0)
    matrix = stage.matrix(target)
    inside = link.frame.inverse() if link else Frame.identity()
    origin = apply(matrix, np.array([position]))[0]
    return inside @ Frame(rigid_part(matrix).rotation @ rotation_matrix(rotation), origin)
