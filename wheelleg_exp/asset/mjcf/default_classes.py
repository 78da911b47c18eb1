"""Collect shared attributes of MJCF elements into default classes, so that each number appears once in the MJCF.

The robot's class has the attributes that all elements of one type share, and child classes have those of some. A child
is named after the role ``wheel`` or ``leg``, or after words that its elements' names share: ``hip`` for ``FL_hip`` and
``FR_hip``. A wheel is the last hinge of a limb, without limits, and moves a round shape; joints above it are legs.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

import numpy as np

from wheelleg_exp.asset.mjcf import mjcf_elements as of
from wheelleg_exp.asset.mjcf.mjcf_elements import GROUP_COLLIDER, GROUP_VISUAL, Attributes, Element, value_text
from wheelleg_exp.asset.rigid_geometry import Frame
from wheelleg_exp.asset.robot_description import Body, Closure, Coupling, Dof, Geom, Mesh, RobotDescription

WHEEL, LEG = "wheel", "leg"
ROUND = 0.1  # of the wheel's radius


def roles_of(robot: RobotDescription) -> dict[str, str]:
    """Return the role ``wheel`` or ``leg`` of each joint, actuator, and shape that has a role, by name."""
    meshes = {mesh.name: mesh for mesh in robot.meshes}
    bodies = {body.name: body for body in robot.bodies}
    movers, groups = dict[str, str](), dict[str, list[Body]]()
    for body in robot.bodies:
        mover = body.name if body.parent is None or body.dofs else movers[body.parent]
        movers[body.name] = mover
        groups.setdefault(mover, []).append(body)
    carriers = {movers[body.parent] for body in robot.bodies if body.parent is not None and body.dofs}
    wheels = [name for name in groups if name not in carriers and _is_wheel(groups[name], meshes)]
    kinds = dict.fromkeys(wheels, WHEEL)
    # A wheel's leg consists of the joints between this wheel and the robot's trunk.
    for name in wheels:
        parent = bodies[name].parent
        while parent is not None:
            if bodies[movers[parent]].dofs:
                kinds.setdefault(movers[parent], LEG)
            parent = bodies[movers[parent]].parent
    found: dict[str, str] = {}
    for name, kind in kinds.items():
        found |= {dof.name: kind for dof in bodies[name].dofs}
        found |= {geom.name: kind for body in groups[name] for geom in body.geoms}
    return found | {item.name: found[item.target] for item in robot.actuators if item.target in found}


def _is_wheel(group: list[Body], meshes: dict[str, Mesh]) -> bool:
    dofs = group[0].dofs
    if len(dofs) != 1 or dofs[0].kind != "hinge" or dofs[0].range is not None:
        return False
    frames: dict[str | None, Frame] = {group[0].name: Frame.identity()}
    for body in group[1:]:
        frames[body.name] = frames[body.parent] @ Frame.of(body.pose)
    shapes = [(body, geom) for body in group for geom in body.geoms]
    solid = [(body, geom) for body, geom in shapes if geom.collides] or shapes
    return any(_is_round(dofs[0], frames[body.name], geom, meshes) for body, geom in solid)


def _is_round(dof: Dof, inside: Frame, geom: Geom, meshes: dict[str, Mesh]) -> bool:
    """Return whether a shape is round about the joint's axis: equally wide across the axis, and centred on it."""
    frame = inside @ Frame.of(geom.pose)
    axis = np.asarray(dof.axis) / np.linalg.norm(dof.axis)
    along = frame.rotation.T @ axis
    if geom.kind == "sphere":
        middle, radius = np.zeros(3), geom.size[0]
    elif geom.kind in ("cylinder", "capsule"):
        middle, radius = np.zeros(3), geom.size[0] if abs(along[2]) > 0.99 else 0.0
    elif geom.kind != "mesh" or geom.mesh is None:
        middle, radius = np.zeros(3), 0.0
    else:
        points = meshes[geom.mesh].vertices
        middle = (points.min(axis=0) + points.max(axis=0)) / 2
        across = points - middle - np.outer((points - middle) @ along, along)
        first = np.linalg.svd(along[None])[2][1:]  # perpendicular to ``along``
        # A mesh counts as round if its extents in eight directions perpendicular to the joint's axis are nearly equal.
        reach = [
            float(np.abs(across @ (np.cos(angle) * first[0] + np.sin(angle) * first[1])).max())
            for angle in np.linspace(0, np.pi, 8, endpoint=False)
        ]
        radius = max(reach) if min(reach) >= (1 - ROUND) * max(reach) else 0.0
    offset = frame.rotation @ middle + frame.translation - np.asarray(dof.anchor)
    return radius > 0 and float(np.linalg.norm(offset - (offset @ axis) * axis)) <= ROUND * radius


