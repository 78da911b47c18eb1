"""Choose the roots of the trees: bodies fixed to the world, articulation roots, and centres of floating parts."""

from __future__ import annotations

from collections import deque
from collections.abc import Container, Iterable
from dataclasses import dataclass, field

from pxr import Sdf

from wheelleg_exp.asset.usd.bodies.rigid_bodies import Link, Links
from wheelleg_exp.asset.usd.joints.usd_joints import Joint
from wheelleg_exp.asset.usd.usd_stage import Stage

Root = tuple[Link, "Joint | None"]


@dataclass
class Graph:
    """The graph of bodies and joints: the joints at each body; ``edges[None]`` are the joints to the world.

    ``released`` lists root bodies whose joint to the world is removed by the base mode ``floating``.
    """

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
    """Return whether a joint to the world makes ``link`` the fixed base of an articulation, as in PhysX.

    ArticulationRootAPI is on the joint or above the body. An articulation with ArticulationRootAPI on the body floats,
    and its joint to the world is a constraint.
    """
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

    As in PhysX, a depth-first search counts the joints, also those that close loops. If several bodies of a graph are
    equally central, the body with the most joints is the centre; then the body that a depth-first search from the first
    body by path reaches first.
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
    """Yield the bodies in the order of a depth-first search, joints by path, with their depths in joints.

    With ``part``, the paths of bodies, the search includes the joints between these bodies that close loops.
    """
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
