"""Read a URDF file into a robot description and a conversion report."""

from __future__ import annotations

import math
from collections.abc import Iterator
from operator import attrgetter
from pathlib import Path

import numpy as np

from wheelleg_exp.asset import robot_description as desc
from wheelleg_exp.asset.conversion_report import Report, is_placeholder
from wheelleg_exp.asset.report_writer import report_of
from wheelleg_exp.asset.rigid_geometry import Frame
from wheelleg_exp.asset.urdf.mesh_files import Files
from wheelleg_exp.asset.urdf.urdf_document import Document, Element, audit, open_document
from wheelleg_exp.asset.urdf.urdf_inertia import inertials
from wheelleg_exp.asset.urdf.urdf_shapes import Shapes
from wheelleg_exp.asset.urdf.urdf_tree import WORLD, Joint, Link, Seen, Tree, read_link, read_tree
from wheelleg_exp.asset.usd.usd_stage import HUGE, effort_limit, endless
from wheelleg_exp.errors import nearest_name

FAR = 1e6  # rad or m
_SURELY_DEGREES = 12.6  # No leg joint turns by more than two whole turns.
UNIT_LENGTH = 1e-6  # allowed error of lengths
# A planar URDF joint becomes two slides and one hinge of MuJoCo, whose names end with the suffixes in ``PLANAR``.
PLANAR = ("_transX", "_transY", "_rotZ")

Range = tuple[float, float]


def dofs_of(document: Document, joint: Joint, seen: Seen) -> tuple[desc.Dof, ...]:
    """Return the degrees of freedom of a joint; an empty tuple for a fixed or floating joint."""
    axes = seen.axes if joint.kind != "floating" else ()
    made = f"joint {joint.name} ({', '.join(axis.kind for axis in axes)})" if axes else "a weld to the parent body"
    document.ledger.mapped(joint.element.path, "joint", "freejoint" if joint.kind == "floating" else made)
    suffixes = PLANAR if joint.kind == "planar" else ("",)
    if not axes:
        return ()
    reach = effort = velocity = None
    if joint.kind not in ("planar", "spherical"):  # The audit reports the limits of planar and spherical joints.
        element = joint.element.first("limit")
        reach = _range(document, joint, element)
        if element is not None:
            effort, velocity = _effort(document, joint, element), _velocity(document, joint, element)
    return tuple(
        desc.Dof(
            name=joint.name + suffix,
            path=joint.element.path,
            kind=axis.kind,
            axis=_direction(document, joint, axis.axis),
            anchor=(0.0, 0.0, 0.0),
            range=reach,
            damping=axis.damping,
            frictionloss=axis.friction,
            max_velocity=velocity,
            force_range=effort,
        )
        for axis, suffix in zip(axes, suffixes, strict=True)
    )


def _direction(document: Document, joint: Joint, axis: desc.Vec3) -> desc.Vec3:
    length = float(np.linalg.norm(axis))
    if abs(length - 1.0) < UNIT_LENGTH:
        return axis
    document.ledger.assume(joint.element.path, "the axis is not of unit length: its direction", f"length {length:.6g}")
    x, y, z = (value / length for value in axis)
    return x, y, z


def _range(document: Document, joint: Joint, element: Element | None) -> Range | None:
    ledger, path, angular = document.ledger, joint.element.path, joint.kind == "revolute"
    if joint.kind == "continuous":
        if element is not None and {"lower", "upper"} <= set(element.attributes):
            ends = [_written(document, joint, element, side, None) for side in ("lower", "upper")]
            limits = [end for end in ends if end is not None]
            if len(limits) == 2 and limits[0] < limits[1] and not endless(math.degrees(limits[0]), True):
                ledger.find("limits_ignored", joint.name, path, lower=limits[0], upper=limits[1])
                text = "a continuous joint has no limits; the written limits {:g} to {:g} do not count".format(*limits)
                ledger.warn(f"{path}: {text}")
        return None
    found = [_written(document, joint, element, side, "range") for side in ("lower", "upper")]
    low, high = (0.0 if value is None else value for value in found)
    if low >= high:
        written = {side: value for side, value in zip(("lower", "upper"), found, strict=True) if value is not None}
        ledger.find("no_limits", joint.name, path, **written)
    if low == high:
        what = f"limits {low:g} to {high:g}" if element else "no <limit>"
        ledger.assume(path, "lower and upper limit are equal, or not given: no limits", what)
        ledger.warn(f"{path}: {what} means no limits here; other simulators lock such a joint")
        return None
    if low > high:
        ledger.assume(path, "the lower limit is above the upper one: no limits", f"{low:g} to {high:g}")
        ledger.warn(f"{path}: limits {low:g} to {high:g} are the wrong way round and were ignored")
        return None
    if None in found:
        ledger.assume(path, "only one limit is given: the other is 0, URDF's default", f"{low:g} to {high:g}")
    if angular and _SURELY_DEGREES < max(-low, high) <= 360:
        ledger.warn(f"{path}: limits {low:g} to {high:g} are {high - low:g} rad apart: URDF has radians, not degrees")
    # A hinge with one huge limit has no limits, because URDF exporters write huge numbers for missing limits.
    no_low, no_high = (endless(math.degrees(value) if angular else value, angular) for value in (low, high))
    if (no_low or no_high) if angular else (no_low and no_high):
        ledger.assume(path, "limits are infinite or huge: no limits", f"{low:g} to {high:g}")
        return None
    return (-FAR if no_low else low, FAR if no_high else high)


