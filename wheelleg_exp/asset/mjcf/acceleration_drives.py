"""Turns the gains of acceleration drives into gains of force, by the inertia that each meets at zero."""

from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np

from wheelleg_exp.asset.description import Drive, RobotDescription
from wheelleg_exp.asset.mjcf.document import Writer, file_name, obj_text
from wheelleg_exp.asset.mjcf.verify import build


def with_force_gains(robot: RobotDescription) -> RobotDescription:
    """Return the robot with ``k · I`` for the ``k`` of each acceleration drive.

    ``I`` is 1/(M⁻¹)ᵢᵢ of the mass matrix with all coordinates at zero: what the drive accelerates while
    everything else is free to move.
    """
    if not any(dof.drive and dof.drive.acceleration for dof in robot.dofs):
        return robot
    inertia = _effective_inertia(robot)
    bodies = []
    for body in robot.bodies:
        dofs = [replace(d, drive=_scaled(d.drive, inertia[d.name])) if d.drive else d for d in body.dofs]
        bodies.append(replace(body, dofs=tuple(dofs)))
    return replace(robot, bodies=tuple(bodies))


def _scaled(drive: Drive, inertia: float) -> Drive:
    if not drive.acceleration:
        return drive
    return replace(drive, stiffness=drive.stiffness * inertia, damping=drive.damping * inertia)


def _effective_inertia(robot: RobotDescription) -> dict[str, float]:
    assets = {file_name(mesh): obj_text(mesh).encode() for mesh in robot.meshes if len(mesh.faces)}
    model = build(Writer(robot, "").text(), assets, robot.name)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    full = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, full)
    inverse = np.diag(np.linalg.inv(full))
    return {dof.name: float(1 / inverse[model.joint(dof.name).dofadr[0]]) for dof in robot.dofs}
