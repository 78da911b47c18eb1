"""Compile an MJCF in MuJoCo and compare the model with the description.

The compiled model also gives two corrections of the description. Gains of acceleration drives become force gains, by
the inertia that each drive moves at zero. Attributes of USD's MuJoCo schemas that MuJoCo refuses, such as an ``actdim``
without a ``dyntype``, are found by trial and left out one by one.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from wheelleg_exp.asset.conversion_report import LeftOut, Report
from wheelleg_exp.asset.mjcf.mjcf_document import Writer, file_name, obj_text
from wheelleg_exp.asset.rigid_geometry import rotation_matrix
from wheelleg_exp.asset.robot_description import Actuator, Body, Dof, Drive, RobotDescription, Tendon
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
    """MuJoCo refuses a model."""


def load(path: Path, source: str) -> mujoco.MjModel:
    """Load an MJCF.

    Raises:
        ModelRefused: MuJoCo refuses the file; the message gives its reason.
    """
    with refusals(source, path.parent):
        return mujoco.MjModel.from_xml_path(str(path))


def build(text: str, files: Mapping[str, bytes], source: str) -> mujoco.MjModel:
    """Compile the text of an MJCF and the files that it names.

    Raises:
        ModelRefused: MuJoCo refuses the text; the message gives its reason.
    """
    with refusals(source):
        return mujoco.MjModel.from_xml_string(text, dict(files))


_PLACE = re.compile(r",? *Element (?:name )?'(?P<name>[^']*)'(?:, (?:id|line|column) -?\d+)*")


@contextmanager
def refusals(source: str, folder: Path | None = None) -> Iterator[None]:
    """Convert MuJoCo's exceptions to errors about ``source``, without lines and folders of temporary files.

    Raises:
        ModelRefused: MuJoCo refuses something; the message gives its reason and the element's name.
    """
    try:
        yield
    except (ValueError, mujoco.FatalError) as error:
        reason = " ".join(str(error).split()).replace(f"{folder}/", "")
        reason = _PLACE.sub(lambda found: f" (at '{found['name']}')" if found["name"] else "", reason)
        raise ModelRefused(f"MuJoCo cannot build a model of '{source}': {reason.removeprefix('Error: ')}") from None


@contextmanager
def mujoco_warnings() -> Iterator[list[str]]:
    """Collect MuJoCo's warnings, which MuJoCo would write to a log file in the current folder."""
    texts: list[str] = []
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(lambda text: texts.append(f"MuJoCo: {text}"))
    try:
        yield texts
    finally:
        mujoco.set_mju_user_warning(before)


def verify(model: mujoco.MjModel, robot: RobotDescription, source: str) -> None:
    """Compare bodies, joints, shapes, actuators, and constraints of a model with the description.

    Raises:
        AssetError: the model differs from the description; this is an error of the converter, not of the file.
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
        """Raise AssetError unless numbers equal the file's."""
        if not np.allclose(np.asarray(got, float), np.asarray(want, float), rtol=RELATIVE, atol=SMALL):
            raise AssetError(f"the model of '{self.source}' differs from the file in {what}: {got}, expected {want}")

    def find(self, kind: mujoco.mjtObj, name: str, what: str) -> int:
        """Return the id of a named element; AssetError if it is missing."""
        index = mujoco.mj_name2id(self.model, kind, name)
        if index < 0:
            raise AssetError(f"the model of '{self.source}' has no {what} '{name}'")
        return int(index)

    def body(self, body: Body) -> None:
        """Compare a body's pose, mass, and inertia."""
        model, name, inertial = self.model, body.name, body.inertial
        index = self.find(mujoco.mjtObj.mjOBJ_BODY, name, "body")
        parent = self.find(mujoco.mjtObj.mjOBJ_BODY, body.parent, "body") if body.parent is not None else 0
        self.same(f"parent of {name}", model.body_parentid[index], parent)
        self.same(f"position of {name}", model.body_pos[index], body.pose.position)
        self.same(f"rotation of {name}", _turn(model.body_quat[index]), _turn(body.pose.rotation))
        self.same(f"mass of {name}", model.body_mass[index], inertial.mass)
        self.same(f"centre of mass of {name}", model.body_ipos[index], inertial.center_of_mass)
        # Compare tensors, because MuJoCo can order the principal axes differently.
        got = _tensor(model.body_inertia[index], model.body_iquat[index])
        want = _tensor(inertial.moments, inertial.axes)
        scale = max(inertial.moments) or 1.0
        self.same(f"inertia of {name}", got / scale, want / scale)

    def dof(self, dof: Dof) -> None:
        """Compare a joint's kind, axis, limits, and passive forces."""
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
        if "springdamper" not in dof.extra:  # springdamper replaces damping and stiffness
            self.same(f"damping of {name}", model.dof_damping[first], dof.damping)
            self.same(f"stiffness of {name}", model.jnt_stiffness[index], dof.stiffness)

    def actuator(self, actuator: Actuator) -> None:
        """Compare the target of an actuator."""
        index = self.find(mujoco.mjtObj.mjOBJ_ACTUATOR, actuator.name, "actuator")
        target = self.find(TARGETS[actuator.transmission], actuator.target, actuator.transmission)
        self.same(f"target of {actuator.name}", self.model.actuator_trnid[index][0], target)

    def tendon(self, tendon: Tendon) -> None:
        """Compare a tendon's path and limits."""
        index = self.find(mujoco.mjtObj.mjOBJ_TENDON, tendon.name, "tendon")
        length = len(tendon.points) + len(tendon.joints)
        self.same(f"path of {tendon.name}", self.model.tendon_num[index], length)
        self.same(f"limits of {tendon.name}", self.model.tendon_limited[index], _limited(tendon))

    def counts(self, robot: RobotDescription) -> None:
        """Compare the number of elements of each kind."""
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


