"""Links and joints of a URDF as a tree: names, references, one root, no loops."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

from wheelleg_exp.asset.sources import MOST_BODIES, require_size
from wheelleg_exp.asset.urdf.document import Document
from wheelleg_exp.asset.urdf.xml import Element
from wheelleg_exp.errors import nearest_name

KINDS = ("revolute", "continuous", "prismatic", "fixed", "floating", "planar", "spherical")
WORLD = "world"  # a root link of this name that weighs nothing is the world itself


@dataclass(eq=False)
class Link:
    """A link, the joint that leads to it (None: the root), and the joints that leave it."""

    element: Element
    name: str
    joint: Joint | None = None
    joints: list[Joint] = field(default_factory=list)


@dataclass(eq=False)
class Joint:
    """A joint: ``kind`` as URDF calls it."""

    element: Element
    name: str
    kind: str
    parent: Link
    child: Link

    @property
    def welds(self) -> bool:
        """Whether nothing is left free."""
        return self.kind == "fixed"


@dataclass(eq=False)
class Tree:
    """Links and joints in the order of the file."""

    links: dict[str, Link]
    joints: dict[str, Joint]
    root: Link

    @property
    def world(self) -> Link | None:
        """Return the root when it stands for the world: named so, and without mass."""
        return self.root if self.root.name == WORLD and self.root.element.first("inertial") is None else None

    def depth_first(self) -> Iterator[Link]:
        """Yield all links, parents first, each with its whole branch before the next."""
        stack = [self.root]
        while stack:
            link = stack.pop()
            yield link
            stack.extend(joint.child for joint in reversed(link.joints))

    def breadth_first(self) -> Iterator[Link]:
        """Yield all links level by level."""
        level = [self.root]
        while level:
            yield from level
            level = [joint.child for link in level for joint in link.joints]


def read_tree(document: Document) -> Tree:
    """Return the tree of links.

    Raises:
        AssetError: a name is missing or there twice, a joint's kind or link does not exist, a link hangs on two
            joints, links form a ring, there is more or less than one root, or more links than a robot has.
    """
    links = _links(document)
    joints: dict[str, Joint] = {}
    for element in document.root.all("joint"):
        joint = _joint(document, element, links)
        if joint.name in joints:
            document.fail(element, f"there are two joints '{joint.name}'", "names that tell all joints apart")
        joints[joint.name] = joint
    root = _root(document, links)
    tree = Tree(links, joints, root)
    _require_tree(document, tree)
    return tree


def _links(document: Document) -> dict[str, Link]:
    links: dict[str, Link] = {}
    elements = document.root.all("link")
    require_size(len(elements), MOST_BODIES, "links", where=str(document.source))
    for element in elements:
        name = document.required(element, "name", "body name")
        if name in links:
            document.fail(element, f"there are two links '{name}'", "names that tell all links apart")
        links[name] = Link(element, name)
    if not links:
        document.fail(document.root, f"'{document.source.name}' has no link", "<link> elements below <robot>")
    return links


def _joint(document: Document, element: Element, links: dict[str, Link]) -> Joint:
    name = document.required(element, "name", "joint name")
    kind = document.required(element, "type", "joint type")
    if kind not in KINDS:
        nearest = nearest_name(kind, KINDS)
        hint = f"one of {', '.join(KINDS)}" + (f"; did you mean '{nearest}'?" if nearest else "")
        document.fail(element, f"there is no joint type '{kind}'", hint)
    parent, child = (_end(document, element, side, links) for side in ("parent", "child"))
    joint = Joint(element, name, kind, parent, child)
    if child.joint is not None:
        message = f"link '{child.name}' is the child of two joints, '{child.joint.name}' and '{name}'"
        document.fail(element, message, "one joint to each link: URDF knows no loops")
    child.joint = joint
    parent.joints.append(joint)
    return joint


def _end(document: Document, element: Element, side: str, links: dict[str, Link]) -> Link:
    end = element.first(side)
    if end is None:
        document.fail(element, f"<joint> has no <{side}>", f'<{side} link="..."/>')
    name = document.required(end, "link", "the body tree")
    if name not in links:
        nearest = nearest_name(name, links)
        hint = "the name of a <link>" + (f"; did you mean '{nearest}'?" if nearest else "")
        document.fail(end, f"there is no link '{name}'", hint)
    return links[name]


def _root(document: Document, links: dict[str, Link]) -> Link:
    roots = [link for link in links.values() if link.joint is None]
    if not roots:
        document.fail(document.root, "the joints form a ring: every link is the child of a joint", "one root link")
    if len(roots) > 1:
        names = ", ".join(link.name for link in roots[:8]) + (", ..." if len(roots) > 8 else "")
        message = f"{len(roots)} links hang on no joint: {names}"
        document.fail(roots[1].element, message, "one root; join the others to it by fixed or floating joints")
    return roots[0]


def _require_tree(document: Document, tree: Tree) -> None:
    reached = {link.name for link in tree.depth_first()}
    for link in tree.links.values():
        if link.name not in reached:
            message = f"link '{link.name}' is not reached from the root '{tree.root.name}': its joints form a ring"
            document.fail(link.element, message, "a tree of links")
