"""Gives a URDF to MuJoCo's own reader and takes its frames, axes and shapes from there.

MuJoCo sees the file without what it would read otherwise than URDF means it, or refuse, or complain about on the
terminal: names become numbers, meshes placeholders, and limits, inertia tensors and couplings stay in the XML, where
this package reads them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from wheelleg_exp.asset.description import DofKind, Pose, Vec3
from wheelleg_exp.asset.geometry import Frame
from wheelleg_exp.asset.mjcf.verify import refusals
from wheelleg_exp.asset.mjcf.xml import Element as Xml
from wheelleg_exp.asset.urdf.document import Document
from wheelleg_exp.asset.urdf.kinematics import WORLD, Joint, Link, Tree
from wheelleg_exp.asset.urdf.xml import Element

KEEP_ALL: dict[str, Any] = {"discardvisual": False, "fusestatic": False, "strippath": False}
SHAPES = {"box": ("size",), "sphere": ("radius",), "cylinder": ("radius", "length"), "capsule": ("radius", "length")}
DIGITS = 12  # of quaternions; the rest is the noise of sines and cosines


@dataclass(frozen=True, eq=False)
class Axis:
    """One joint of MuJoCo, with damping and friction in SI units."""

    kind: DofKind
    axis: Vec3
    damping: float
    friction: float


@dataclass(frozen=True, eq=False)
class Placed:
    """A visual or a collider: the XML, where it is in its link, and MuJoCo's ``size`` when it is a primitive."""

    element: Element
    collides: bool
    kind: str
    size: tuple[float, ...]
    pose: Pose


@dataclass(frozen=True, eq=False)
class Seen:
    """What MuJoCo reads of a link: pose in the parent, mass and the frame of the inertia, axes, shapes."""

    pose: Pose
    mass: float
    inertia_frame: Frame
    axes: tuple[Axis, ...]
    shapes: tuple[Placed, ...]


def read_with_mujoco(document: Document, tree: Tree) -> dict[str, Seen]:
    """Return MuJoCo's reading of each link, by the link's name.

    Raises:
        AssetError: a number is none, or MuJoCo refuses the file.
    """
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
    """Return a visual's or collider's box, sphere, cylinder or capsule; None when it is something else."""
    geometry = element.first("geometry")
    found = [child for child in geometry.children if child.tag in SHAPES] if geometry else []
    return found[0] if found else None


def _geometry(document: Document, element: Element, out: Xml) -> None:
    """Write a primitive; anything else becomes a box that nobody looks at."""
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
