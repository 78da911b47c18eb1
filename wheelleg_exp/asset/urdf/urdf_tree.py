"""Read links and joints of a URDF as a tree, and interpret frames, axes, and shapes like MuJoCo's URDF reader."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field

import mujoco
import numpy as np

from wheelleg_exp.asset.file_limits import MOST_BODIES, require_size
from wheelleg_exp.asset.rigid_geometry import Frame
from wheelleg_exp.asset.robot_description import DofKind, Pose, Vec3
from wheelleg_exp.asset.urdf.urdf_document import Document, Element
from wheelleg_exp.errors import nearest_name

KINDS = ("revolute", "continuous", "prismatic", "fixed", "floating", "planar", "spherical")
WORLD = "world"


@dataclass(eq=False)
class Link:
    """A link, the joint to its parent (None: the root), and the joints to its children."""

    element: Element
    name: str
    joint: Joint | None = None
    joints: list[Joint] = field(default_factory=list)


@dataclass(eq=False)
class Joint:
    """A URDF joint; ``kind`` is the joint's XML attribute ``type``, such as ``prismatic``."""

    element: Element
    name: str
    kind: str
    parent: Link
    child: Link

    @property
    def welds(self) -> bool:
        return self.kind == "fixed"


@dataclass(eq=False)
class Tree:
    """The links and joints of a URDF, in the order of the URDF."""

    links: dict[str, Link]
    joints: dict[str, Joint]
    root: Link

    @property
    def world(self) -> Link | None:
        """The root if it stands for the world: named ``world``, and without mass."""
        return self.root if self.root.name == WORLD and self.root.element.first("inertial") is None else None

    def depth_first(self) -> Iterator[Link]:
        stack = [self.root]
        while stack:
            link = stack.pop()
            yield link
            stack.extend(joint.child for joint in reversed(link.joints))


def read_tree(document: Document) -> Tree:
    """Return the tree of links."""
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
    joints: dict[str, Joint] = {}
    for element in document.root.all("joint"):
        name = document.required(element, "name", "joint name")
        kind = document.required(element, "type", "joint type")
        if kind not in KINDS:
            message, expected = f"there is no joint type '{kind}'", f"one of {', '.join(KINDS)}"
            document.fail(element, message, expected, nearest_name(kind, KINDS))
        parent, child = (_end(document, element, side, links) for side in ("parent", "child"))
        joint = Joint(element, name, kind, parent, child)
        if child.joint is not None:
            message = f"link '{child.name}' is the child of two joints, '{child.joint.name}' and '{name}'"
            document.fail(element, message, "one parent joint for each link: URDF has no loops")
        child.joint = joint
        parent.joints.append(joint)
        if joint.name in joints:
            document.fail(element, f"there are two joints '{joint.name}'", "unique joint names")
        joints[joint.name] = joint
    roots = [link for link in links.values() if link.joint is None]
    if not roots:
        document.fail(document.root, "the joints form a cycle: every link is the child of a joint", "one root link")
    if len(roots) > 1:
        names = ", ".join(link.name for link in roots[:8]) + (", ..." if len(roots) > 8 else "")
        message = f"{len(roots)} links have no parent joint: {names}"
        document.fail(roots[1].element, message, "one root; join the other links to it by fixed or floating joints")
    root = roots[0]
    tree = Tree(links, joints, root)
    reached = {link.name for link in tree.depth_first()}
    for link in tree.links.values():
        if link.name not in reached:
            message = f"link '{link.name}' is not reached from the root '{tree.root.name}': its joints form a cycle"
            document.fail(link.element, message, "a tree of links")
    return tree


def _end(document: Document, element: Element, side: str, links: dict[str, Link]) -> Link:
    end = element.first(side)
    if end is None:
        document.fail(element, f"<joint> has no <{side}>", f'<{side} link="..."/>')
    name = document.required(end, "link", "the body tree")
    if name not in links:
        document.fail(end, f"there is no link '{name}'", "the name of a <link>", nearest_name(name, links))
    return links[name]


SHAPES = {"box": ("size",), "sphere": ("radius",), "cylinder": ("radius", "length"), "capsule": ("radius", "length")}
DIGITS = 12  # digits of quaternions


@dataclass(frozen=True, eq=False)
class Axis:
    """One of the MuJoCo joints that replace a URDF joint, with damping and friction in SI units."""

    kind: DofKind
    axis: Vec3
    damping: float
    friction: float


@dataclass(frozen=True, eq=False)
class Placed:
    """A visual or collider: its XML, its pose in the link, and MuJoCo's ``kind`` and ``size`` if it is a primitive."""

    element: Element
    collides: bool
    kind: str
    size: tuple[float, ...]
    pose: Pose


