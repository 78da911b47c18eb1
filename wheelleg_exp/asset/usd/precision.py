"""Writes numbers that the file holds in single precision as short as they are, and those in double precision exactly.

Joint frames, limits, drives and most masses are single by USD's schemas. Transforms may be either: they are taken for
single where each of them would be the same number in single precision, as in files whose writer widened them.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np
from pxr import Usd

from wheelleg_exp.asset.description import Body, Dof, Drive, Geom, Inertial, Pose, RobotDescription, Vec3
from wheelleg_exp.asset.geometry import single
from wheelleg_exp.asset.usd.stage import Stage

HALF_STEP = 2.0**-25  # of a vector's size: a smaller change is lost in single precision
MOST_DIGITS = 9


def shortened(stage: Stage, robot: RobotDescription) -> RobotDescription:
    """Return a robot whose numbers, where they were single, are the shortest decimals that read back as the same."""
    coarse = all(_is_single(prim) for prim in stage.prims)
    bodies = tuple(_body(stage, body, coarse) for body in robot.bodies)
    static = tuple(_geom(geom) for geom in robot.static_geoms) if coarse else robot.static_geoms
    return replace(robot, bodies=bodies, static_geoms=static)


def _is_single(prim: Usd.Prim) -> bool:
    """Return whether a prim's transform loses nothing in single precision."""
    for name in prim.GetAuthoredPropertyNames():
        if name.startswith("xformOp:"):
            value: Any = prim.GetAttribute(name).Get() if prim.GetAttribute(name) else None
            if hasattr(value, "GetImaginary"):
                value = (value.GetReal(), *value.GetImaginary())
            numbers = np.asarray(0.0 if value is None else value, dtype=float)
            if not np.array_equal(numbers, numbers.astype(np.float32)):
                return False
    return True


def _body(stage: Stage, body: Body, coarse: bool) -> Body:
    by_joint = body.parent is not None  # its place comes from the frames of a joint
    return replace(
        body,
        pose=_pose(body.pose) if by_joint or coarse else body.pose,
        inertial=_inertial(body.inertial),
        dofs=tuple(_dof(stage, dof) for dof in body.dofs),
        geoms=tuple(_geom(geom) for geom in body.geoms) if coarse else body.geoms,
    )


def _inertial(inertial: Inertial) -> Inertial:
    """Return the centre and the axes in short numbers; moments stay, which have to fit each other."""
    w, x, y, z = _short(inertial.axes, 1.0)
    return replace(inertial, center_of_mass=_vector(inertial.center_of_mass), axes=(w, x, y, z))


def _dof(stage: Stage, dof: Dof) -> Dof:
    """Return a joint with short numbers; those of MuJoCo's schemas are double."""
    if any(name.startswith("mjc:") for name in stage.ledger.authored.get(dof.path, {})):
        return dof
    return replace(
        dof,
        axis=_vector(dof.axis),
        anchor=_vector(dof.anchor),
        range=None if dof.range is None else (single(dof.range[0]), single(dof.range[1])),
        position=single(dof.position),
        velocity=single(dof.velocity),
        max_velocity=None if dof.max_velocity is None else single(dof.max_velocity),
        drive=None if dof.drive is None else _drive(dof.drive),
    )


def _drive(drive: Drive) -> Drive:
    return replace(
        drive,
        stiffness=single(drive.stiffness),
        damping=single(drive.damping),
        effort=None if drive.effort is None else single(drive.effort),
        target_position=single(drive.target_position),
        target_velocity=single(drive.target_velocity),
    )


def _geom(geom: Geom) -> Geom:
    return replace(geom, size=tuple(single(value) for value in geom.size), pose=_pose(geom.pose))


def _pose(pose: Pose) -> Pose:
    w, x, y, z = _short(pose.rotation, 1.0)
    return Pose(_vector(pose.position), (w, x, y, z))


def _vector(values: Vec3) -> Vec3:
    x, y, z = _short(values, max(map(abs, values)))
    return x, y, z


def _short(values: Iterable[float], size: float) -> list[float]:
    """Return the shortest decimals that are the same in a vector of single precision and this size."""
    return [next((s for s in _decimals(value) if abs(s - value) <= size * HALF_STEP), value) for value in values]


def _decimals(value: float) -> Iterable[float]:
    return (float(f"{value:.{digits}g}") + 0.0 for digits in range(1, MOST_DIGITS + 1))
