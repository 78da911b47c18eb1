"""A compiled robot at the pose where its episodes begin, and all that is known of it."""

from __future__ import annotations

import copy
from collections.abc import Collection
from dataclasses import dataclass

import mujoco

from wheelleg_exp.asset.report import Report
from wheelleg_exp.lint.anatomy.examine import anatomy_of
from wheelleg_exp.lint.anatomy.parts import Anatomy
from wheelleg_exp.lint.robot_facts import RobotFacts, at_default, measure
from wheelleg_exp.sim.robot import Robot


@dataclass(frozen=True)
class CompiledRobot:
    """A robot in its scene.

    Attributes:
        model: the compiled scene.
        data: the robot where episodes begin, with everything computed that follows from its pose.
        bodies: its links.
        drawn: its anatomy in the pose that the file draws, all joints at their zero.
        anatomy: its anatomy where episodes begin.
        report: what its conversion read, assumed and left out; None of an MJCF.
    """

    model: mujoco.MjModel
    data: mujoco.MjData
    bodies: tuple[str, ...]
    drawn: Anatomy
    anatomy: Anatomy
    report: Report | None

    def position(self, joint: str) -> float:
        """Return where a joint begins, rad (m)."""
        return float(self.data.qpos[self.model.joint(joint).qposadr[0]])

    def zero(self, joint: str) -> float:
        """Return where the file draws a joint, rad (m)."""
        return float(self.model.qpos0[self.model.joint(joint).qposadr[0]])


def with_written_limits(model: mujoco.MjModel, report: Report | None) -> mujoco.MjModel:
    """Return a copy of a model with the limits that its URDF writes at continuous joints, which never act.

    The last joint of a chain has none: it may be a wheel.
    """
    model = copy.copy(model)
    for item in report.findings if report is not None else ():
        if item.kind == "limits_ignored" and model.joint(item.subject).dofadr[0] in model.dof_parentid:
            joint = model.joint(item.subject).id
            model.jnt_limited[joint], model.jnt_range[joint] = True, (item.numbers["lower"], item.numbers["upper"])
    return model


def compiled_robot(
    model: mujoco.MjModel, robot: Robot, report: Report | None = None, driven: Collection[str] | None = None
) -> tuple[CompiledRobot, RobotFacts]:
    """Return a robot of a compiled scene, and its facts.

    Args:
        model: the compiled scene.
        robot: the robot that the scene was compiled with.
        report: of its conversion.
        driven: the joints that the robot's file drives, for a robot without actuators; None if the file has no drives.
    """
    data = at_default(model, robot)
    driven = [name for actuator in robot.actuators.values() for name in actuator.joint_names] or driven or None
    drawn_pose = model.qpos0.copy()
    drawn_pose[:7] = data.qpos[:7] if robot.floating else drawn_pose[:7]
    limited = with_written_limits(model, report)
    anatomy = anatomy_of(limited, data.qpos, driven)
    drawn = anatomy_of(limited, drawn_pose, driven)
    found = CompiledRobot(model, data, tuple(robot.body_names), drawn, anatomy, report)
    return found, measure(model, robot, anatomy)
