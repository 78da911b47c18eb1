"""Looks at a whole robot for colliders that are not there."""

from __future__ import annotations

from wheelleg_exp.asset.description import Body, RobotDescription
from wheelleg_exp.asset.usd.ledger import Ledger

FALLS = "no shape of the robot collides: it falls through any ground"


def note_colliders(robot: RobotDescription, ledger: Ledger) -> None:
    """Record a robot without colliders, loudly, and the ends of its limbs that have none.

    An end is what moves as one and carries nothing that moves in turn: a foot, a wheel, a hand.
    """
    if not robot.colliders:
        ledger.find("no_colliders", robot.name, "")
        ledger.warn(FALLS)
        return
    for group in _ends(robot):
        if not any(geom.collides for body in group for geom in body.geoms):
            mass = sum(body.inertial.mass for body in group)
            ledger.find("end_without_collider", group[0].name, group[0].path, mass=mass)


def _ends(robot: RobotDescription) -> list[list[Body]]:
    """Return the bodies that are welded together at the end of a limb, the moving one first."""
    top: dict[str, str] = {}
    groups: dict[str, list[Body]] = {}
    inner = set()
    for body in robot.bodies:
        welded = body.parent is not None and not body.dofs
        top[body.name] = top[body.parent] if body.parent is not None and welded else body.name
        groups.setdefault(top[body.name], []).append(body)
        if body.parent is not None and not welded:
            inner.add(top[body.parent])
    return [group for name, group in groups.items() if name not in inner and group[0].dofs]
