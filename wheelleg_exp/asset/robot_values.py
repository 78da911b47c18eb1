"""Collect the numbers of a converted robot as plain JSON, so that a script can compare two robot files."""

from __future__ import annotations

import math
from collections.abc import Mapping

from wheelleg_exp.asset.rigid_geometry import tensor_of
from wheelleg_exp.asset.robot_description import Body, Dof, Geom, Mesh, RobotDescription


def values_of(robot: RobotDescription) -> dict[str, object]:
    """Return bodies, joints, colliders, meshes, and actuators of a robot by name, in SI units and radians."""
    colliders = [(body.name, geom) for body in robot.bodies for geom in body.geoms if geom.collides]
    return {
        "bodies": {body.name: _body(body) for body in robot.bodies},
        "joints": {dof.name: _joint(dof, body.name) for body in robot.bodies for dof in body.dofs},
        "colliders": {geom.name: _collider(geom, owner) for owner, geom in colliders},
        "static_colliders": {geom.name: _collider(geom, None) for geom in robot.static_geoms if geom.collides},
        "meshes": {mesh.name: _mesh(mesh) for mesh in robot.meshes},
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
        "effort": effort_of(dof),
        "velocity": dof.max_velocity,
        "drive": dof.drive
        and {
            **{"kind": dof.drive.kind, "kp": dof.drive.stiffness, "kv": dof.drive.damping},
            **_fields(dof.drive, "effort target_position target_velocity acceleration"),
        },
    }


def effort_of(dof: Dof) -> float | None:
    """Return the largest effort of a joint's motors, in N·m or N; None means unlimited."""
    limits = [] if dof.force_range is None else [max(map(abs, dof.force_range))]
    if dof.drive is not None and dof.drive.effort is not None:
        limits.append(dof.drive.effort)
    return min(limits, default=None)


def _collider(geom: Geom, owner: str | None) -> dict[str, object]:
    return {
        **{"path": geom.path, "body": owner, **_fields(geom, "kind size")},
        **_fields(geom.pose, "position rotation"),
        **_fields(geom, "mesh friction"),
    }


def _mesh(mesh: Mesh) -> dict[str, object]:
    return {
        "vertices": len(mesh.vertices),
        "faces": len(mesh.faces),
        "low": mesh.vertices.min(axis=0).tolist(),
        "high": mesh.vertices.max(axis=0).tolist(),
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
