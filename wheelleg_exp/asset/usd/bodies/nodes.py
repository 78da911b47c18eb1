"""The tree of bodies: what each node knows of itself, and the order in which nested bodies are written."""

from __future__ import annotations

from dataclasses import dataclass, field

from wheelleg_exp.asset.description import Pose
from wheelleg_exp.asset.geometry import Frame
from wheelleg_exp.asset.usd.bodies.rigid_bodies import Link
from wheelleg_exp.asset.usd.joints.joints import Joint


@dataclass(eq=False)
class Node:
    """A body in the tree: its pose in the parent (None: the world) at zero, the joint that leads there."""

    link: Link
    parent: Link | None
    pose: Pose
    joint: Joint | None
    floating: bool
    depth: int
    added: list[Joint] = field(default_factory=list)

    @property
    def reversed(self) -> bool:
        """Whether the joint names this body first, as body0."""
        return self.joint is not None and self.joint.links[0] is self.link

    @property
    def joints(self) -> list[Joint]:
        """Return all joints to the parent, outermost first: one, unless the file says that joints add up."""
        return [self.joint, *self.added] if self.joint else []

    def frame_in_body(self, joint: Joint) -> Frame:
        """Return a joint's frame in this body."""
        return joint.frames[joint.side(self.link)]


@dataclass
class Tree:
    """Nodes with parents before children, level by level, and the joints that close loops."""

    nodes: list[Node] = field(default_factory=list)
    closures: list[Joint] = field(default_factory=list)

    def depth_first(self) -> list[Node]:
        """Return the nodes in the order in which nested bodies are written."""
        children: dict[str | None, list[Node]] = {}
        for node in self.nodes:
            children.setdefault(node.parent.path if node.parent else None, []).append(node)
        out: list[Node] = []
        stack = list(reversed(children.get(None, [])))
        while stack:
            node = stack.pop()
            out.append(node)
            stack.extend(reversed(children.get(node.link.path, [])))
        return out


def drawn_in_parent(node: Node) -> Frame:
    """Return the pose in the parent that the file draws."""
    return (node.parent.frame.inverse() if node.parent else Frame.identity()) @ node.link.frame
