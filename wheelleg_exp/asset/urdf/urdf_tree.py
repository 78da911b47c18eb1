"""Links and joints of a URDF as a tree, with frames, axes, and shapes from MuJoCo's own URDF reader.

MuJoCo gets a reduced file: names become numbers and meshes become placeholders. Limits, inertia tensors, and
couplings, which MuJoCo would misread, refuse, or complain about, are read from the XML by this package.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import mujoco
import numpy as np

from wheelleg_exp.asset.file_limits import MOST_BODIES, require_size
from wheelleg_exp.asset.mjcf.compile_mjcf import refusals
from wheelleg_exp.asset.mjcf.mjcf_elements import Element as Xml
from wheelleg_exp.asset.rigid_geometry import Frame
from wheelleg_exp.asset.robot_description import DofKind, Pose, Vec3
from wheelleg_exp.asset.urdf.urdf_document import Document, Element
from wheelleg_exp.errors import nearest_name

KINDS = ("revolute", "continuous", "prismatic", "fixed", "floating", "planar", "spherical")
WORLD = "world"  # a massless root link of this name is the world itself


@dataclass(eq=False)
class Link:
    """A link, the joint to its parent (None: the root), and the joints to its children."""

    element: Element
    name: str
    joint: Joint | None = None
    joints: list[Joint] = field(default_factory=list)


@dataclass(eq=False)
class Joint:
    """A joint; ``kind`` is URDF's joint type."""

    element: Element
    name: str
    kind: str
    parent: Link
    child: Link

    @property
    def welds(self) -> bool:
        """Whether the joint leaves no motion free."""
        return self.kind == "fixed"


@dataclass(eq=False)
class Tree:
    """Links and joints in the order of the file."""

    links: dict[str, Link]
    joints: dict[str, Joint]
    root: Link

    @property
    def world(self) -> Link | None:
        """The root if it stands for the world: named ``world``, and without mass."""
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
        AssetError: a name is missing or repeated, a joint type or link is unknown, a link has two parent joints, links
            form a cycle, there is not exactly one root, or there are too many links.
    """
    links = _links(document)
    joints: dict[str, Joint] = {}
    for element in document.root.all("joint"):
        joint = _joint(document, element, links)
        if joint.name in joints:
            document.fail(element, f"there are two joints '{joint.name}'", "unique joint names")
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
            document.fail(element, f"there are two links '{name}'", "unique link names")
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
        document.fail(element, message, "one parent joint for each link: URDF has no loops")
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
        document.fail(document.root, "the joints form a cycle: every link is the child of a joint", "one root link")
    if len(roots) > 1:
        names = ", ".join(link.name for link in roots[:8]) + (", ..." if len(roots) > 8 else "")
        message = f"{len(roots)} links have no parent joint: {names}"
        document.fail(roots[1].element, message, "one root; join the other links to it by fixed or floating joints")
    return roots[0]


def _require_tree(document: Document, tree: Tree) -> None:
    reached = {link.name for link in tree.depth_first()}
    for link in tree.links.values():
        if link.name not in reached:
            message = f"link '{link.name}' is not reached from the root '{tree.root.name}': its joints form a cycle"
            document.fail(link.element, message, "a tree of links")


KEEP_ALL: dict[str, Any] = {"discardvisual": False, "fusestatic": False, "strippath": False}
SHAPES = {"box": ("size",), "sphere": ("radius",), "cylinder": ("radius", "length"), "capsule": ("radius", "length")}
DIGITS = 12  # digits of quaternions; more are rounding errors of sines and cosines


@dataclass(frozen=True, eq=False)
class Axis:
    """One MuJoCo joint, with damping and friction in SI units."""

    kind: DofKind
    axis: Vec3
    damping: float
    friction: float


@dataclass(frozen=True, eq=False)
class Placed:
    """A visual or collider: its XML, its pose in the link, and MuJoCo's ``size`` of a primitive."""

    element: Element
    collides: bool
    kind: str
    size: tuple[float, ...]
    pose: Pose


@dataclass(frozen=True, eq=False)
class Seen:
    """MuJoCo's reading of a link: pose in the parent, mass, frame of the inertia, axes, and shapes."""

    pose: Pose
    mass: float
    inertia_frame: Frame
    axes: tuple[Axis, ...]
    shapes: tuple[Placed, ...]


def read_with_mujoco(document: Document, tree: Tree) -> dict[str, Seen]:
    """Return MuJoCo's reading of each link, by the link's name.

    Raises:
        AssetError: a number is invalid, or MuJoCo refuses the file.
    """
    # Numbered names avoid MuJoCo's errors about reserved or repeated names.
    ids = {link.name: f"link_{number}" for number, link in enumerate(tree.links.values())}
    if tree.world is not None:
        ids[tree.world.name] = WORLD
    text = _plain(document, tree, ids).text()
    with refusals(document.source.name):
        spec = mujoco.MjSpec.from_string(text)
    return {name: _seen(spec.body(ids[name]), link) for name, link in tree.links.items()}


def _plain(document: Document, tree: Tree, ids: dict[str, str]) -> Xml:
    root = Xml("robot", {"name": "robot"})
    root.add("mujoco").add("compiler", **KEEP_ALL)
    for link in tree.links.values():
        root.children.append(_plain_link(document, link, ids[link.name]))
    for number, joint in enumerate(tree.joints.values()):
        root.children.append(_plain_joint(document, joint, number, ids))
    return root


