"""Says which elements of a robot may share attributes."""

from __future__ import annotations

from collections.abc import Iterator

from wheelleg_exp.asset.description import Closure, Coupling, Geom, RobotDescription
from wheelleg_exp.asset.writer import attributes as of
from wheelleg_exp.asset.writer.attributes import GROUP_COLLIDER, GROUP_VISUAL, Attributes
from wheelleg_exp.asset.writer.classes import COLLISION, RESERVED, VISUAL, Classes, Family

COLLIDER_COLOR = (0.2, 0.6, 0.3, 0.4)
SHARED = frozenset({"group", "rgba", "friction", "condim", "solref", "solimp", "solmix", "margin", "gap", "priority"})
UNSEEN: Attributes = {"group": GROUP_VISUAL, "contype": 0, "conaffinity": 0, "mass": 0.0}
TOUCHED: Attributes = {"contype": 0, "conaffinity": 1}  # by the ground, and by nothing of the robot


def gather(robot: RobotDescription) -> Classes:
    """Return the default classes of a robot."""
    root = robot.name if robot.name not in RESERVED else f"{robot.name}_robot"
    classes = Classes(root)
    for name in (VISUAL, COLLISION):
        classes.child(name)
    for family in (*_geoms(robot), *_others(robot, root), *_actuators(robot, classes)):
        classes.add(family)
    return classes


def _geoms(robot: RobotDescription) -> Iterator[Family]:
    moving = [geom for body in robot.bodies for geom in body.geoms]
    drawn = [geom for geom in (*moving, *robot.static_geoms) if not geom.collides]
    solid = [geom for geom in moving if geom.collides]
    if drawn:
        yield _family(VISUAL, drawn, UNSEEN)
    if solid:
        fixed: Attributes = {"group": GROUP_COLLIDER, "rgba": COLLIDER_COLOR}
        yield _family(COLLISION, solid, fixed if robot.self_collision else {**fixed, **TOUCHED})


def _family(name: str, geoms: list[Geom], fixed: Attributes) -> Family:
    return Family("geom", {geom.name: of.geom(geom) for geom in geoms}, name, SHARED, fixed)


def _others(robot: RobotDescription, root: str) -> Iterator[Family]:
    sites = [*robot.static_sites, *(site for body in robot.bodies for site in body.sites)]
    yield Family("joint", {dof.name: of.joint(dof) for dof in robot.dofs}, root)
    yield Family("site", {site.name: of.site(site) for site in sites}, root)
    yield Family("tendon", {item.name: of.tendon(item) for item in robot.tendons}, root)
    constraints: list[Closure | Coupling] = [*robot.closures, *robot.couplings]
    equalities = {of.key(item): of.equality(item) for item in constraints}
    yield Family("equality", equalities, root)


def _actuators(robot: RobotDescription, classes: Classes) -> list[Family]:
    """Return the actuators by kind. MuJoCo keeps one default of all kinds in a class, so each kind has its own."""
    members: dict[str, dict[str, Attributes]] = {}
    for dof in robot.dofs:
        if dof.drive:
            members.setdefault(dof.drive.kind, {})[dof.name] = of.drive(dof.drive)
    if robot.actuators:
        members["general"] = {item.name: of.actuator(item) for item in robot.actuators}
    if len(members) > 1:
        for kind in members:
            classes.child(kind)
    return [Family(kind, items, kind if len(members) > 1 else classes.root) for kind, items in members.items()]