VISUAL, COLLISION = "visual", "collision"
ACTUATORS = {"position", "velocity", "motor", "general"}
RESERVED = {"main", VISUAL, COLLISION, *ACTUATORS}
EMPTY_WORDS = {"joint", "actuator", "act", "geom", "site", "link", VISUAL, COLLISION}


@dataclass
class Family:
    """The MJCF elements of one tag; only attributes in ``grouping`` (None: all) move to a class of several elements."""

    tag: str
    members: Mapping[str, Attributes]
    parent: str
    grouping: frozenset[str] | None = None
    fixed: Attributes = field(default_factory=dict)


class Classes:
    """The default classes of an MJCF; ``roles`` maps names of joints, actuators, and shapes to ``wheel`` or ``leg``."""

    def __init__(self, root: str, roles: Mapping[str, str]) -> None:
        self.root, self.roles = root, roles
        self._content: dict[str, dict[str, Attributes]] = {root: {}}
        self._parents: dict[str, str] = {}
        self._of: dict[tuple[str, str], str] = {}
        self._rest: dict[tuple[str, str], Attributes] = {}

    def child(self, name: str) -> None:
        """Add an empty MJCF default class as a child of the robot's default class."""
        self._content.setdefault(name, {})
        self._parents[name] = self.root

    def add(self, family: Family) -> None:
        """Move the attributes that several MJCF elements of one type share into default classes."""
        first, *others = [*family.members.values()] or [{}]
        common = {k: v for k, v in first.items() if all(k in o and value_text(o[k]) == value_text(v) for o in others)}
        shared = {**family.fixed, **_without(common if others else {}, family.fixed)}
        if shared:
            self._content[family.parent][family.tag] = shared
        rests = {name: _without(own, shared) for name, own in family.members.items()}
        for name, rest in rests.items():
            self._of[family.tag, name], self._rest[family.tag, name] = family.parent, rest
        # MJCF elements with equal attributes share a default class, so that the MJCF file does not repeat numbers.
        groups: dict[tuple[tuple[str, str], ...], list[str]] = {}
        keys = family.grouping
        movable = {n: {k: v for k, v in rest.items() if keys is None or k in keys} for n, rest in rests.items()}
        for name, own in movable.items():
            groups.setdefault(tuple(sorted((key, value_text(value)) for key, value in own.items())), []).append(name)
        for names in groups.values():
            if len(names) > 1 and movable[names[0]]:
                self._group(family, names, movable[names[0]])

    def of(self, tag: str, name: str) -> str | None:
        """Return an MJCF element's attribute ``class``; None if the ``childclass`` of the element's body suffices."""
        found = self._of.get((tag, name))
        return None if found is None or found == self.root or not self._needed(found) else found

    def explicit(self, tag: str, name: str) -> str | None:
        """Return an element's class outside of bodies: the robot's class only if it has attributes of ``tag``."""
        found = self._of.get((tag, name))
        return self.of(tag, name) if found != self.root else self.root if tag in self._content[self.root] else None

    def rest(self, tag: str, name: str) -> Attributes:
        """Return the attributes of an MJCF element that the element's default class does not give."""
        return self._rest[tag, name]

    def inherited(self) -> bool:
        """Return whether the MJCF default class with the robot's name contains attributes of joints or sites."""
        return any(self._content[self.root].get(tag) for tag in ("joint", "site"))

    def element(self) -> Element:
        out = Element("default")
        made = {self.root: Element("default", {"class": self.root})}
        for name, tags in self._content.items():
            element = made.setdefault(name, Element("default", {"class": name}))
            for tag, shared in tags.items():
                element.add(tag, shared)
        for name, parent in self._parents.items():
            if self._needed(name):
                made[parent].children.append(made[name])
        if made[self.root].children:
            out.children.append(made[self.root])
        return out

    def common(self, names: Iterable[str]) -> str:
        """Return what elements have in common: the wheel role, or common words of their names, or the leg role."""
        names = list(names)
        found = {self.roles.get(name, "") for name in names}
        role = found.pop() if len(found) == 1 else ""
        if role == WHEEL:
            return role
        split = [re.findall(r"[A-Za-z]+|\d+", name) for name in names]
        shared = [word for word in split[0] if all(word in words for words in split[1:])]
        words = [word for word in dict.fromkeys(shared) if not word.isdigit()]
        return "_".join(word for word in words if word.lower() not in EMPTY_WORDS) or role

    def _needed(self, name: str) -> bool:
        return bool(self._content[name]) or any(parent == name for parent in self._parents.values())

    def _group(self, family: Family, names: list[str], shared: Attributes) -> None:
        # One default class can contain attributes of several element types, such as joints and geoms.
        stem = self.common(names)
        # Class names must be unique in the whole MJCF file, so a child class's name includes its parent class's name.
        if family.parent == self.root:
            stem = stem or ("actuators" if family.tag in ACTUATORS else f"{family.tag}s")
        else:
            stem = f"{stem}_{family.parent}" if stem else family.parent
        name, number = stem, 2
        while name in RESERVED or name == self.root or self._taken(name, family):
            name, number = f"{stem}_{number}", number + 1
        self._content.setdefault(name, {})[family.tag] = shared
        self._parents[name] = family.parent
        for member in names:
            self._of[family.tag, member] = name
            self._rest[family.tag, member] = _without(self._rest[family.tag, member], shared)

    def _taken(self, name: str, family: Family) -> bool:
        return name in self._content and (family.tag in self._content[name] or self._parents.get(name) != family.parent)