def _plain_link(document: Document, link: Link, name: str) -> Xml:
    out = Xml("link", {"name": name})
    inertial = link.element.first("inertial")
    if inertial is not None:
        inner = out.add("inertial")
        _origin(document, inertial, inner, "inertial pos and quat")
        # MuJoCo gets a zero tensor, because it refuses or changes some valid ones. This package reads the tensor.
        inner.add("mass", value=_mass(document, inertial))
        inner.add("inertia", ixx=0.0, iyy=0.0, izz=0.0, ixy=0.0, ixz=0.0, iyz=0.0)
    for element in shapes_of(link):
        inner = out.add(element.tag)
        _origin(document, element, inner, "geom pos and quat")
        _geometry(document, element, inner.add("geometry"))
    return out


def shapes_of(link: Link) -> list[Element]:
    """Return a link's visuals and colliders in the order of the file."""
    return [child for child in link.element.children if child.tag in ("visual", "collision")]


def _mass(document: Document, inertial: Element) -> float:
    element = inertial.first("mass")
    value = document.number(element, "value", "inertial mass") if element else None
    if element is not None and value is not None and value < 0:
        document.fail(element, f"the mass is {value:g} kg", "a mass that is not negative")
    return value or 0.0


def _origin(document: Document, element: Element, out: Xml, became: str) -> None:
    origin = element.first("origin")
    if origin is None:
        return
    xyz = document.numbers(origin, "xyz", 3, became)
    rpy = document.numbers(origin, "rpy", 3, became)
    out.add("origin", xyz=xyz or (0.0, 0.0, 0.0), rpy=rpy or (0.0, 0.0, 0.0))


def primitive_of(element: Element) -> Element | None:
    """Return a visual's or collider's box, sphere, cylinder, or capsule; None for other shapes."""
    geometry = element.first("geometry")
    found = [child for child in geometry.children if child.tag in SHAPES] if geometry else []
    return found[0] if found else None


def _geometry(document: Document, element: Element, out: Xml) -> None:
    """Write a primitive; any other shape becomes a placeholder box."""
    shape = primitive_of(element)
    if shape is None:
        out.add("box", size=(1.0, 1.0, 1.0))
        return
    values: dict[str, Any] = {}
    for name in SHAPES[shape.tag]:
        numbers = document.numbers(shape, name, 3 if name == "size" else 1, "geom size")
        if numbers is None:
            document.fail(shape, f"<{shape.tag}> has no '{name}'", f'{name}="..."')
        values[name] = numbers
    out.add(shape.tag, **values)


def _plain_joint(document: Document, joint: Joint, number: int, ids: dict[str, str]) -> Xml:
    out = Xml("joint", {"name": f"joint_{number}", "type": joint.kind})
    out.add("parent", link=ids[joint.parent.name])
    out.add("child", link=ids[joint.child.name])
    _origin(document, joint.element, out, "body pos and quat")
    if joint.kind in ("fixed", "floating"):
        return out
    out.add("axis", xyz=_axis(document, joint))
    dynamics = joint.element.first("dynamics")
    if dynamics is not None:
        damping = _passive(document, dynamics, "damping", "damping")
        out.add("dynamics", damping=damping, friction=_passive(document, dynamics, "friction", "frictionloss"))
    return out


def _axis(document: Document, joint: Joint) -> tuple[float, ...]:
    element = joint.element.first("axis")
    axis = document.numbers(element, "xyz", 3, "joint axis") if element else None
    if axis is None:
        if joint.kind != "spherical":
            document.ledger.assume(joint.element.path, "no axis: X, as URDF says", "1 0 0")
        return 1.0, 0.0, 0.0
    if element is not None and not any(axis):
        document.fail(element, "the axis has no direction", "three numbers, not all zero")
    return axis


def _passive(document: Document, dynamics: Element, name: str, became: str) -> float:
    value = document.number(dynamics, name, became) or 0.0
    if value < 0:
        document.fail(dynamics, f"'{name}' is {value:g}", "a number that is not negative")
    return value


def _seen(body: Any, link: Link) -> Seen:
    shapes = [_placed(element, geom) for element, geom in zip(shapes_of(link), body.geoms, strict=True)]
    center = body.ipos if body.explicitinertial else (0.0, 0.0, 0.0)
    return Seen(
        pose=_pose(body.pos, body.quat),
        mass=float(body.mass),
        inertia_frame=Frame.of(_pose(center, body.iquat)),
        axes=tuple(_axis_of(joint) for joint in body.joints if int(joint.type) in JOINT_KINDS),
        shapes=tuple(shapes),
    )


def _placed(element: Element, geom: Any) -> Placed:
    shape = primitive_of(element)
    kind = shape.tag if shape is not None else ""
    count = {"box": 3, "sphere": 1, "cylinder": 2, "capsule": 2}.get(kind, 0)
    size = tuple(float(value) for value in geom.size[:count])
    return Placed(element, element.tag == "collision", kind, size, _pose(geom.pos, geom.quat))


JOINT_KINDS: dict[int, DofKind] = {
    int(mujoco.mjtJoint.mjJNT_HINGE): "hinge",
    int(mujoco.mjtJoint.mjJNT_SLIDE): "slide",
    int(mujoco.mjtJoint.mjJNT_BALL): "ball",
}


def _axis_of(joint: Any) -> Axis:
    x, y, z = (float(value) for value in joint.axis)
    damping = float(np.atleast_1d(joint.damping)[0])  # the first coefficient is the linear one
    return Axis(JOINT_KINDS[int(joint.type)], (x, y, z), damping, float(joint.frictionloss))


def _pose(position: Any, rotation: Any) -> Pose:
    x, y, z = (float(value) + 0.0 for value in position)
    sign = -1.0 if rotation[0] < 0 else 1.0
    w, i, j, k = (round(sign * float(value), DIGITS) + 0.0 for value in rotation)
    return Pose((x, y, z), (w, i, j, k))
