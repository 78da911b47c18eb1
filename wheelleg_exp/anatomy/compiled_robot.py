"""A compiled robot at its default pose: anatomy, masses, inertias, heights, and drives."""

from __future__ import annotations

import copy
import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from itertools import chain

import mujoco
import numpy as np

from wheelleg_exp.anatomy.anatomy_parts import Anatomy
from wheelleg_exp.anatomy.collider_shapes import lowest_point
from wheelleg_exp.anatomy.robot_anatomy import anatomy_of
from wheelleg_exp.asset.conversion_report import Report
from wheelleg_exp.sim.actuators import IdealPDActuator
from wheelleg_exp.sim.robot import Robot


@dataclass(frozen=True)
class Drive:
    """The actuator of one joint.

    Attributes:
        group: the actuator group.
        stiffness: kp, N·m/rad; NaN where the drive is learned.
        damping: kd, N·m·s/rad; likewise.
        effort: largest torque, N·m.
        velocity: largest speed, rad/s.
        explicit: whether the torque is computed from the state before each physics step.
    """

    group: str
    stiffness: float
    damping: float
    effort: float
    velocity: float
    explicit: bool = False


@dataclass(frozen=True)
class Joint:
    """One joint at the default pose.

    Attributes:
        default: default position, rad.
        default_velocity: default velocity, rad/s.
        low: lower limit, rad, or -inf.
        high: upper limit, rad, or inf.
        armature: kg·m².
        inertia: of what hangs on the joint, about its axis, kg·m², without armature.
        effective: inertia that a torque on the joint meets while everything else is free to move, with armature.
        hold: torque that carries the weight at rest, N·m.
        drive: its actuator, or None.
    """

    default: float
    default_velocity: float
    low: float
    high: float
    armature: float
    inertia: float
    effective: float
    hold: float
    drive: Drive | None

    @property
    def limited(self) -> bool:
        """Whether the joint's angle is bounded."""
        return math.isfinite(self.low) and math.isfinite(self.high)


@dataclass(frozen=True)
class Balance:
    """A robot on one axle as an inverted pendulum.

    Attributes:
        mass: of all but the wheels, kg.
        height: of its centre of mass over the axle, m.
        inertia: of all but the wheels about the axle, kg·m².
        pole: rate at which it falls while the wheels are held against the body and roll, rad/s.
        pendulum: sqrt(m g h / I): rate at which it falls over a fixed axle, rad/s.
    """

    mass: float
    height: float
    inertia: float
    pole: float
    pendulum: float


@dataclass(frozen=True)
class RobotFacts:
    """Facts of the whole robot.

    Attributes:
        mass: kg.
        gravity: m/s².
        joints: by name, in the robot's order.
        wheels: names of the joints that wheels turn on.
        wheel_radius: m; 0 without wheels.
        track: distance between the outermost wheels, m.
        standing_height: of the root over the ground while the lowest point of the default pose touches it, m.
        clearance: of the lowest point over the ground where episodes begin, m; negative inside the ground.
        friction: effective coefficient between wheels and ground.
        balance: None when the robot does not balance on one axle.
    """

    mass: float
    gravity: float
    joints: dict[str, Joint]
    wheels: tuple[str, ...]
    wheel_radius: float
    track: float
    standing_height: float
    clearance: float
    friction: float
    balance: Balance | None

    @property
    def weight(self) -> float:
        """Weight, N."""
        return self.mass * self.gravity

    @property
    def wheel_load(self) -> float:
        """Weight on each wheel when all carry alike, N; the whole weight without wheels."""
        return self.weight / max(1, len(self.wheels))

    @property
    def top_speed(self) -> float:
        """Speed at the wheels' velocity limit, m/s; 0 when nothing drives a wheel."""
        speeds = [drive.velocity for name in self.wheels if (drive := self.joints[name].drive) is not None]
        return min(speeds) * self.wheel_radius if speeds else 0.0


def measure(model: mujoco.MjModel, robot: Robot, anatomy: Anatomy | None = None) -> RobotFacts:
    """Measure a robot at its default pose.

    Args:
        model: the compiled scene.
        robot: the robot that the scene was compiled with.
        anatomy: what its parts are for, where that is known already.
    """
    data = at_default(model, robot)
    anatomy = anatomy or anatomy_of(model, data.qpos)
    gravity = float(np.linalg.norm(model.opt.gravity))
    bodies = [model.body(name).id for name in robot.body_names]
    wheels, radius = anatomy.wheel_joints, max((wheel.radius for wheel in anatomy.wheels), default=0.0)
    lowest = lowest_point(model, data, bodies)
    root_height = float(data.xpos[bodies[0]][2])
    return RobotFacts(
        mass=float(model.body_mass[bodies].sum()),
        gravity=gravity,
        joints=_joints(model, data, robot, _turned(model, anatomy), gravity),
        wheels=tuple(wheels),
        wheel_radius=radius,
        track=anatomy.support_width,
        standing_height=root_height - lowest if math.isfinite(lowest) else root_height,
        clearance=lowest,
        friction=_friction(model, list(chain(*_turned(model, anatomy))) or bodies),
        balance=_balance(model, data, bodies, anatomy, gravity),
    )