def _written(document: Document, joint: Joint, element: Element | None, name: str, became: str | None) -> float | None:
    value = None if element is None else document.number(element, name, became, endless=True)
    if value is not None:
        document.ledger.authored.setdefault(joint.element.path, {})[name] = value
    return value


def _effort(document: Document, joint: Joint, element: Element) -> Range | None:
    value = _written(document, joint, element, "effort", "joint actuatorfrcrange")
    if value is not None and math.isfinite(value) and is_placeholder(value):
        document.ledger.find("placeholder_effort", joint.name, joint.element.path, value=value)
    limit = effort_limit(None if value is None else abs(value))
    if limit is None and value is not None:
        document.ledger.leave(element.path, "effort", "zero, infinite or huge, which means not given", value)
    return None if limit is None else (-limit, limit)


def _velocity(document: Document, joint: Joint, element: Element) -> float | None:
    value = _written(document, joint, element, "velocity", "velocity_limits")
    if value is None:
        return None
    if math.isfinite(value) and is_placeholder(value):
        document.ledger.find("placeholder_velocity", joint.name, joint.element.path, value=value)
    limit = abs(value)
    if limit == 0 or limit >= HUGE:
        document.ledger.leave(element.path, "velocity", "zero, infinite or huge, which means not given", value)
        return None
    unit = "m/s" if joint.kind == "prismatic" else "rad/s"
    reason = f"MuJoCo has no velocity limit; see the report's velocity_limits in {unit}"
    document.ledger.leave(element.path, "velocity", reason, f"{limit:g} {unit}")
    return limit


def couplings(document: Document, tree: Tree, dofs: dict[str, desc.Dof]) -> Iterator[desc.Coupling]:
    """Yield the couplings of ``<mimic>``, q = offset + multiplier · r; ``dofs`` are the joints with one axis."""
    for joint in tree.joints.values():
        element = joint.element.first("mimic")
        if element is None:
            continue
        leader = document.required(element, "joint", "equality joint")
        multiplier = document.number(element, "multiplier", "equality joint polycoef")
        offset = document.number(element, "offset", "equality joint polycoef")
        if joint.name not in dofs or leader not in dofs or leader == joint.name:
            reason = "only a hinge or slide can follow another one"
            if leader not in tree.joints:
                nearest = nearest_name(leader, tree.joints)
                reason = f"there is no joint '{leader}'" + (f"; was '{nearest}' meant?" if nearest else "")
            document.ledger.leave_and_warn(element.path, "joint", reason, "the coupling", leader)
            continue
        numbers = (offset or 0.0, 1.0 if multiplier is None else multiplier, 0.0, 0.0, 0.0)
        yield desc.Coupling(f"{joint.name}_coupling", element.path, dofs[joint.name].name, dofs[leader].name, numbers)


SUFFIXES = (".urdf",)
EARTH = 9.81
SI = {"metersPerUnit": 1.0, "kilogramsPerUnit": 1.0, "upAxis": "Z"}  # A URDF always uses SI units.


def read_urdf(source: Path, base: desc.BaseMode) -> tuple[desc.RobotDescription, Report]:
    """Read a URDF file into a robot description and a conversion report."""
    document = open_document(source)
    robot, files = _Builder(document, base).build()
    report = report_of(
        robot,
        document.ledger,
        source=document.source.name,
        root=document.root.path,
        stage=dict(SI),
        variants={},
        unresolved=tuple(files.missing),
        layers=dict(sorted(files.hashes.items())),
    )
    return robot, report


def source_files(source: Path) -> dict[str, str]:
    """Return the sha256 of a URDF file and of each mesh file that the URDF names, by relative path."""
    document = open_document(source)
    files = Files(document)
    for element in document.root.walk():
        if element.tag == "mesh" and (name := element.attributes.get("filename")):
            files.find(name)
    return dict(sorted(files.hashes.items()))


