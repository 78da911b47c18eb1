"""Loads a written MJCF and holds the compiled model against the description."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import mujoco
import numpy as np

from wheelleg_exp.asset.description import Actuator, Body, Dof, RobotDescription, Tendon
from wheelleg_exp.asset.geometry import rotation_matrix
from wheelleg_exp.errors import AssetError

RELATIVE = 1e-9
SMALL = 1e-12
KINDS = {
    "hinge": mujoco.mjtJoint.mjJNT_HINGE,
    "slide": mujoco.mjtJoint.mjJNT_SLIDE,
    "ball": mujoco.mjtJoint.mjJNT_BALL,
}
TARGETS = {
    "joint": mujoco.mjtObj.mjOBJ_JOINT,
    "jointinparent": mujoco.mjtObj.mjOBJ_JOINT,
    "tendon": mujoco.mjtObj.mjOBJ_TENDON,
    "site": mujoco.mjtObj.mjOBJ_SITE,
    "cranksite": mujoco.mjtObj.mjOBJ_SITE,
    "body": mujoco.mjtObj.mjOBJ_BODY,
}


class ModelRefused(AssetError):
    """MuJoCo does not take a model."""


def load(path: Path, source: str) -> mujoco.MjModel:
    """Load an MJCF.

    Raises:
        ModelRefused: MuJoCo does not take it, with its reason.
    """
    with refusals(source, path.parent):
        return mujoco.MjModel.from_xml_path(str(path))


def build(text: str, files: Mapping[str, bytes], source: str) -> mujoco.MjModel:
    """Compile the text of an MJCF and the files that it names.

    Raises:
        ModelRefused: MuJoCo does not take it, with its reason.
    """
    with refusals(source):
        return mujoco.MjModel.from_xml_string(text, dict(files))


_PLACE = re.compile(r",? *Element (?:name )?'(?P<name>[^']*)'(?:, (?:id|line|column) -?\d+)*")


@contextmanager
def refusals(source: str, folder: Path | None = None) -> Iterator[None]:
    """Turn MuJoCo's refusals into errors about ``source``, without lines and the folder of what nobody else sees.

    Raises:
        ModelRefused: MuJoCo refuses something, with its reason and the element's name.
    """
    try:
        yield
    except (ValueError, mujoco.FatalError) as error:
        reason = " ".join(str(error).split()).replace(f"{folder}/", "")
        reason = _PLACE.sub(lambda found: f" (at '{found['name']}')" if found["name"] else "", reason)
        raise ModelRefused(f"MuJoCo cannot build a model of '{source}': {reason.removeprefix('Error: ')}") from None


@contextmanager
def told_by_mujoco() -> Iterator[list[str]]:
    """Collect what MuJoCo warns of, which it would write into a log file in the current folder."""
    told: list[str] = []
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(lambda text: told.append(f"MuJoCo: {text}"))
    try:
        yield told
    finally:
        mujoco.set_mju_user_warning(before)


def verify(model: mujoco.MjModel, robot: RobotDescription, source: str) -> None:
    """Compare bodies, joints, shapes, what acts on them and between them.

    Raises:
        AssetError: the model is not what was described; an error of the converter, not of the file.
    """
    check = _Check(model, source)
    for body in robot.bodies:
        check.body(body)
    for dof in robot.dofs:
        check.dof(dof)
    for actuator in robot.actuators:
        check.actuator(actuator)
    for tendon in robot.tendons:
        check.tendon(tendon)
    check.counts(robot)


class _Check:
    def __init__(self, model: mujoco.MjModel, source: str) -> None:
        self.model, self.source = model, source

    def same(self, what: str, got: object, want: object) -> None:
        """Hold numbers against the file's; AssetError when they differ."""
        if not np.allclose(np.asarray(got, float), np.asarray(want, float), rtol=RELATIVE, atol=SMALL):
            raise AssetError(f"the model of '{self.source}' has other {what} than the file: {got}, expected {want}")

    def find(self, kind: mujoco.mjtObj, name: str, what: str) -> int:
        """Return the id of a named element; AssetError when there is none."""
        index = mujoco.mj_name2id(self.model, kind, name)
        if index < 0:
            raise AssetError(f"the model of '{self.source}' has no {what} '{name}'")
        return int(index)

    def body(self, body: Body) -> None:
        """Hold a body's place, mass and inertia against the model."""
        model, name, inertial = self.model, body.name, body.inertial
        index = self.find(mujoco.mjtObj.mjOBJ_BODY, name, "body")
        parent = self.find(mujoco.mjtObj.mjOBJ_BODY, body.parent, "body") if body.parent is not None else 0
        self.same(f"parent of {name}", model.body_parentid[index], parent)
        self.same(f"position of {name}", model.body_pos[index], body.pose.position)
        self.same(f"rotation of {name}", _turn(model.body_quat[index]), _turn(body.pose.rotation))
        self.same(f"mass of {name}", model.body_mass[index], inertial.mass)
        self.same(f"centre of mass of {name}", model.body_ipos[index], inertial.center_of_mass)
        got = _tensor(model.body_inertia[index], model.body_iquat[index])
        want = _tensor(inertial.moments, inertial.axes)
        scale = max(inertial.moments) or 1.0
        self.same(f"inertia of {name}", got / scale, want / scale)

    def dof(self, dof: Dof) -> None:
        """Hold a joint's kind, axis, limits and passive forces against the model."""
        model, name = self.model, dof.name
        index = self.find(mujoco.mjtObj.mjOBJ_JOINT, name, "joint")
        first = model.jnt_dofadr[index]
        self.same(f"kind of {name}", model.jnt_type[index], int(KINDS[dof.kind]))
        if dof.kind != "ball":
            axis = np.asarray(dof.axis) / np.linalg.norm(dof.axis)
            self.same(f"axis of {name}", model.jnt_axis[index], axis)
        self.same(f"anchor of {name}", model.jnt_pos[index], dof.anchor)
        self.same(f"limits of {name}", model.jnt_limited[index], dof.range is not None)
        if dof.range is not None:
            self.same(f"range of {name}", model.jnt_range[index], dof.range)
        self.same(f"armature of {name}", model.dof_armature[first], dof.armature)
        self.same(f"friction loss of {name}", model.dof_frictionloss[first], dof.frictionloss)
        if "springdamper" not in dof.extra:  # it takes the place of both
            self.same(f"damping of {name}", model.dof_damping[first], dof.damping)
            self.same(f"stiffness of {name}", model.jnt_stiffness[index], dof.stiffness)

    def actuator(self, actuator: Actuator) -> None:
        """Hold what an actuator acts on against the model."""
        index = self.find(mujoco.mjtObj.mjOBJ_ACTUATOR, actuator.name, "actuator")
        target = self.find(TARGETS[actuator.transmission], actuator.target, actuator.transmission)
        self.same(f"target of {actuator.name}", self.model.actuator_trnid[index][0], target)

    def tendon(self, tendon: Tendon) -> None:
        """Hold a tendon's path and limits against the model."""
        index = self.find(mujoco.mjtObj.mjOBJ_TENDON, tendon.name, "tendon")
        length = len(tendon.points) + len(tendon.joints)
        self.same(f"path of {tendon.name}", self.model.tendon_num[index], length)
        self.same(f"limits of {tendon.name}", self.model.tendon_limited[index], _limited(tendon))

    def counts(self, robot: RobotDescription) -> None:
        """Hold how many there are of everything against the model."""
        model = self.model
        geoms = [*robot.static_geoms, *(geom for body in robot.bodies for geom in body.geoms)]
        anchors = sum(len(closure.anchors) for closure in robot.closures)
        sites = len(robot.static_sites) + sum(len(body.sites) for body in robot.bodies)
        bits = model.geom_contype | model.geom_conaffinity
        self.same("number of bodies", model.nbody - 1, len(robot.bodies))
        self.same("number of joints", model.njnt, len(robot.dofs) + sum(body.floating for body in robot.bodies))
        self.same("number of shapes", model.ngeom, len(geoms))
        self.same("number of colliders", np.count_nonzero(bits), sum(geom.collides for geom in geoms))
        self.same("number of sites", model.nsite, sites + 2 * anchors)
        self.same("number of equalities", model.neq, anchors + len(robot.couplings))
        self.same("number of exclusions", model.nexclude, len(robot.exclusions))
        self.same("number of tendons", model.ntendon, len(robot.tendons))
        drives = sum(dof.drive is not None for dof in robot.dofs)
        self.same("number of actuators", model.nu, drives + len(robot.actuators))


def _limited(tendon: Tendon) -> bool:
    return tendon.range is not None and tendon.extra.get("limited") is not False


def _turn(rotation: object) -> np.ndarray:
    w, x, y, z = np.asarray(rotation, float)
    return rotation_matrix((w, x, y, z))


def _tensor(moments: object, axes: object) -> np.ndarray:
    turn = _turn(axes)
    return np.asarray(turn @ np.diag(np.asarray(moments, float)) @ turn.T)
