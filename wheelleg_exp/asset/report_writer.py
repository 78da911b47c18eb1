"""Make a robot's conversion report, with its numbers as JSON; find missing colliders and implausible sizes."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from typing import Any

import mujoco
import numpy as np

from wheelleg_exp.asset.conversion_report import DofOrder, Finding, Report
from wheelleg_exp.asset.rigid_geometry import tensor_of
from wheelleg_exp.asset.robot_description import Body, Dof, Geom, RobotDescription
from wheelleg_exp.asset.usd.ledger import Ledger

FALLS = "no shape of the robot collides: it falls through any ground"


def note_colliders(robot: RobotDescription, ledger: Ledger) -> None:
    """Warn if nothing collides; record ends of limbs (welded bodies without moving children) without colliders."""
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
    """Yield mass and size, the longest edge of the box around colliders and joints, of each body tree with both."""
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
    """Return a robot's conversion report; ``origin`` contains further fields, such as ``source`` and ``variants``."""
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


def values_of(robot: RobotDescription) -> dict[str, object]:
    """Return bodies, joints, colliders, meshes, and actuators of a robot by name, in SI units and radians."""
    colliders = [(body.name, geom) for body in robot.bodies for geom in body.geoms if geom.collides]
    return {
        "bodies": {body.name: _body(body) for body in robot.bodies},
        "joints": {dof.name: _joint(dof, body.name) for body in robot.bodies for dof in body.dofs},
        "colliders": {geom.name: _collider(geom, owner) for owner, geom in colliders},
        "static_colliders": {geom.name: _collider(geom, None) for geom in robot.static_geoms if geom.collides},
        "meshes": {
            mesh.name: {
                **{"vertices": len(mesh.vertices), "faces": len(mesh.faces)},
                **{"low": mesh.vertices.min(axis=0).tolist(), "high": mesh.vertices.max(axis=0).tolist()},
            }
            for mesh in robot.meshes
        },
        "actuators": {
            item.name: {item.transmission: item.target, **{k: plain(v) for k, v in item.extra.items()}}
            for item in robot.actuators
        },
    }


def _body(body: Body) -> dict[str, object]:
    inertial = body.inertial
    tensor = tensor_of(inertial.moments, inertial.axes)
    order = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
    return {
        **_fields(body, "path parent floating"),
        **_fields(body.pose, "position rotation"),
        "mass": inertial.mass,
        "center_of_mass": list(inertial.center_of_mass),
        "inertia": [float(tensor[place]) for place in order],  # The inertia tensor's order is xx, yy, zz, xy, xz, yz.
    }


def _joint(dof: Dof, body: str) -> dict[str, object]:
    return {
        "path": dof.path,
        "body": body,
        **_fields(dof, "kind axis anchor range stiffness damping armature frictionloss"),
        "effort": dof.effort,
        "velocity": dof.max_velocity,
        "drive": dof.drive
        and {
            **{"kind": dof.drive.kind, "kp": dof.drive.stiffness, "kv": dof.drive.damping},
            **_fields(dof.drive, "effort target_position target_velocity acceleration"),
        },
    }


def _collider(geom: Geom, owner: str | None) -> dict[str, object]:
    return {
        **{"path": geom.path, "body": owner, **_fields(geom, "kind size")},
        **_fields(geom.pose, "position rotation"),
        **_fields(geom, "mesh friction"),
    }


def _fields(part: object, names: str) -> dict[str, object]:
    return {name: plain(getattr(part, name)) for name in names.split()}


def plain(value: object) -> object:
    """Return a JSON value: tuples become lists, and NaN and infinity become text."""
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    if isinstance(value, Mapping):
        return {key: plain(item) for key, item in value.items()}
    return [plain(item) for item in value] if isinstance(value, tuple) else value