def _without(own: Attributes, shared: Attributes) -> Attributes:
    return {k: v for k, v in own.items() if k not in shared or value_text(shared[k]) != value_text(v)}


COLLIDER_COLOR = (0.2, 0.6, 0.3, 0.4)
SHARED = frozenset({"group", "rgba", "friction", "condim", "solref", "solimp", "solmix", "margin", "gap", "priority"})
UNSEEN: Attributes = {"group": GROUP_VISUAL, "contype": 0, "conaffinity": 0, "mass": 0.0}
TOUCHED: Attributes = {"contype": 0, "conaffinity": 1}


def gather(robot: RobotDescription) -> Classes:
    """Return the MJCF default classes of a robot."""
    root = robot.name if robot.name not in RESERVED else f"{robot.name}_robot"
    classes = Classes(root, roles_of(robot))
    for name in (VISUAL, COLLISION):
        classes.child(name)
    moving = [geom for body in robot.bodies for geom in body.geoms]
    drawn = {geom.name: of.geom(geom) for geom in (*moving, *robot.static_geoms) if not geom.collides}
    solid = {geom.name: of.geom(geom) for geom in moving if geom.collides}
    fixed: Attributes = {"group": GROUP_COLLIDER, "rgba": COLLIDER_COLOR, **({} if robot.self_collision else TOUCHED)}
    families = [Family("geom", drawn, VISUAL, SHARED, UNSEEN)] if drawn else []
    families += [Family("geom", solid, COLLISION, SHARED, fixed)] if solid else []
    families.append(Family("joint", {dof.name: of.joint(dof) for dof in robot.dofs}, root))
    families.append(Family("site", {site.name: dict(site.extra) for site in robot.sites}, root))
    families.append(Family("tendon", {item.name: of.tendon(item) for item in robot.tendons}, root))
    constraints: list[Closure | Coupling] = [*robot.closures, *robot.couplings]
    families.append(Family("equality", {of.key(item): of.equality(item) for item in constraints}, root))
    for family in (*families, *_actuators(robot, classes)):
        classes.add(family)
    return classes


def _actuators(robot: RobotDescription, classes: Classes) -> list[Family]:
    """Return the actuators by type. An MJCF default class can contain only one type of actuator."""
    members: dict[str, dict[str, Attributes]] = {}
    for dof in robot.dofs:
        if dof.drive:
            members.setdefault(dof.drive.kind, {})[dof.name] = of.drive(dof.drive)
    if robot.actuators:
        members["general"] = {item.name: of.actuator(item) for item in robot.actuators}
    if len(members) == 1:
        return [Family(kind, items, classes.root) for kind, items in members.items()]
    names = {kind: classes.common(items) for kind, items in members.items()}
    named = all(names.values()) and len(set(names.values())) == len(names) and not set(names.values()) & RESERVED
    parents = {kind: names[kind] if named and classes.root not in names.values() else kind for kind in members}
    for parent in parents.values():
        classes.child(parent)
    return [Family(kind, items, parents[kind]) for kind, items in members.items()]