@dataclass(frozen=True, eq=False)
class Seen:
    """The numbers of a link: its pose in the parent, mass, frame of the inertia, axes of its joint, and shapes."""

    pose: Pose
    mass: float
    inertia_frame: Frame
    axes: tuple[Axis, ...]
    shapes: tuple[Placed, ...]


def read_link(document: Document, link: Link) -> Seen:
    """Return the pose, mass, joint axes, and shapes of a link."""
    shapes = [child for child in link.element.children if child.tag in ("visual", "collision")]
    joint, inertial = link.joint, link.element.first("inertial")
    return Seen(
        pose=_origin(document, joint.element, "body pos and quat") if joint else Pose(),
        mass=_positive(document, inertial.first("mass"), "value", "inertial mass") if inertial else 0.0,
        inertia_frame=Frame.of(_origin(document, inertial, "inertial pos and quat") if inertial else Pose()),
        axes=_axes(document, joint) if joint else (),
        shapes=tuple(_placed(document, element) for element in shapes),
    )


def _origin(document: Document, element: Element, became: str) -> Pose:
    """Return the pose of a URDF ``<origin>``; ``rpy`` rotates about the fixed axes x, y, and z, in this order."""
    origin = element.first("origin")
    if origin is None:
        return Pose()
    x, y, z = document.numbers(origin, "xyz", 3, became) or (0.0, 0.0, 0.0)
    angles = document.numbers(origin, "rpy", 3, became) or (0.0, 0.0, 0.0)
    if max(map(abs, angles)) > math.tau:
        written = " ".join(f"{angle:g}" for angle in angles)
        document.ledger.warn(f"{origin.path}: rpy '{written}' is more than a turn: URDF has radians, not degrees")
    quat = np.zeros(4)
    mujoco.mju_euler2Quat(quat, angles, "XYZ")
    sign = -1.0 if quat[0] < 0 else 1.0
    w, i, j, k = (round(sign * value, DIGITS) + 0.0 for value in quat.tolist())
    return Pose((x + 0.0, y + 0.0, z + 0.0), (w, i, j, k))


def _positive(document: Document, element: Element | None, name: str, became: str) -> float:
    value = (document.number(element, name, became) if element else None) or 0.0
    if element is not None and value < 0:
        document.fail(element, f"'{name}' is {value:g}", "a number that is not negative")
    return value


def _placed(document: Document, element: Element) -> Placed:
    pose, geometry = _origin(document, element, "geom pos and quat"), element.first("geometry")
    shape = next((child for child in geometry.children if child.tag in SHAPES), None) if geometry else None
    collides, size = element.tag == "collision", list[float]()
    if shape is None:
        return Placed(element, collides, "", (), pose)
    for name in SHAPES[shape.tag]:
        numbers = document.numbers(shape, name, 3 if name == "size" else 1, "geom size")
        if numbers is None:
            document.fail(shape, f"<{shape.tag}> has no '{name}'", f'{name}="..."')
        size += numbers if name == "radius" else [value / 2 for value in numbers]
    return Placed(element, collides, shape.tag, tuple(size), pose)


def _axes(document: Document, joint: Joint) -> tuple[Axis, ...]:
    if joint.kind in ("fixed", "floating"):
        return ()
    axis, dynamics = _axis(document, joint), joint.element.first("dynamics")
    damping = _positive(document, dynamics, "damping", "damping")
    friction = _positive(document, dynamics, "friction", "frictionloss")
    kinds: list[tuple[DofKind, Vec3]] = [("hinge", axis)]
    if joint.kind == "prismatic":
        kinds = [("slide", axis)]
    elif joint.kind == "spherical":
        kinds = [("ball", (0.0, 0.0, 1.0))]
    elif joint.kind == "planar":
        # A planar joint slides along x and y, both turned by the shortest rotation from z to the joint's axis.
        quat, turn = np.zeros(4), np.zeros(9)
        mujoco.mju_quatZ2Vec(quat, np.array(axis))
        mujoco.mju_quat2Mat(turn, quat)
        along = [(float(x), float(y), float(z)) for x, y, z in turn.reshape(3, 3).T[:2]]
        kinds = [("slide", along[0]), ("slide", along[1]), ("hinge", axis)]
    return tuple(Axis(kind, direction, damping, friction) for kind, direction in kinds)


def _axis(document: Document, joint: Joint) -> Vec3:
    element = joint.element.first("axis")
    axis = document.numbers(element, "xyz", 3, "joint axis") if element else None
    if axis is None:
        if joint.kind != "spherical":
            document.ledger.assume(joint.element.path, "no axis: X, as URDF says", "1 0 0")
        return 1.0, 0.0, 0.0
    if element is not None and not any(axis):
        document.fail(element, "the axis has no direction", "three numbers, not all zero")
    x, y, z = axis
    return x, y, z