class _Builder:
    """The robot description of a URDF, built step by step; each link except the world link becomes a body."""

    def __init__(self, document: Document, base: desc.BaseMode) -> None:
        self.document, self.base = document, base
        self.tree: Tree = read_tree(document)
        self.seen: dict[str, Seen] = {name: read_link(document, link) for name, link in self.tree.links.items()}
        self.files = Files(document)
        self.shapes = Shapes(document, self.tree, self.seen, self.files)
        self.names = {name: name for name in self.tree.links}
        if WORLD in self.names and self.tree.world is None:
            free = f"{WORLD}_link"
            while free in self.names:
                free += "_"
            self.names[WORLD] = free
            document.ledger.assume(self.tree.links[WORLD].element.path, f"MuJoCo keeps the name '{WORLD}'", free)
        joints = self.tree.joints.values()
        self.dofs = {joint.name: dofs_of(document, joint, self.seen[joint.child.name]) for joint in joints}

    def build(self) -> tuple[desc.RobotDescription, Files]:
        tree, document = self.tree, self.document
        masses = inertials(document, tree, self.seen, self.shapes.solids, self.base)
        # A URDF link named world becomes MuJoCo's world body, and its shapes become static geoms.
        links = [link for link in tree.depth_first() if link is not tree.world]
        if not links:
            document.fail(tree.root.element, "the file contains only the world", "a robot")
        # Sort the bodies by body tree, because a link on a floating URDF joint is the root of a separate body tree.
        bodies = [self._body(link, masses[link.name]) for link in links]
        single = {name: dofs[0] for name, dofs in self.dofs.items() if len(dofs) == 1 and dofs[0].kind != "ball"}
        joints = list(tree.root.joints)
        for joint in joints:  # breadth first
            joints += joint.child.joints
        joined = [j for j in tree.joints.values() if j.parent is not tree.world and j.kind != "floating"]
        robot = desc.RobotDescription(
            name=document.root.attributes.get("name") or document.source.stem,
            bodies=desc.depth_first(bodies, attrgetter("name"), attrgetter("parent")),
            gravity=(0.0, 0.0, -EARTH),
            static_geoms=self.shapes.geoms[tree.world.name] if tree.world else (),
            exclusions=tuple((self.names[j.parent.name], self.names[j.child.name]) for j in joined),
            couplings=tuple(couplings(document, tree, single)),
            materials=tuple(self.shapes.looks.used.values()),
            meshes=tuple(self.shapes.meshes.values()),
            breadth_first_dofs=tuple(dof.name for joint in joints for dof in self.dofs[joint.name]),
        )
        document.ledger.assume(document.source.name, "a URDF has no gravity", f"{EARTH} m/s² downwards")
        document.ledger.mapped(document.root.path, "name", "model name")
        audit(document, document.root)
        for name in self.files.missing:
            document.ledger.warn(f"not found, read without it: {name}")
            shapes = [placed for seen in self.seen.values() for placed in seen.shapes]
            using = [p.collides for p in shapes if any(e.attributes.get("filename") == name for e in p.element.walk())]
            counts = {"colliders": sum(using), "visuals": len(using) - sum(using)}
            document.ledger.find("mesh_not_found", name, document.source.name, **counts)
        return robot, self.files

    # ------------------------------------------------------------ bodies
    def _body(self, link: Link, inertial: desc.Inertial) -> desc.Body:
        joint, path = link.joint, link.element.path
        self.document.ledger.mapped(path, "link", f"body {self.names[link.name]}")
        floating = self._floats(link)
        inside = joint is not None and joint.parent is not self.tree.world and not floating
        return desc.Body(
            name=self.names[link.name],
            path=path,
            parent=self.names[joint.parent.name] if joint and inside else None,
            pose=self._world_pose(link) if floating else self.seen[link.name].pose,
            inertial=inertial,
            floating=floating,
            dofs=self.dofs[joint.name] if joint else (),
            geoms=self.shapes.geoms[link.name],
        )

    def _floats(self, link: Link) -> bool:
        """Return whether a link moves freely: by a floating joint, or as the root of a robot that is not fixed."""
        joint, ledger = link.joint, self.document.ledger
        if joint is None:
            if self.base == "auto":
                rule = "a URDF does not define its base: floating as in Gazebo and PyBullet; --base fixed fixes it"
                ledger.assume(link.element.path, rule, "floating")
            elif self.base == "fixed":
                ledger.assume(link.element.path, "--base fixed", "no free joint")
            return self.base != "fixed"
        to_world = joint.parent is self.tree.world
        if to_world and joint.welds and self.base == "floating":
            ledger.leave(joint.element.path, "joint", "--base floating drops the joint to the world")
            return True
        if to_world and joint.kind == "floating" and self.base == "fixed":
            ledger.leave(joint.element.path, "joint", "--base fixed removes the free joint")
            return False
        return joint.kind == "floating"

    def _world_pose(self, link: Link) -> desc.Pose:
        chain = [link]
        while chain[-1].joint is not None:
            chain.append(chain[-1].joint.parent)
        if len(chain) == 1:
            return self.seen[link.name].pose
        frame = Frame.identity()
        for item in reversed(chain):
            frame = frame @ Frame.of(self.seen[item.name].pose)
        return frame.pose()
