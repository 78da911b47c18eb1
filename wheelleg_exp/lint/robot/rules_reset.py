"""Resets that put the robot into the ground."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping
from typing import Any

import mujoco
import numpy as np

from wheelleg_exp.lint.case import Case
from wheelleg_exp.lint.collider_depth import lowest_point
from wheelleg_exp.lint.findings import Finding, at_least, rule
from wheelleg_exp.lint.robot.compiled import CompiledRobot

_DEPTH = 0.01  # of the robot's size: what soft contacts push out without throwing the robot


@rule
def reset_into_ground(case: Case) -> Iterator[Finding]:
    """Drawn starts whose lowest point lies inside the ground.

    The extremes of the drawn height, roll and pitch, with the extremes of drawn joint positions, are held against the
    ground: from below it the contact throws the robot. Source: kinematics.
    """
    robot = case.robot
    if robot is None or not robot.anatomy.floating:
        return
    joints = list(_drawn_joints(case, robot))
    for term in case.terms("events", "events.reset_root_state_uniform"):
        ranges: Mapping[str, Any] = term.node["pose_range"]
        tilts = [tuple(ranges.get(axis) or (0.0, 0.0)) for axis in ("roll", "pitch")]
        drop = min(ranges.get("z") or (0.0, 0.0))
        poses = itertools.product(*tilts, joints)
        depth = -min(_lowest(robot, float(roll), float(pitch), pose) for roll, pitch, pose in poses) - float(drop)
        start = -case.facts.clearance  # what spawn_height tells of
        if depth > _DEPTH * robot.anatomy.size and depth > start + _DEPTH * robot.anatomy.size:
            height = float(case.env["robot"]["init_state"]["pos"][2])
            right = at_least(height + depth, 4)
            yield Finding(
                f"{term.path}.pose_range",
                f"drawn starts reach {1e3 * depth:.3g} mm into the ground",
                f"narrower ranges of z, roll and pitch, or env.robot.init_state.pos with a height of {right:g} m",
                {"depth_m": depth},
            )


def _drawn_joints(case: Case, robot: CompiledRobot) -> Iterator[dict[str, float]]:
    """Yield the default joint positions, and the extremes that resets draw."""
    yield {}
    for kind in ("scale", "offset"):
        for term in case.terms("events", f"events.reset_joints_by_{kind}"):
            for value in map(float, term.node["position_range"]):
                yield {
                    name: joint.default * value if kind == "scale" else joint.default + value
                    for name, joint in case.joints(term.node).items()
                    if name not in robot.anatomy.wheel_joints
                }


def _lowest(robot: CompiledRobot, roll: float, pitch: float, joints: Mapping[str, float]) -> float:
    model, data = robot.model, mujoco.MjData(robot.model)
    data.qpos[:] = robot.data.qpos
    for name, value in joints.items():
        joint = model.joint(name)
        low, high = model.jnt_range[joint.id] if model.jnt_limited[joint.id] else (-np.inf, np.inf)
        data.qpos[joint.qposadr[0]] = min(max(value, low), high)
    turn, quat = np.zeros(4), np.zeros(4)
    mujoco.mju_euler2Quat(turn, np.array([roll, pitch, 0.0]), "XYZ")  # as resets do: about fixed axes
    start = int(model.jnt_qposadr[model.body(robot.anatomy.base).jntadr[0]]) + 3
    mujoco.mju_mulQuat(quat, data.qpos[start : start + 4], turn)
    data.qpos[start : start + 4] = quat
    mujoco.mj_kinematics(model, data)
    return lowest_point(model, data, [model.body(name).id for name in robot.bodies])
