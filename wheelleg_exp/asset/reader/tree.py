"""Makes a tree of bodies from a graph of joints: roots, parents, poses at zero, and what closes loops."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

from pxr import Sdf, UsdPhysics

from wheelleg_exp.asset.description import BaseMode, Pose
from wheelleg_exp.asset.geometry import Frame
from wheelleg_exp.asset.reader.bodies import Link, Links
from wheelleg_exp.asset.reader.joints import Joint
from wheelleg_exp.asset.reader.stage import Stage, schemas


@dataclass
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
        return joint.frames[0 if joint.links[0] is self.link else 1]


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


def build_tree(stage: Stage, links: Links, joints: list[Joint], base: BaseMode) -> Tree:
    """Return the spanning tree of the joints, from each articulation's root outwards.

    Args:
        stage: the open stage.
        links: its bodies.
        joints: its joints; those to the world decide the base.
        base: ``floating`` drops what pins a root to the world, ``fixed`` removes the free joint.
    """
    joints = _pinned(stage, joints)
    if base == "floating":
        joints = _unpinned(stage, joints)
    builder = _Builder(stage, joints, base)
    for root, joint in _roots(stage, links, joints):
        builder.grow(root, joint)
    for link in links:
        builder.grow(link, None)
    builder.close()
    return builder.tree


def articulation_prims(stage: Stage) -> list[Sdf.Path]:
    """Return the prims that carry ArticulationRootAPI."""
    return [prim.GetPath() for prim in stage.prims if "PhysicsArticulationRootAPI" in schemas(prim)]


def _pinned(stage: Stage, joints: list[Joint]) -> list[Joint]:
    """Read a generic joint without any limit from the root to the world as a fixed one, as PhysX does."""
    roots = articulation_prims(stage)
    for joint in joints:
        generic = joint.prim.GetTypeName() == "PhysicsJoint" and {a.kind for a in joint.axes} == {
            "slide",
            "ball",
        }
        if not generic or None not in joint.links or len(joint.axes) != 4:
            continue
        link = joint.other(None)
        assert link is not None
        if any(Sdf.Path(link.path).HasPrefix(root) or root == Sdf.Path(joint.path) for root in roots):
            joint.axes = []
            stage.ledger.assume(joint.path, "a generic joint without limits from the root to the world", "fixed base")
    return joints


def _unpinned(stage: Stage, joints: list[Joint]) -> list[Joint]:
    kept = []
    for joint in joints:
        if None in joint.links and joint.welds:
            stage.ledger.leave(
                joint.path, str(joint.prim.GetTypeName()), "--base floating drops the joint to the world"
            )
        else:
            kept.append(joint)
    return kept


def _roots(stage: Stage, links: Links, joints: list[Joint]) -> list[tuple[Link, Joint | None]]:
    """Return where trees start: bodies joined to the world, then bodies marked or found as roots."""
    roots: dict[str, tuple[Link, Joint | None]] = {}
    for joint in joints:
        if None in joint.links and not joint.excluded:
            link = joint.other(None)
            if link is not None:
                roots.setdefault(link.path, (link, joint))
    for path in articulation_prims(stage):
        stage.ledger.mapped(path, "PhysicsArticulationRootAPI", "the choice of the root")
        link = links.by_path.get(str(path))
        if link:
            roots.setdefault(link.path, (link, None))
    children = {j.links[1].path for j in joints if j.links[1] and j.links[0] and not j.excluded}
    free = [link for link in links if link.path not in children]
    ordered = list(roots.values())
    return ordered + [(link, None) for link in free if link.path not in roots]


class _Builder:
    """Grows trees breadth first; joints that reach a body already placed close a loop."""

    def __init__(self, stage: Stage, joints: list[Joint], base: BaseMode) -> None:
        self.stage, self.joints, self.base = stage, joints, base
        self.tree = Tree()
        self._placed: dict[str, Frame] = {}
        self._used: set[str] = set()

    def grow(self, root: Link, joint: Joint | None) -> None:
        """Place ``root`` (by ``joint`` to the world, or free) and all that hangs on it."""
        if root.path in self._placed:
            return
        self._place(root, None, joint, 0)
        queue = deque([(root, 0)])
        while queue:
            link, depth = queue.popleft()
            for edge in self.joints:
                child = edge.other(link) if link in edge.links else None
                if child is None or edge.excluded or child.path in self._placed:
                    continue
                self._place(child, link, edge, depth + 1)
                queue.append((child, depth + 1))

    def _place(self, link: Link, parent: Link | None, joint: Joint | None, depth: int) -> None:
        floating = False
        if joint is None:
            relative = link.frame
            floating = self.base != "fixed" and not link.kinematic
            if not floating and not link.kinematic:
                self.stage.ledger.assume(link.path, "--base fixed", "no free joint")
        else:
            mine = joint.frames[0 if joint.links[0] is link else 1]
            theirs = joint.frames[1 if joint.links[0] is link else 0]
            relative = theirs @ mine.inverse()
            self._used.add(joint.path)
        above = self._placed[parent.path] if parent else Frame.identity()
        self._placed[link.path] = above @ relative
        self.tree.nodes.append(Node(link, parent, relative.pose(), joint, floating, depth))

    def close(self) -> None:
        """Take the joints that are no edge of the tree for loops, or add them to their edge."""
        adds = _joints_add_up(self.stage)
        for joint in self.joints:
            if joint.path in self._used:
                continue
            edge = self._edge(joint) if adds and not joint.excluded else None
            if edge is not None:
                edge.added.append(joint)
                continue
            if not joint.excluded and joint.prim.IsA(UsdPhysics.Joint):
                self.stage.ledger.warn(f"{joint.path}: closes a loop, so it became an equality, not a joint")
            self.tree.closures.append(joint)

    def _edge(self, joint: Joint) -> Node | None:
        """Return the edge of the tree between the same two bodies, with the same one as child."""
        for node in self.tree.nodes:
            if node.joint is not None and node.joint.links == joint.links:
                return node
        return None


def _joints_add_up(stage: Stage) -> bool:
    """Return whether several joints between two bodies add their freedoms, as in MuJoCo, instead of a loop."""
    name = "newton:jointsAddMobility"
    return any(stage.ledger.read(prim, name, "several joints of one body") is True for prim in stage.prims)


def drawn_in_parent(node: Node) -> Frame:
    """Return the pose in the parent that the file draws."""
    return (node.parent.frame.inverse() if node.parent else Frame.identity()) @ node.link.frame
