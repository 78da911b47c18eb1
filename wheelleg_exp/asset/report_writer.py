"""Make the conversion report of a robot; find missing colliders and implausible sizes."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import Any

import mujoco
import numpy as np

from wheelleg_exp.asset.conversion_report import DofOrder, Finding, Report
from wheelleg_exp.asset.robot_description import Body, RobotDescription
from wheelleg_exp.asset.robot_values import plain
from wheelleg_exp.asset.usd.ledger import Ledger

FALLS = "no shape of the robot collides: it falls through any ground"


def note_colliders(robot: RobotDescription, ledger: Ledger) -> None:
    """Warn if a robot has no colliders; record each end of a limb, such as a foot or a hand, without a collider.

    The end of a limb is a group of welded bodies without moving child bodies.
    """
    if not robot.colliders:
        ledger.find("no_colliders", robot.name, "")
        ledger.warn(FALLS)
        return
    # ``top`` maps each body to the first body of its group of welded bodies.
    top: dict[str, str] = {}
    groups: dict[str, list[Body]] = {}
    inner = set()
    for body in robot.bodies:
        welded = body.parent is not None and not body.dofs
        top[body.name] = top[body.parent] if body.parent is not None and welded else body.name
        groups.setdefault(top[body.name], []).append(body)
        if body.parent is not None and not welded:
            inner.add(top[body.parent])
    for name, group in groups.items():
        if name not in inner and group[0].dofs and not any(geom.collides for body in group for geom in body.geoms):
            mass = sum(body.inertial.mass for body in group)
            ledger.find("end_without_collider", group[0].name, group[0].path, mass=mass)


def measure_sizes(robot: RobotDescription, model: mujoco.MjModel) -> Iterator[Finding]:
    """Yield mass and size of each body tree with joints and colliders; a later step checks whether they are plausible.

    A robot's size is the longest edge of the bounding box of its colliders and joints, along the root body's axes.
    """
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    infinite = model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE.value
    solid = ((model.geom_contype | model.geom_conaffinity) != 0) & ~infinite
    moving = model.jnt_type != mujoco.mjtJoint.mjJNT_FREE.value
    for body in robot.children(None):
        root = model.body(body.name).id
        geoms = np.flatnonzero(solid & (model.body_rootid[model.geom_bodyid] == root))
        joints = np.flatnonzero(moving & (model.body_rootid[model.jnt_bodyid] == root))
        if not len(geoms) or not len(joints):
            continue
        # Along the root body's axes, a box with half edges e extends by abs(rotation matrix) @ e from its centre.
        axes, turns = data.xmat[root].reshape(3, 3), data.geom_xmat[geoms].reshape(-1, 3, 3)
        boxes = model.geom_aabb[geoms]
        centers = (data.geom_xpos[geoms] + np.einsum("gij,gj->gi", turns, boxes[:, :3])) @ axes
        halves = np.einsum("gij,gj->gi", np.abs(axes.T @ turns), boxes[:, 3:])
        size = np.ptp(np.vstack([centers - halves, centers + halves, data.xanchor[joints] @ axes]), axis=0).max()
        numbers = {"mass": float(model.body_subtreemass[root]), "size": float(size)}
        yield Finding("implausible_size", body.name, body.path, numbers)


def report_of(robot: RobotDescription, ledger: Ledger, **origin: Any) -> Report:
    """Return the conversion report of a robot that was read from a USD or URDF file.

    ``origin`` contains further fields of the conversion report, such as ``source`` and ``variants``.
    """
    note_colliders(robot, ledger)
    names: dict[str, str] = {}
    for path, name in [(b.path, b.name) for b in robot.bodies] + [(d.path, d.name) for d in robot.dofs]:
        names.setdefault(path, name)
    findings = tuple(
        item if item.kind.endswith("_not_found") else replace(item, subject=names.get(item.path, item.subject))
        for item in ledger.findings
    )
    mapped, assumed, left, warnings = ledger.entries()
    # Each root body of the robot floats, is fixed to the world, or is attached to the world by a joint.
    roots = list(robot.children(None))
    kinds = {"floating" if body.floating else "attached" if body.dofs else "fixed" for body in roots}
    return Report(
        **origin,
        model=robot.name,
        base=", ".join(sorted(kinds)),
        totals=totals(robot, findings),
        bodies={body.path: body.name for body in robot.bodies},
        joints={dof.name: dof.path for dof in robot.dofs},
        dof_order=DofOrder(robot.breadth_first_dofs, tuple(dof.name for dof in robot.dofs)),
        velocity_limits={dof.name: dof.max_velocity for dof in robot.dofs if dof.max_velocity is not None},
        mapped=mapped,
        assumptions=assumed,
        left_out=left,
        warnings=warnings,
        findings=findings,
        authored={path: {name: plain(v) for name, v in own.items()} for path, own in ledger.authored.items()},
    )


def totals(robot: RobotDescription, findings: Iterable[Finding]) -> dict[str, float]:
    """Count a robot's bodies, degrees of freedom, shapes, and actuators, and sum its masses in kg."""
    assumed = sum(item.numbers["mass"] for item in findings if item.kind == "no_inertial")
    return {
        "bodies": len(robot.bodies),
        "dofs": sum(3 if dof.kind == "ball" else 1 for dof in robot.dofs),
        "mass": round(robot.mass, 9),
        "assumed_mass": round(assumed, 9),
        "assumed_share": round(assumed / robot.mass, 6) if robot.mass > 0 else 0.0,
        "colliders": len(robot.colliders),
        "visuals": sum(not geom.collides for body in robot.bodies for geom in body.geoms),
        "actuators": len(robot.actuators) + sum(dof.drive is not None for dof in robot.dofs),
    }
