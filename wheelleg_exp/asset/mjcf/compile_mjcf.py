"""Compile an MJCF, check it against the robot description, and compute gains and positions from the model."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np

from wheelleg_exp.asset.mjcf.coupled_positions import JointCouplings
from wheelleg_exp.asset.mjcf.mjcf_document import Writer, file_name, obj_text
from wheelleg_exp.asset.rigid_geometry import rotation_matrix, tensor_of
from wheelleg_exp.asset.robot_description import RobotDescription
from wheelleg_exp.errors import AssetError

RELATIVE = 1e-9
SMALL = 1e-12
KINDS = {"hinge": mujoco.mjtJoint.mjJNT_HINGE, "slide": mujoco.mjtJoint.mjJNT_SLIDE, "ball": mujoco.mjtJoint.mjJNT_BALL}


def load(path: Path, source: str) -> mujoco.MjModel:
    """Load an MJCF. If MuJoCo refuses the MJCF, the raised AssetError gives MuJoCo's reason."""
    with refusals(source, path.parent):
        return mujoco.MjModel.from_xml_path(str(path))


_PLACE = re.compile(r",? *Element (?:name )?'(?P<name>[^']*)'(?:, (?:id|line|column) -?\d+)*")


@contextmanager
def refusals(source: str, folder: Path | None = None) -> Iterator[None]:
    """Convert MuJoCo's exceptions to an AssetError about the robot file ``source``, without temporary paths."""
    try:
        yield
    except (ValueError, mujoco.FatalError) as error:
        reason = " ".join(str(error).split()).replace(f"{folder}/", "")
        reason = _PLACE.sub(lambda found: f" (at '{found['name']}')" if found["name"] else "", reason)
        raise AssetError(f"MuJoCo cannot build a model of '{source}': {reason.removeprefix('Error: ')}") from None


@contextmanager
def mujoco_warnings() -> Iterator[list[str]]:
    """Collect MuJoCo's warnings in a list, instead of MuJoCo's log file in the current folder."""
    texts: list[str] = []
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(lambda text: texts.append(f"MuJoCo: {text}"))
    try:
        yield texts
    finally:
        mujoco.set_mju_user_warning(before)


def verify(model: mujoco.MjModel, robot: RobotDescription, source: str) -> None:
    """Raise an AssetError if a bug in the converter makes the MuJoCo model differ from the robot description."""
    try:
        for what, got, want in _comparisons(model, robot):
            if not np.allclose(np.asarray(got, float), np.asarray(want, float), rtol=RELATIVE, atol=SMALL):
                raise AssetError(f"MuJoCo's model of '{source}' has a wrong {what}: {got}, expected {want}")
    except KeyError as error:
        raise AssetError(f"MuJoCo's model of '{source}' lacks an element of the file: {error.args[0]}") from None


def _comparisons(model: mujoco.MjModel, robot: RobotDescription) -> Iterator[tuple[str, object, object]]:
    """Yield the name of each quantity, its value in the model, and its value in the description."""
    for body in robot.bodies:
        found, name, inertial = model.body(body.name), body.name, body.inertial
        yield f"parent of {name}", found.parentid, model.body(body.parent).id if body.parent is not None else 0
        yield f"position of {name}", found.pos, body.pose.position
        yield f"rotation of {name}", rotation_matrix(found.quat), rotation_matrix(body.pose.rotation)
        yield f"mass of {name}", found.mass, inertial.mass
        yield f"centre of mass of {name}", found.ipos, inertial.center_of_mass
        # MuJoCo can reorder a body's principal axes, so compare the body's whole inertia tensor.
        scale = max(inertial.moments) or 1.0
        got = tensor_of(found.inertia, found.iquat)
        yield f"inertia of {name}", got / scale, tensor_of(inertial.moments, inertial.axes) / scale
    for dof in robot.dofs:
        joint, joint_name = model.joint(dof.name), dof.name
        yield f"kind of {joint_name}", joint.type, int(KINDS[dof.kind])
        if dof.kind != "ball":
            yield f"axis of {joint_name}", joint.axis, np.asarray(dof.axis) / np.linalg.norm(dof.axis)
        yield f"anchor of {joint_name}", joint.pos, dof.anchor
        yield f"limits of {joint_name}", model.jnt_limited[joint.id], dof.range is not None
        if dof.range is not None:
            yield f"range of {joint_name}", joint.range, dof.range
        yield f"armature of {joint_name}", joint.armature[0], dof.armature
        yield f"friction loss of {joint_name}", joint.frictionloss[0], dof.frictionloss
        if "springdamper" not in dof.extra:  # MuJoCo computes stiffness and damping from ``springdamper``.
            yield f"damping of {joint_name}", joint.damping[0], dof.damping
            yield f"stiffness of {joint_name}", joint.stiffness, dof.stiffness
    anchors = sum(len(closure.anchors) for closure in robot.closures)
    bits = model.geom_contype | model.geom_conaffinity
    yield "number of bodies", model.nbody - 1, len(robot.bodies)
    yield "number of joints", model.njnt, len(robot.dofs) + sum(body.floating for body in robot.bodies)
    yield "number of shapes", model.ngeom, len(robot.geoms)
    yield "number of colliders", np.count_nonzero(bits), sum(geom.collides for geom in robot.geoms)
    yield "number of sites", model.nsite, len(robot.sites) + 2 * anchors
    yield "number of equalities", model.neq, anchors + len(robot.couplings)
    yield "number of exclusions", model.nexclude, len(robot.exclusions)
    yield "number of tendons", model.ntendon, len(robot.tendons)
    drives = sum(dof.drive is not None for dof in robot.dofs)
    yield "number of actuators", model.nu, drives + len(robot.actuators)


def with_model_values(robot: RobotDescription) -> RobotDescription:
    """Return the robot with each gain ``k`` of an acceleration drive multiplied by the joint's inertia.

    This is 1/(M⁻¹)ᵢᵢ of the mass matrix with all coordinates at zero: all other joints are free to move. The saved
    positions and velocities of joints that follow other joints become those that their drivers require.
    """
    if not robot.couplings and not any(dof.drive and dof.drive.acceleration for dof in robot.dofs):
        return robot
    assets = {file_name(mesh): obj_text(mesh).encode() for mesh in robot.meshes if len(mesh.faces)}
    with refusals(robot.name):
        model = mujoco.MjModel.from_xml_string(Writer(robot, "").text(), assets)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    full = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, full)
    # The inertia that moves with joint i while all other joints are free is 1 / (inverse mass matrix)_ii.
    inverse = np.diag(np.linalg.inv(full))
    inertia = {dof.name: float(1 / inverse[model.joint(dof.name).dofadr[0]]) for dof in robot.dofs}
    state = np.array([(dof.position, dof.velocity) for dof in robot.dofs]).T
    couplings = JointCouplings(model, {model.joint(dof.name).id: column for column, dof in enumerate(robot.dofs)})
    couplings.limits.clear()  # A saved state can violate joint limits.
    couplings.follow(*state)
    states = iter(state.T.tolist())
    bodies = []
    for body in robot.bodies:
        dofs = []
        for dof in body.dofs:
            drive, load, (position, velocity) = dof.drive, inertia[dof.name], next(states)
            if drive and drive.acceleration:
                drive = replace(drive, stiffness=drive.stiffness * load, damping=drive.damping * load)
            dofs.append(replace(dof, drive=drive, position=position, velocity=velocity))
        bodies.append(replace(body, dofs=tuple(dofs)))
    return replace(robot, bodies=tuple(bodies))
