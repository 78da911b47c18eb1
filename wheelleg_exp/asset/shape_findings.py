"""Inspects a whole robot: missing colliders, implausible size."""

from __future__ import annotations

from collections.abc import Iterator

import mujoco
import numpy as np

from wheelleg_exp.asset.description import Body, RobotDescription
from wheelleg_exp.asset.findings import Finding
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


def measure_sizes(robot: RobotDescription, model: mujoco.MjModel) -> Iterator[Finding]:
    """Yield mass and size of each root with joints and colliders, in the form of ``implausible_size``.

    The size is the longest edge of the box around colliders and joints, along the axes of the root, at ``qpos0``.
    """
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    solid = ((model.geom_contype | model.geom_conaffinity) != 0) & (
        model.geom_type != mujoco.mjtGeom.mjGEOM_PLANE.value
    )
    moving = model.jnt_type != mujoco.mjtJoint.mjJNT_FREE.value
    for body in robot.children(None):
        root = model.body(body.name).id
        geoms = np.flatnonzero(solid & (model.body_rootid[model.geom_bodyid] == root))
        joints = np.flatnonzero(moving & (model.body_rootid[model.jnt_bodyid] == root))
        if not len(geoms) or not len(joints):
            continue
        axes, turns = data.xmat[root].reshape(3, 3), data.geom_xmat[geoms].reshape(-1, 3, 3)
        boxes = model.geom_aabb[geoms]
        centers = (data.geom_xpos[geoms] + np.einsum("gij,gj->gi", turns, boxes[:, :3])) @ axes
        halves = np.einsum("gij,gj->gi", np.abs(axes.T @ turns), boxes[:, 3:])
        size = np.ptp(np.vstack([centers - halves, centers + halves, data.xanchor[joints] @ axes]), axis=0).max()
        numbers = {"mass": float(model.body_subtreemass[root]), "size": float(size)}
        yield Finding("implausible_size", body.name, body.path, numbers)
