"""Joints that close loops: which of them an equality can stand for, and what is lost with the others."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Literal

import numpy as np

from wheelleg_exp.asset.description import Closure, Pose
from wheelleg_exp.asset.geometry import Frame
from wheelleg_exp.asset.usd.bodies.nodes import Node
from wheelleg_exp.asset.usd.joints.joints import Joint
from wheelleg_exp.asset.usd.stage import Stage, schemas

HINGE_REACH = 0.05  # m between the two points that keep a loop's hinge on its axis


def is_exact(joint: Joint) -> bool:
    """Return whether equalities say the same as the joint: a weld, one hinge, or a ball."""
    return joint.welds or (len(joint.axes) == 1 and joint.axes[0].kind != "slide")


def better_break(nodes: Sequence[Node], closures: Sequence[Joint], settled: set[str]) -> tuple[Joint, Joint] | None:
    """Return a closing joint that no equality can stand for, and the joint to open in its place; None for none.

    That joint is of the same loop, can be an equality, and has no drive; of several the one furthest from the root.
    """
    by_path = {node.link.path: node for node in nodes}
    for joint in closures:
        if is_exact(joint) or joint.path in settled:
            continue
        settled.add(joint.path)
        able = [n for n in _loop(by_path, joint) if n.joint and is_exact(n.joint) and not _driven(n.joint)]
        turning = [n for n in able if n.joint and not n.joint.welds] or able
        if turning:
            opened = max(turning, key=lambda node: node.depth).joint
            assert opened is not None
            return joint, opened
    return None


def _loop(by_path: dict[str, Node], joint: Joint) -> list[Node]:
    """Return the nodes whose joints are in the loop that a joint closes."""
    chains = []
    for link in joint.links:
        chain = []
        node = by_path[link.path] if link else None
        while node is not None:
            chain.append(node)
            node = by_path[node.parent.path] if node.parent else None
        chains.append(chain)
    shared = {node.link.path for node in chains[0]} & {node.link.path for node in chains[1]}
    return [node for chain in chains for node in chain if node.link.path not in shared]


def _driven(joint: Joint) -> bool:
    return any(name.startswith("PhysicsDriveAPI") for name in schemas(joint.prim))


def read_closures(stage: Stage, joints: list[Joint]) -> tuple[Closure, ...]:
    """Return the equalities that stand for joints that close loops."""
    found = (_closure(stage, joint) for joint in joints)
    return tuple(closure for closure in found if closure is not None)


def _closure(stage: Stage, joint: Joint) -> Closure | None:
    _leave_coordinates(stage, joint)
    if any(axis.kind == "slide" for axis in joint.axes):
        stage.ledger.leave(joint.path, joint.kind, "a sliding joint that closes a loop")
        stage.ledger.warn(f"{joint.path}: a sliding joint closes a loop and was left out; MuJoCo has no such equality")
        return None
    if len(joint.axes) > 1:
        stage.ledger.warn(f"{joint.path}: closes a loop with {len(joint.axes)} axes; only its point is kept")
    equality: Literal["weld", "connect"] = "weld" if joint.welds else "connect"
    stage.ledger.mapped(joint.path, joint.kind, f"equality {equality}")
    first, second = (link.name if link else None for link in joint.links)
    return Closure(joint.name, joint.path, equality, (first, second), tuple(_anchors(joint)))


def _anchors(joint: Joint) -> Iterator[tuple[Pose, Pose]]:
    """Yield pairs of points that a loop's joint holds together: for a hinge a second one along its axis."""
    first, second = joint.frames
    yield first.pose(), second.pose()
    if len(joint.axes) == 1 and joint.axes[0].kind == "hinge":
        along = Frame(np.eye(3), HINGE_REACH * np.array(joint.axes[0].axis))
        yield (first @ along).pose(), (second @ along).pose()


OF_COORDINATES = ("drive:", "state:", "physics:lowerLimit", "physics:upperLimit", "physxJoint", "newton:")


def _leave_coordinates(stage: Stage, joint: Joint) -> None:
    """Name what a joint says of its coordinate, which it does not have in the model; a drive with a warning."""
    reason = "the joint closes a loop, so it has no coordinate in the model"
    for prop in joint.prim.GetAuthoredProperties():
        name = prop.GetName()
        if name.startswith(OF_COORDINATES) or (name.startswith("limit:") and joint.axes):
            stage.ledger.leave(joint.path, name, reason)
    if _driven(joint):
        stage.ledger.warn(f"{joint.path}: its drive is lost, because the joint closes a loop")