def with_force_gains(robot: RobotDescription) -> RobotDescription:
    """Return the robot with ``k · I`` for each gain ``k`` of acceleration drives.

    ``I`` is 1/(M⁻¹)ᵢᵢ of the mass matrix with all coordinates at zero: the inertia that the drive accelerates while
    all other joints are free to move.
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
    # 1 / (inverse mass matrix)_ii is the inertia of coordinate i while all other coordinates are free.
    inverse = np.diag(np.linalg.inv(full))
    return {dof.name: float(1 / inverse[model.joint(dof.name).dofadr[0]]) for dof in robot.dofs}


MOST = 20  # wrong attributes in one file
TRIALS = 200  # models compiled to find one wrong attribute
MAPPINGS = ("extra", "option", "flag", "compiler")  # fields with MuJoCo's attributes

Place = tuple[tuple[str, int], ...]
"""Path to an item of a robot: fields and indices, from the outside in."""


@dataclass(frozen=True)
class Suspect:
    """An attribute: its item, the item's place in the robot, the field with the attribute, and its MJCF name."""

    item: Any
    place: Place
    mapping: str
    key: str

    @property
    def value(self) -> object:
        """The attribute's value."""
        return getattr(self.item, self.mapping)[self.key]


def without_refused(robot: RobotDescription, report: Report) -> tuple[RobotDescription, Report]:
    """Return the robot without the attributes that MuJoCo refuses, and a report that names them.

    Raises:
        ModelRefused: MuJoCo refuses the robot for another reason.
    """
    for _ in range(MOST):
        refusal = _refusal(robot, report.source)
        if refusal is None:
            break
        found = _culprit(robot, refusal, report.source)
        if found is None:
            raise refusal
        robot, report = _without(robot, found.place, found), _with_left_out(report, found, refusal)
    return robot, report


def _refusal(robot: RobotDescription, source: str) -> ModelRefused | None:
    assets = {file_name(mesh): obj_text(mesh).encode() for mesh in robot.meshes if len(mesh.faces)}
    try:
        build(Writer(robot, "").text(), assets, source)
    except ModelRefused as error:
        return error
    return None


def _culprit(robot: RobotDescription, refusal: ModelRefused, source: str) -> Suspect | None:
    """Return an attribute without which MuJoCo accepts the robot, or else refuses it for another reason."""
    changed = None
    # MuJoCo's message often names the element. Then only the attributes of that element need a trial.
    suspects = list(_suspects(robot))
    named = [found for found in suspects if f"'{getattr(found.item, 'name', '')}'" in refusal.message]
    for suspect in (named or suspects)[:TRIALS]:
        left = _refusal(_without(robot, suspect.place, suspect), source)
        if left is None:
            return suspect
        if changed is None and left.message != refusal.message:
            changed = suspect
    return changed


def _suspects(item: Any, place: Place = ()) -> Iterator[Suspect]:
    for entry in fields(item):
        value = getattr(item, entry.name)
        if entry.name in MAPPINGS:
            yield from (Suspect(item, place, entry.name, key) for key in value)
        elif isinstance(value, tuple) and value and is_dataclass(value[0]):
            for index, inner in enumerate(value):
                yield from _suspects(inner, (*place, (entry.name, index)))


def _without(item: Any, place: Place, suspect: Suspect) -> Any:
    if not place:
        kept = {key: value for key, value in getattr(item, suspect.mapping).items() if key != suspect.key}
        return replace(item, **{suspect.mapping: kept})
    (name, index), *rest = place
    inner = list(getattr(item, name))
    inner[index] = _without(inner[index], tuple(rest), suspect)
    return replace(item, **{name: tuple(inner)})


def _with_left_out(report: Report, found: Suspect, refusal: ModelRefused) -> Report:
    path = getattr(found.item, "path", report.root)
    of_item = [item for item in report.mapped if item.path == path and item.became == found.key]
    name = of_item[0].name if of_item else found.key
    reason = "MuJoCo refuses it: " + refusal.message.partition(": ")[2]
    return replace(
        report,
        mapped=tuple(item for item in report.mapped if item not in of_item),
        left_out=(*report.left_out, LeftOut(name, reason, {path: str(found.value)})),
        warnings=(*report.warnings, f"{path}: {name} was left out: {reason}"),
    )