def at_default(model: mujoco.MjModel, robot: Robot) -> mujoco.MjData:
    """Return a robot where its episodes begin, with everything computed that follows from its pose."""
    data = mujoco.MjData(model)
    if robot.floating:
        data.qpos[0:3] = robot.default_root_pos.numpy()
        data.qpos[3:7] = robot.default_root_quat.numpy()
    for name, value in zip(robot.joint_names, robot.layout.default_joint_pos.tolist(), strict=True):
        data.qpos[model.joint(name).qposadr[0]] = value
    mujoco.mj_forward(model, data)
    return data


def _turned(model: mujoco.MjModel, anatomy: Anatomy) -> list[list[int]]:
    """Return the bodies of each wheel that carries the robot."""
    return [[model.body(name).id for name in wheel.bodies] for wheel in anatomy.standing]


def _friction(model: mujoco.MjModel, bodies: Sequence[int]) -> float:
    solid = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
    values = model.geom_friction[np.isin(model.geom_bodyid, bodies) & solid, 0]
    return float(values.min()) if len(values) else 0.0


def _joints(
    model: mujoco.MjModel, data: mujoco.MjData, robot: Robot, wheels: Sequence[Sequence[int]], gravity: float
) -> dict[str, Joint]:
    matrix = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, matrix)
    inverse = np.linalg.inv(matrix)
    hold = _holding_torques(model, data, wheels, gravity)
    drives = _drives(robot)
    joints = {}
    for index, name in enumerate(robot.joint_names):
        joint, dof = model.joint(name), int(model.joint(name).dofadr[0])
        low, high = model.jnt_range[joint.id].tolist() if model.jnt_limited[joint.id] else (-math.inf, math.inf)
        armature = float(model.dof_armature[dof])
        joints[name] = Joint(
            default=float(robot.layout.default_joint_pos[index]),
            default_velocity=float(robot.layout.default_joint_vel[index]),
            low=low,
            high=high,
            armature=armature,
            inertia=float(matrix[dof, dof]) - armature,
            effective=1.0 / float(inverse[dof, dof]),
            hold=float(hold[dof]),
            drive=drives.get(name),
        )
    return joints


def _holding_torques(
    model: mujoco.MjModel, data: mujoco.MjData, wheels: Sequence[Sequence[int]], gravity: float
) -> np.ndarray:
    """Return the torques (nv,) that hold the default pose while each wheel carries an equal share of the weight."""
    torques = data.qfrc_bias.copy()
    share = float(model.body_mass.sum()) * gravity / max(1, len(wheels))
    for bodies in wheels:
        point = data.xpos[bodies[0]].copy()
        point[2] = lowest_point(model, data, bodies)
        jacobian = np.zeros((3, model.nv))
        mujoco.mj_jac(model, data, jacobian, None, point, bodies[0])
        torques -= jacobian[2] * share
    return torques


def _drives(robot: Robot) -> dict[str, Drive]:
    drives = {}
    for group, actuator in robot.actuators.items():
        gains = (actuator.stiffness, actuator.damping, actuator.effort_limit, actuator.velocity_limit)
        explicit = isinstance(actuator, IdealPDActuator)
        for index, name in enumerate(actuator.joint_names):
            kp, kd, effort, velocity = (float(f"{float(values[index]):.7g}") for values in gains)  # float32
            drives[name] = Drive(group, kp, kd, effort, velocity, explicit)
    return drives


def _balance(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    bodies: Sequence[int],
    anatomy: Anatomy,
    gravity: float,
) -> Balance | None:
    """Return the robot as a pendulum over its axle; None without wheels or when they do not share one axle."""
    if not anatomy.one_axle:
        return None
    radius = max(wheel.radius for wheel in anatomy.standing)
    joint_ids = [model.joint(wheel.joint).id for wheel in anatomy.standing]
    axis, anchors = data.xaxis[joint_ids[0]], data.xanchor[joint_ids]
    wheel_bodies = list(chain(*_turned(model, anatomy)))
    upper = [body for body in bodies if body not in wheel_bodies]
    mass = float(model.body_mass[upper].sum())
    arm = (model.body_mass[upper] @ (data.xipos[upper] - anchors[0])) / mass
    height = float(np.linalg.norm(arm - (arm @ axis) * axis))
    inertia = sum(_inertia_about(model, data, body, anchors[0], axis) for body in upper)
    rolling = sum(
        float(model.body_mass[body]) * radius**2 + _inertia_about(model, data, body, data.xipos[body], axis)
        for body in wheel_bodies
    )
    drop = mass * gravity * height
    about_ground = inertia + 2 * mass * radius * height + mass * radius**2 + rolling
    return Balance(mass, height, inertia, math.sqrt(drop / about_ground), math.sqrt(drop / inertia))


def _inertia_about(model: mujoco.MjModel, data: mujoco.MjData, body: int, point: np.ndarray, axis: np.ndarray) -> float:
    """Return a body's moment of inertia about an axis through a point (parallel axis theorem), kg·m²."""
    local = data.ximat[body].reshape(3, 3).T @ axis
    own = float(local**2 @ model.body_inertia[body])
    arm = data.xipos[body] - point
    distance2 = float(arm @ arm - (arm @ axis) ** 2)
    return own + float(model.body_mass[body]) * distance2


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
