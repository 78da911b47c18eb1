"""What joints are for, from how a robot is built: wheels at the end of limbs, legs between those and the trunk.

Names play no part. A wheel is a hinge without limits that carries nothing which moves in turn, and whose shapes are
round about its axis; the joints above it are its leg. Of a robot without wheels nothing is said.
"""

from __future__ import annotations

import numpy as np

from wheelleg_exp.asset.description import Body, Dof, Geom, Mesh, RobotDescription
from wheelleg_exp.asset.geometry import Array, Frame

WHEEL, LEG = "wheel", "leg"
ROUND = 0.1  # share of a wheel's radius that its shapes may be off


def roles_of(robot: RobotDescription) -> dict[str, str]:
    """Return ``wheel`` or ``leg`` by the name of a joint, an actuator or a shape; others are left out."""
    meshes = {mesh.name: mesh for mesh in robot.meshes}
    bodies = {body.name: body for body in robot.bodies}
    movers = {body.name: _mover(body, bodies) for body in robot.bodies}
    groups: dict[str, list[Body]] = {}
    for body in robot.bodies:
        groups.setdefault(movers[body.name], []).append(body)
    carriers = {movers[body.parent] for body in robot.bodies if body.parent is not None and body.dofs}
    wheels = [name for name in groups if name not in carriers and _is_wheel(groups[name], bodies, meshes)]
    kinds = dict.fromkeys(wheels, WHEEL)
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


def _mover(body: Body, bodies: dict[str, Body]) -> str:
    """Return the name of the body that a body is welded to in the end."""
    while body.parent is not None and not body.dofs:
        body = bodies[body.parent]
    return body.name


def _is_wheel(group: list[Body], bodies: dict[str, Body], meshes: dict[str, Mesh]) -> bool:
    dofs = group[0].dofs
    if len(dofs) != 1 or dofs[0].kind != "hinge" or dofs[0].range is not None:
        return False
    shapes = [(body, geom) for body in group for geom in body.geoms]
    solid = [(body, geom) for body, geom in shapes if geom.collides] or shapes
    return any(_is_round(dofs[0], _in_top(body, group[0], bodies), geom, meshes) for body, geom in solid)


def _in_top(body: Body, top: Body, bodies: dict[str, Body]) -> Frame:
    frame = Frame.identity()
    while body is not top and body.parent is not None:
        frame, body = Frame.of(body.pose) @ frame, bodies[body.parent]
    return frame


def _is_round(dof: Dof, inside: Frame, geom: Geom, meshes: dict[str, Mesh]) -> bool:
    """Return whether a shape is as wide in all directions across the joint's axis, and its middle stands on that."""
    frame = inside @ Frame.of(geom.pose)
    axis = np.asarray(dof.axis) / np.linalg.norm(dof.axis)
    along = frame.rotation.T @ axis  # in the shape's own frame
    middle, radius = _section(geom, along, meshes)
    offset = frame.rotation @ middle + frame.translation - np.asarray(dof.anchor)
    return radius > 0 and float(np.linalg.norm(offset - (offset @ axis) * axis)) <= ROUND * radius


def _section(geom: Geom, along: Array, meshes: dict[str, Mesh]) -> tuple[Array, float]:
    """Return a shape's middle and its radius about an axis through that, in m; 0 when it is not round about it."""
    if geom.kind == "sphere":
        return np.zeros(3), geom.size[0]
    if geom.kind in ("cylinder", "capsule"):
        return np.zeros(3), geom.size[0] if abs(along[2]) > 0.99 else 0.0
    if geom.kind != "mesh" or geom.mesh is None:
        return np.zeros(3), 0.0
    points = meshes[geom.mesh].vertices
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    across = points - middle - np.outer((points - middle) @ along, along)
    first = np.linalg.svd(along[None])[2][1:]  # two directions across
    reach = [
        float(np.abs(across @ (np.cos(angle) * first[0] + np.sin(angle) * first[1])).max())
        for angle in np.linspace(0, np.pi, 8, endpoint=False)
    ]
    return middle, max(reach) if min(reach) >= (1 - ROUND) * max(reach) else 0.0
