"""Choose the roots of body trees, make spanning trees of joints, and replace joints that close loops by equalities."""

from __future__ import annotations

from collections import deque
from collections.abc import Container, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from pxr import Sdf

from wheelleg_exp.asset.rigid_geometry import Frame
from wheelleg_exp.asset.robot_description import BaseMode, Closure, Pose
from wheelleg_exp.asset.usd.bodies.rigid_bodies import Link, Links
from wheelleg_exp.asset.usd.joints.usd_joints import WELD, Joint
from wheelleg_exp.asset.usd.usd_stage import Stage, schemas

Root = tuple[Link, "Joint | None"]


@dataclass
class Graph:
    """The joints at each body (None: the world); ``released`` are roots that the base mode ``floating`` sets free."""

    links: Links
    joints: list[Joint]
    released: list[Link] = field(default_factory=list)
    edges: dict[str | None, list[Joint]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for joint in self.joints:
            for link in joint.links:
                self.edges.setdefault(link.path if link else None, []).append(joint)

    def at(self, link: Link | None) -> list[Joint]:
        """Return all joints of the body ``link``; None stands for the world."""
        return self.edges.get(link.path if link else None, [])

    def neighbours(self, link: Link, closing: bool = False) -> Iterable[Link]:
        """Yield the bodies that joints connect to a body; ``closing`` includes joints that close kinematic loops."""
        for joint in self.at(link):
            other = joint.other(link)
            if other is not None and (closing or not joint.closes):
                yield other

    def component(self, start: Link) -> list[Link]:
        """Return ``start`` and all bodies that joints of the spanning tree connect to ``start``, level by level."""
        found, queue = {start.path: start}, deque([start])
        while queue:
            for other in self.neighbours(queue.popleft()):
                if other.path not in found:
                    found[other.path] = other
                    queue.append(other)
        return list(found.values())


def find_roots(stage: Stage, graph: Graph) -> list[Root]:
    """Return the root bodies, in the order in which their spanning trees are built.

    The roots are, in this order: bodies with a joint to the world, bodies with ArticulationRootAPI, kinematic bodies,
    PhysX's centre body of each floating articulation, and bodies that are not the child of any joint.
    """
    marks = stage.articulation_prims
    roots: dict[str, Root] = {}
    marked_paths = {str(path) for path in marks}
    to_world = graph.at(None)
    # Joints that are, or whose bodies are, marked as articulation roots come first.
    for joint in sorted(to_world, key=lambda j: not marked_paths & {j.path, *(link.path for link in j.links if link)}):
        link = joint.other(None)
        if link is not None and not joint.closes:
            roots.setdefault(link.path, (link, joint))
    for link in graph.released:
        roots.setdefault(link.path, (link, None))
    for path in marks:
        stage.ledger.mapped(path, "PhysicsArticulationRootAPI", "the choice of the root")
        if marked := graph.links.by_path.get(str(path)):
            roots.setdefault(marked.path, (marked, None))
    for link in graph.links:
        if link.kinematic:
            roots.setdefault(link.path, (link, None))
    for middle in _middles(graph, marks, [link for link, _ in roots.values()]):
        roots.setdefault(middle.path, (middle, None))
    children = {j.links[1].path for j in graph.joints if j.links[1] and j.links[0] and not j.closes}
    free = [link for link in graph.links if link.path not in children]
    return [*roots.values(), *((link, None) for link in free if link.path not in roots)]


def is_pinned(stage: Stage, link: Link, joint: Joint) -> bool:
    """Return whether a joint fixes a body to the world as in PhysX: marked there or above the body, not on it."""
    path = Sdf.Path(link.path)
    return any(
        mark == Sdf.Path(joint.path) or (path != mark and path.HasPrefix(mark)) for mark in stage.articulation_prims
    )


def articulated(stage: Stage, graph: Graph) -> list[Joint]:
    """Return the joints between bodies of articulations: all bodies reachable from ArticulationRootAPI."""
    seeds = list(_below(graph.links, stage.articulation_prims))
    marked = {str(path) for path in stage.articulation_prims}
    seeds += [link for joint in graph.joints if joint.path in marked for link in joint.links if link]
    reached: set[str] = set()
    for seed in seeds:
        if seed.path not in reached:
            reached |= {link.path for link in graph.component(seed)}
    return [j for j in graph.joints if not j.closes and all(link and link.path in reached for link in j.links)]


def _middles(graph: Graph, marks: list[Sdf.Path], roots: list[Link]) -> Iterable[Link]:
    """Yield the most central body of each floating articulation, except articulations with a body in ``roots``."""
    reached: set[str] = set()
    for root in roots:
        if root.path not in reached:
            reached |= {link.path for link in graph.component(root)}
    for link in _below(graph.links, marks):
        if link.path not in reached:
            part = graph.component(link)
            reached |= {member.path for member in part}
            yield centre(graph, part)


def _below(links: Links, marks: list[Sdf.Path]) -> Iterable[Link]:
    chosen = set(marks)
    for link in links:
        if any(path in chosen for path in Sdf.Path(link.path).GetPrefixes()):
            yield link


def centre(graph: Graph, part: list[Link]) -> Link:
    """Return the centre of a graph: the body from which the number of joints to the farthest body is smallest.

    As in PhysX, a depth-first search counts the joints, also those that close loops. Of equally central bodies, that
    with the most joints wins, then that which the search from the first body by path reaches first.
    """
    first = min(part, key=lambda link: link.path)
    order = {link.path: index for index, (link, _) in enumerate(_by_depth(graph, first))}

    def rank(link: Link) -> tuple[int, int, int]:
        return max(d for _, d in _by_depth(graph, link, order)), -len(graph.at(link)), order[link.path]

    return min(part if len(part) <= MANY else _middle(graph, part), key=rank)


MANY = 200  # Only the core of a larger graph is searched, to save time. The centre of a tree is in its core.


def _middle(graph: Graph, part: list[Link]) -> list[Link]:
    """Return the possible centres of a graph: the bodies that remain after repeatedly removing all leaves."""
    left = {link.path: link for link in part}
    around = {path: list({o.path for o in graph.neighbours(link, True)} & left.keys()) for path, link in left.items()}
    degree = {path: len(others) for path, others in around.items()}
    # Removing all leaves of a tree again and again leaves the tree's centre; a body in a loop is never a leaf.
    leaves = [path for path, count in degree.items() if count <= 1]
    while leaves and len(left) > 2:
        fresh = []
        for leaf in leaves:
            del left[leaf]
            for other in around[leaf]:
                degree[other] -= 1
                if degree[other] == 1 and other in left:
                    fresh.append(other)
        leaves = fresh
    return list(left.values())[:MANY]


def _by_depth(graph: Graph, start: Link, part: Container[str] | None = None) -> Iterable[tuple[Link, int]]:
    """Yield bodies and depths of a depth-first search, joints by path; with ``part``, also through closed loops."""
    seen, stack = set(), [(start, 0)]
    while stack:
        link, depth = stack.pop()
        if link.path in seen:
            continue
        seen.add(link.path)
        yield link, depth
        joints = sorted(graph.at(link), key=lambda joint: joint.path, reverse=True)
        found = [other for j in joints if (other := j.other(link)) is not None and (part or not j.closes)]
        stack.extend((other, depth + 1) for other in found if part is None or other.path in part)


@dataclass(eq=False)
class Node:
    """A body of the spanning tree; ``pose`` is relative to the parent (None: the world), with the joints at zero."""

    link: Link
    parent: Link | None
    pose: Pose
    joint: Joint | None
    floating: bool
    depth: int
    added: list[Joint] = field(default_factory=list)

    @property
    def reversed(self) -> bool:
        """Whether the USD joint names the child body as body0, and the parent body as body1."""
        return self.joint is not None and self.joint.links[0] is self.link

    @property
    def joints(self) -> list[Joint]:
        """All joints that connect the body to its parent, outermost first; the body can move in each of them."""
        return [self.joint, *self.added] if self.joint else []

    def frame_in_body(self, joint: Joint) -> Frame:
        """Return a joint's frame relative to the frame of the joint's child body."""
        return joint.frames[joint.side(self.link)]


@dataclass
class Tree:
    """The spanning tree: bodies with parents before children, level by level, and the joints that close loops."""

    nodes: list[Node] = field(default_factory=list)
    closures: list[Joint] = field(default_factory=list)


HINGE_REACH = 0.05  # m
CLOSE = 1e-4  # m and rad


def is_exact(joint: Joint) -> bool:
    """Return whether MuJoCo equalities can have the same effect as the joint: a weld, a single hinge, or a ball."""
    return joint.welds or (len(joint.axes) == 1 and joint.axes[0].kind != "slide")


def better_break(nodes: Sequence[Node], closures: Sequence[Joint], settled: set[str]) -> tuple[Joint, Joint] | None:
    """Return the joint at which a kinematic loop is open, and a better joint for opening it; None without a better one.

    The best joint for opening a loop has no drive, and a MuJoCo equality constraint can replace the joint. Among
    several hinge and ball joints of a loop, the joint farthest from the root body is best.
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


def read_closures(stage: Stage, joints: list[Joint]) -> Iterator[Closure]:
    """Yield the MuJoCo equality constraints that replace joints that close kinematic loops."""
    for joint in joints:
        for name in (prop.GetName() for prop in joint.prim.GetAuthoredProperties()):
            if name.startswith(OF_COORDINATES) or (name.startswith("limit:") and joint.axes):
                reason = "the joint closes a loop, so it has no coordinate in the model"
                stage.ledger.leave(joint.path, name, reason)
        if _driven(joint):
            stage.ledger.warn(f"{joint.path}: its drive is lost, because the joint closes a loop")
        if any(axis.kind == "slide" for axis in joint.axes):
            stage.ledger.leave(joint.path, joint.kind, "a sliding joint that closes a loop")
            text = "a sliding joint closes a loop and was left out; MuJoCo has no such equality"
            stage.ledger.warn(f"{joint.path}: {text}")
            continue
        if len(joint.axes) > 1:
            stage.ledger.warn(f"{joint.path}: closes a loop with {len(joint.axes)} axes; only its point is kept")
        equality: Literal["weld", "connect"] = "weld" if joint.welds else "connect"
        stage.ledger.mapped(joint.path, joint.kind, f"equality {equality}")
        places = [Frame.identity()]
        if len(joint.axes) == 1 and joint.axes[0].kind == "hinge":
            places.append(Frame(np.eye(3), HINGE_REACH * np.array(joint.axes[0].axis)))
        anchors = tuple(((joint.frames[0] @ at).pose(), (joint.frames[1] @ at).pose()) for at in places)
        first, second = (link.name if link else None for link in joint.links)
        yield Closure(joint.name, joint.path, equality, (first, second), anchors)


OF_COORDINATES = ("drive:", "state:", "physics:lowerLimit", "physics:upperLimit", "physxJoint", "newton:")


def build_tree(stage: Stage, links: Links, joints: list[Joint], base: BaseMode) -> Tree:
    """Return the spanning tree of the joints, from each articulation's root outwards.

    A loop opens at a joint with excludeFromArticulation, else at the joint farthest from the root, because the tree
    grows level by level; if possible, at a joint that a MuJoCo equality can replace. ``floating`` drops joints that fix
    a root body to the world; ``fixed`` drops the root's free joint.
    """
    joints = _pinned(stage, _moving(stage, joints))
    _articulate(stage, articulated(stage, Graph(links, joints)))
    released: list[Link] = []
    if base == "floating":
        dropped = [joint for joint in joints if None in joint.links and joint.welds]
        for joint in dropped:
            stage.ledger.leave(joint.path, joint.kind, "--base floating drops the joint to the world")
        joints = [joint for joint in joints if joint not in dropped]
        released = [link for joint in dropped for link in joint.links if link]
    settled: set[str] = set()
    # Each time a better joint for opening a kinematic loop is found, build the spanning tree again.
    while True:
        builder = _Builder(stage, Graph(links, joints, released), base)
        tree = builder.grown()
        trade = better_break(tree.nodes, tree.closures, settled)
        if trade is None:
            builder.note()
            return tree
        kept, opened = trade
        kept.closes, opened.closes = False, True
        rule = f"no equality can stand for it where it closes a loop, so the loop opens at {opened.path}"
        stage.ledger.assume(kept.path, rule, "a joint of the tree")
        stage.ledger.warn(f"{kept.path}: {rule}, which has no coordinate in the model")


def _moving(stage: Stage, joints: list[Joint]) -> list[Joint]:
    """Leave out joints that move nothing: those that connect kinematic bodies to the world or to each other."""
    kept = []
    for joint in joints:
        if all(link is None or link.kinematic for link in joint.links):
            reason = "a kinematic body is moved by no joint"
            stage.ledger.leave(joint.path, joint.kind, reason)
            stage.ledger.warn(f"{joint.path}: left out, because {reason}")
        else:
            kept.append(joint)
    return kept


def _pinned(stage: Stage, joints: list[Joint]) -> list[Joint]:
    """Replace a generic joint without limits between root and world by a fixed joint, as PhysX does."""
    for joint in joints:
        free = joint.kind == "PhysicsJoint" and len(joint.axes) == 4 and joint.axes[-1].kind == "ball"
        link = joint.other(None) if None in joint.links else None
        if free and link is not None and is_pinned(stage, link, joint):
            joint.axes = []
            stage.ledger.mapped(joint.path, joint.kind, "a fixed base")
            stage.ledger.assume(joint.path, "a generic joint without limits from the root to the world", "fixed base")
    return joints


def _articulate(stage: Stage, joints: list[Joint]) -> None:
    """Treat joints inside an articulation as PhysX does: generic ones do not slide, and joined bodies never touch."""
    for joint in joints:
        if joint.kind == "PhysicsJoint" and any(axis.kind == "slide" for axis in joint.axes):
            joint.axes = [axis for axis in joint.axes if axis.kind != "slide"]
            if joint.welds:
                stage.ledger.mapped(joint.path, joint.kind, WELD)
            rule = "a generic joint of an articulation does not slide in PhysX: locked"
            stage.ledger.assume(joint.path, rule, "no slides")
            stage.ledger.warn(f"{joint.path}: {rule}, though its file leaves translations free")
        if joint.may_collide:
            joint.may_collide = False
            rule = "PhysX ignores collisionEnabled of joints inside an articulation"
            stage.ledger.assume(joint.path, rule, "the joined bodies do not touch")


class _Builder:
    """Build spanning trees of bodies, breadth first; a joint between two bodies of one tree closes a kinematic loop."""

    def __init__(self, stage: Stage, graph: Graph, base: BaseMode) -> None:
        self.stage, self.graph, self.base = stage, graph, base
        self.tree = Tree()
        self._placed: dict[str, Frame] = {}
        self._used: set[str] = set()

    def grown(self) -> Tree:
        for root, joint in find_roots(self.stage, self.graph):
            self._grow(root, joint)
        for link in self.graph.links:
            self._grow(link, None)
        self._close()
        return self.tree

    def note(self) -> None:
        for node in self.tree.nodes:
            if node.joint is None and self.base == "fixed" and not node.link.kinematic:
                self.stage.ledger.assume(node.link.path, "--base fixed", "no free joint")
        for joint in self.tree.closures:
            if not joint.closes:
                self.stage.ledger.warn(f"{joint.path}: closes a loop, so it became an equality, not a joint")

    def _grow(self, root: Link, joint: Joint | None) -> None:
        if root.path in self._placed:
            return
        self._place(root, None, joint, 0)
        queue = deque([(root, 0)])
        while queue:
            link, depth = queue.popleft()
            for edge in self.graph.at(link):
                child = edge.other(link)
                if child is None or edge.closes or child.kinematic or child.path in self._placed:
                    continue
                self._place(child, link, edge, depth + 1)
                queue.append((child, depth + 1))

    def _place(self, link: Link, parent: Link | None, joint: Joint | None, depth: int) -> None:
        if joint is None:
            relative, floating = link.frame, self.base != "fixed" and not link.kinematic
        else:
            side = joint.side(link)
            # At the zero position of a USD joint, the joint frames of its two bodies coincide.
            relative, floating = joint.frames[1 - side] @ joint.frames[side].inverse(), False
            self._used.add(joint.path)
            if parent is None and joint.welds and is_pinned(self.stage, link, joint):
                apart, relative = relative.distance(link.frame), link.frame
                if max(apart) > CLOSE:
                    rule = "the root of a fixed-base articulation stays where it is drawn, as in PhysX"
                    self.stage.ledger.assume(
                        joint.path, rule, f"the frames differ by {apart[0]:.4g} m, {apart[1]:.4g} rad"
                    )
        above = self._placed[parent.path] if parent else Frame.identity()
        self._placed[link.path] = above @ relative
        self.tree.nodes.append(Node(link, parent, relative.pose(), joint, floating, depth))

    def _close(self) -> None:
        """Convert joints outside the spanning tree to loop closures, or to further joints of their child bodies."""
        # Whether parallel joints between two bodies add their degrees of freedom; None if the file does not say it.
        read, use = self.stage.ledger.read, "several joints of one body"
        given = [read(prim, "newton:jointsAddMobility", use) for prim in self.stage.prims if schemas(prim)]
        said = None if all(value is None for value in given) else any(given)
        edges = {(id(n.joint.links[0]), id(n.joint.links[1])): n for n in self.tree.nodes if n.joint}
        for joint in self.graph.joints:
            if joint.path in self._used:
                continue
            edge = edges.get((id(joint.links[0]), id(joint.links[1])))
            # The degrees of freedom of several joints with MjcJointAPI add up.
            alike = all(one and "MjcJointAPI" in schemas(one.prim) for one in (edge and edge.joint, joint))
            if edge is not None and not joint.closes and (alike if said is None else said):
                edge.added.append(joint)
            elif all(link is None or link.kinematic for link in joint.links):
                reason = "joins bodies that nothing moves: kinematic ones, or the world"
                self.stage.ledger.leave(joint.path, joint.kind, reason)
            else:
                self.tree.closures.append(joint)
