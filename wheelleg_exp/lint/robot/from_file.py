"""A robot's file alone, looked at as a task's robot is: its own pose, drives and limits, on level ground."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Collection, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from wheelleg_exp.asset import Conversion, convert
from wheelleg_exp.asset.description import Dof
from wheelleg_exp.asset.values import effort_of
from wheelleg_exp.config.composing.compose import compose
from wheelleg_exp.errors import AssetError
from wheelleg_exp.lint.case import Case
from wheelleg_exp.lint.collider_depth import lowest_point
from wheelleg_exp.lint.robot.compiled import compiled_robot
from wheelleg_exp.lint.robot_facts import Drive, at_default
from wheelleg_exp.managers import SceneManager
from wheelleg_exp.project.survey import default_position, provisional_robot

_MJCF = (".xml", ".mjcf")
_ENDLESS = 1e6  # from here on a limit is none
_TERMS = ("commands", "actions", "events", "rewards", "terminations", "observations", "curriculum")


def case_of_file(source: Path) -> Case:
    """Return a robot's file as rules look at it, with its own default pose and drives, standing on level ground.

    Args:
        source: a USD, URDF or MJCF file.

    Raises:
        AssetError: the file cannot be read, or holds no robot with joints.
    """
    stock = compose(["task=stand"]).config["env"]
    env = {**stock, **{name: {} for name in _TERMS}, "scene": {**stock["scene"], "sensors": {}}}
    with tempfile.TemporaryDirectory(prefix="wheelleg-doctor-") as folder:
        if source.suffix.lower() in _MJCF:
            model = _model(source)
            drives = _drives_of_mjcf(model)
            return _looked_at(source, env, source, _robot_of_mjcf(source, model), None, drives, list(drives))
        conversion = convert(source, Path(folder) / "model.xml", base="floating")
        positions = {dof.name: default_position(dof) for dof in conversion.description.dofs if dof.kind != "ball"}
        described = conversion.description
        robot = provisional_robot(described.name, next(described.children(None)).pose.rotation, positions)
        drives = {dof.name: _drive(dof) for dof in described.dofs}
        return _looked_at(source, env, conversion.output, robot, conversion, drives, described.driven)


def _looked_at(
    source: Path,
    env: Mapping[str, Any],
    mjcf: Path,
    robot: dict[str, Any],
    conversion: Conversion | None,
    drives: Mapping[str, Drive | None],
    driven: Collection[str],
) -> Case:
    config = {"env": {**env, "robot": robot}}
    scene = SceneManager(config["env"], mjcf, 1).scene
    if not scene.robot.joint_names:
        expected = "a robot with joints to drive"
        raise AssetError("the robot has no joints", where=str(source), expected=expected)
    model = scene.spec.compile()
    bodies = [model.body(name).id for name in scene.robot.body_names]
    lowest = lowest_point(model, at_default(model, scene.robot), bodies)
    if math.isfinite(lowest) and scene.robot.floating:
        scene.robot.layout.default_root_pos[2] -= lowest
    found, facts = compiled_robot(model, scene.robot, conversion.report if conversion is not None else None, driven)
    wheels = set(facts.wheels)
    joints = {
        name: replace(joint, drive=_grouped(drives.get(name), wheels, name)) for name, joint in facts.joints.items()
    }
    return Case(config, replace(facts, joints=joints), found)


def _grouped(drive: Drive | None, wheels: set[str], name: str) -> Drive | None:
    return None if drive is None else replace(drive, group="wheels" if name in wheels else "legs")


def _drive(dof: Dof) -> Drive | None:
    """Return a joint's drive as its file gives it; what the file leaves out limits nothing."""
    effort = effort_of(dof)
    if dof.drive is None and effort is None and dof.max_velocity is None:
        return None
    return Drive(
        "",
        dof.drive.stiffness if dof.drive is not None else 0.0,
        dof.drive.damping if dof.drive is not None else 0.0,
        _limit(effort),
        _limit(dof.max_velocity),
    )


def _limit(value: float | None) -> float:
    return value if value is not None and value < _ENDLESS else math.inf


def _model(source: Path) -> mujoco.MjModel:
    if not source.is_file():
        raise AssetError("there is no such file", where=str(source))
    try:
        return mujoco.MjModel.from_xml_path(str(source))
    except ValueError as error:
        raise AssetError(f"MuJoCo cannot read it: {' '.join(str(error).split())}", where=str(source)) from None


def _robot_of_mjcf(source: Path, model: mujoco.MjModel) -> dict[str, Any]:
    """Return an ``env.robot`` section for an MJCF in its first saved state, or its own zero."""
    qpos = model.key_qpos[0] if model.nkey else model.qpos0
    free = np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_FREE)
    scalar = (model.jnt_type == mujoco.mjtJoint.mjJNT_HINGE) | (model.jnt_type == mujoco.mjtJoint.mjJNT_SLIDE)
    positions: dict[str, float] = {}
    for joint in np.flatnonzero(scalar).tolist():
        name = model.joint(joint).name
        if not name:
            raise AssetError("a joint has no name", where=str(source), expected="a name for every joint and body")
        low, high = model.jnt_range[joint] if model.jnt_limited[joint] else (-math.inf, math.inf)
        positions[name] = float(min(max(qpos[model.jnt_qposadr[joint]], low), high))
    start = int(model.jnt_qposadr[free[0]]) + 3 if len(free) else None
    rotation = qpos[start : start + 4].tolist() if start is not None else [1.0, 0.0, 0.0, 0.0]
    return provisional_robot(source.stem, rotation, positions)


def _drives_of_mjcf(model: mujoco.MjModel) -> dict[str, Drive | None]:
    """Return the drives of joints with actuators of their own: these add up, and the joint may limit their sum."""
    drives: dict[str, Drive | None] = {}
    for joint in range(model.njnt):
        own = (model.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT) & (model.actuator_trnid[:, 0] == joint)
        parts = [_actuator(model, index) for index in np.flatnonzero(own).tolist()]
        if not parts:
            continue
        stiffness, damping, effort = (sum(values) for values in zip(*parts, strict=True))
        damping += float(model.dof_damping[model.jnt_dofadr[joint]])
        if model.jnt_actfrclimited[joint]:
            effort = min(effort, float(np.abs(model.jnt_actfrcrange[joint]).max()))
        drives[model.joint(joint).name] = Drive("", stiffness, damping, effort, math.inf)
    return drives


def _actuator(model: mujoco.MjModel, index: int) -> tuple[float, float, float]:
    """Return an actuator's stiffness, N·m/rad, damping, N·m·s/rad, and largest torque, N·m, at its joint."""
    gear = abs(float(model.actuator_gear[index, 0]))
    limits = [math.inf]
    if model.actuator_forcelimited[index]:
        limits.append(gear * float(np.abs(model.actuator_forcerange[index]).max()))
    bias = model.actuator_biasprm[index]
    if model.actuator_ctrllimited[index] and not bias.any():  # a motor's control is its torque
        gain = gear * float(model.actuator_gainprm[index, 0])
        limits.append(gain * float(np.abs(model.actuator_ctrlrange[index]).max()))
    return gear**2 * -float(bias[1]) + 0.0, gear**2 * -float(bias[2]) + 0.0, min(limits)
