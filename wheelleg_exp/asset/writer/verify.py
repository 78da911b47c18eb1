"""Loads a written MJCF and holds the compiled model against the description."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np

from wheelleg_exp.asset.description import Body, Dof, RobotDescription
from wheelleg_exp.asset.geometry import rotation_matrix
from wheelleg_exp.errors import AssetError

RELATIVE = 1e-9


def load(path: Path, source: str) -> mujoco.MjModel:
    """Load an MJCF.

    Raises:
        AssetError: MuJoCo refuses it, with MuJoCo's reason.
    """
    try:
        return mujoco.MjModel.from_xml_path(str(path))
    except ValueError as error:
        reason = " ".join(str(error).split())
        raise AssetError(f"MuJoCo cannot build a model of '{source}': {reason}") from None


def verify(model: mujoco.MjModel, robot: RobotDescription, source: str) -> None:
    """Compare masses, inertias, poses, joints and actuators.

    Raises:
        AssetError: the model is not what was described; an error of the converter, not of the file.
    """
    for body in robot.bodies:
        _body(model, body, source)
    for dof in robot.dofs:
        _dof(model, dof, source)
    drives = len(robot.actuators) + sum(dof.drive is not None for dof in robot.dofs)
    colliders = int(np.count_nonzero((model.geom_contype | model.geom_conaffinity) & (model.geom_bodyid > 0)))
    _same(source, "actuators", model.nu, drives)
    if robot.self_collision:
        _same(source, "colliders", colliders, len(robot.colliders))


def _same(source: str, what: str, got: object, want: object) -> None:
    if not np.allclose(np.asarray(got, float), np.asarray(want, float), rtol=RELATIVE, atol=1e-12):
        raise AssetError(f"the model of '{source}' has other {what} than the file: {got}, expected {want}")


def _body(model: mujoco.MjModel, body: Body, source: str) -> None:
    index = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, body.name)
    if index < 0:
        raise AssetError(f"the model of '{source}' has no body '{body.name}'")
    inertial = body.inertial
    _same(source, f"mass of {body.name}", model.body_mass[index], inertial.mass)
    _same(source, f"centre of mass of {body.name}", model.body_ipos[index], inertial.center_of_mass)
    got, want = (
        _tensor(model.body_inertia[index], model.body_iquat[index]),
        _tensor(inertial.moments, inertial.axes),
    )
    scale = max(inertial.moments)
    _same(source, f"inertia of {body.name}", got / scale, want / scale)
    _same(source, f"position of {body.name}", model.body_pos[index], body.pose.position)


def _tensor(moments: object, axes: object) -> np.ndarray:
    turn = rotation_matrix(tuple(np.asarray(axes, float)))
    return np.asarray(turn @ np.diag(np.asarray(moments, float)) @ turn.T)


def _dof(model: mujoco.MjModel, dof: Dof, source: str) -> None:
    index = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, dof.name)
    if index < 0:
        raise AssetError(f"the model of '{source}' has no joint '{dof.name}'")
    _same(source, f"limits of {dof.name}", model.jnt_limited[index], dof.range is not None)
    if dof.range is not None:
        _same(source, f"range of {dof.name}", model.jnt_range[index], dof.range)
    _same(source, f"armature of {dof.name}", model.dof_armature[model.jnt_dofadr[index]], dof.armature)
