"""A compiled robot at its default pose: anatomy, masses, inertias, heights, and drives."""

from __future__ import annotations

import copy
import math
import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import chain

import mujoco
import numpy as np

from wheelleg_exp.anatomy.anatomy_parts import Anatomy, Array
from wheelleg_exp.anatomy.collider_shapes import lowest_point
from wheelleg_exp.anatomy.robot_anatomy import anatomy_of
from wheelleg_exp.asset.conversion_report import Report
from wheelleg_exp.asset.mjcf.coupled_positions import RANK, JointCouplings, constraint_rows
from wheelleg_exp.sim.actuators import IdealPDActuator
from wheelleg_exp.sim.robot import Robot

LOST_MESH = re.compile(r"collider was left out: mesh '([^']*)': (.*)")
_MOST_FILES = 4  # files in one message
_EXACT = 1e-9
_WEAK, _NO_DRIVE = 1e-3, 1e-9  # the stiffness of drives without stiffness, and of joints without a drive, N·m/rad


@dataclass(frozen=True)
class Drive:
    """The actuator of one joint: kp, N·m/rad, kd, N·m·s/rad, largest torque, N·m, and largest speed, rad/s.

    ``stiffness`` and ``damping`` are NaN for a neural network. An ``explicit`` torque is computed before each step.
    """

    group: str
    stiffness: float
    damping: float
    effort: float
    velocity: float
    explicit: bool = False


Drives = Mapping[str, Drive | None]


@dataclass(frozen=True)
class Joint:
    """The state, limits, and inertias of one joint; ``low`` and ``high`` are infinite for a joint without limits."""

    default: float
    default_velocity: float
    low: float
    high: float
    armature: float  # reflected rotor inertia, kg·m²
    inertia: float  # inertia about the joint's axis of all links that the joint moves, kg·m², without armature
    effective: float  # the effective inertia at the joint while all other joints are free, kg·m², with armature
    hold: float  # the joint's torque while the robot stands still in its default pose, N·m
    drive: Drive | None  # the joint's actuator, or None

    @property
    def limited(self) -> bool:
        return math.isfinite(self.low) and math.isfinite(self.high)


@dataclass(frozen=True)
class Balance:
    """The inverted pendulum that is equivalent to a robot on one axle.

    ``mass``, kg, ``inertia`` about the axle, kg·m², and ``height`` of the centre of mass above the axle, m, are those
    without the wheels. With locked wheel joints, the robot tips over at the exponential rate ``pole``, rad/s; with a
    fixed axle, at ``pendulum`` = sqrt(``mass`` · gravity · ``height`` / ``inertia``), rad/s.
    """

    mass: float
    height: float
    inertia: float
    pole: float
    pendulum: float


@dataclass(frozen=True)
class RobotFacts:
    """Facts of the whole robot, with ``mass`` in kg, ``gravity`` in m/s², and the robot's joints by name."""

    mass: float
    gravity: float
    joints: dict[str, Joint]
    wheels: tuple[str, ...]  # the names of the wheels' joints; ``wheel_radius`` (m) is 0 for a robot without wheels
    wheel_radius: float
    track: float  # the distance between the leftmost and the rightmost wheel, m
    # ``standing_height`` is the root link's height above the ground, m, if the robot stands in its default pose.
    standing_height: float
    clearance: float  # the height of the robot's lowest point above the ground at the start of an episode, m
    friction: float  # the effective friction coefficient between wheels and ground
    balance: Balance | None  # the robot's inverted pendulum; None for a robot that does not have exactly one axle

    @property
    def weight(self) -> float:
        """Weight, N."""
        return self.mass * self.gravity

    @property
    def wheel_load(self) -> float:
        """The robot's weight per wheel, N; for a robot without wheels, its whole weight."""
        return self.weight / max(1, len(self.wheels))

    @property
    def top_speed(self) -> float:
        """The robot's speed at the velocity limit of the wheels, m/s; 0 for a robot without driven wheels."""
        speeds = [drive.velocity for name in self.wheels if (drive := self.joints[name].drive) is not None]
        return min(speeds) * self.wheel_radius if speeds else 0.0


def measure(model: mujoco.MjModel, robot: Robot, anatomy: Anatomy, drives: Drives | None = None) -> RobotFacts:
    """Measure a compiled robot at its default pose; ``drives`` replaces the drives of a config without actuators."""
    data = at_default(model, robot)
    gravity = float(np.linalg.norm(model.opt.gravity))
    bodies = [model.body(name).id for name in robot.body_names]
    wheels, radius = anatomy.wheel_joints, max((wheel.radius for wheel in anatomy.wheels), default=0.0)
    lowest = lowest_point(model, data, bodies)
    root_height = float(data.xpos[bodies[0]][2])
    solid = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
    values = model.geom_friction[np.isin(model.geom_bodyid, list(chain(*_turned(model, anatomy))) or bodies) & solid, 0]
    return RobotFacts(
        mass=float(model.body_mass[bodies].sum()),
        gravity=gravity,
        joints=_joints(model, data, robot, _turned(model, anatomy), drives or _drives(robot)),
        wheels=tuple(wheels),
        wheel_radius=radius,
        track=anatomy.support_width,
        standing_height=root_height - lowest if math.isfinite(lowest) else root_height,
        clearance=lowest,
        friction=float(values.min()) if len(values) else 0.0,
        balance=_balance(model, data, bodies, anatomy, gravity),
    )


def at_default(model: mujoco.MjModel, robot: Robot) -> mujoco.MjData:
    """Return MuJoCo's data of a robot at the start of an episode, moved inside its joint limits and couplings."""
    data = mujoco.MjData(model)
    if robot.floating:
        data.qpos[0:3] = robot.default_root_pos.cpu().numpy()
        data.qpos[3:7] = robot.default_root_quat.cpu().numpy()
    for name, value in zip(robot.joint_names, robot.layout.default_joint_pos.tolist(), strict=True):
        joint = model.joint(name)
        inside = min(max(value, joint.range[0]), joint.range[1]) if model.jnt_limited[joint.id] else value
        data.qpos[joint.qposadr[0]] = inside
    JointCouplings(model).follow(data.qpos)
    mujoco.mj_forward(model, data)
    return data


def _turned(model: mujoco.MjModel, anatomy: Anatomy) -> list[list[int]]:
    return [[model.body(name).id for name in wheel.bodies] for wheel in anatomy.standing]


def _drives(robot: Robot) -> dict[str, Drive | None]:
    drives: dict[str, Drive | None] = {}
    for group, actuator in robot.actuators.items():
        gains = (actuator.stiffness, actuator.damping, actuator.effort_limit, actuator.velocity_limit)
        explicit = isinstance(actuator, IdealPDActuator)
        for index, name in enumerate(actuator.joint_names):
            # Round gains and limits to seven digits, because they are float32 numbers.
            kp, kd, effort, velocity = (float(f"{float(values[index]):.7g}") for values in gains)
            drives[name] = Drive(group, kp, kd, effort, velocity, explicit)
    return drives


def _joints(
    model: mujoco.MjModel, data: mujoco.MjData, robot: Robot, wheels: Sequence[Sequence[int]], drives: Drives
) -> dict[str, Joint]:
    matrix = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, matrix)
    constraints, inverse = constraint_rows(model, data), np.linalg.inv(matrix)
    mobility, followers = _mobility(matrix, constraints), JointCouplings(model).followers
    stiffness = {model.joint(name).id: drive.stiffness for name, drive in drives.items() if drive is not None}
    # Without any drives, all joints except followers count as driven.
    driven = set(stiffness) or {model.joint(name).id for name in robot.joint_names} - followers
    # ``hold`` (nv,): the joint torques that keep the robot in its default pose, with equal weight on all wheels
    hold = data.qfrc_bias - data.qfrc_passive
    share = float(model.body_mass.sum() * np.linalg.norm(model.opt.gravity)) / max(1, len(wheels))
    # The z row of the Jacobian of a wheel's lowest point converts the ground's vertical force to joint torques.
    for bodies in wheels:
        point = data.xpos[bodies[0]].copy()
        point[2] = lowest_point(model, data, bodies)
        jacobian = np.zeros((3, model.nv))
        mujoco.mj_jac(model, data, jacobian, None, point, bodies[0])
        hold -= jacobian[2] * share
    # The forces of couplings and closed loops carry the load of joints without a drive to the drives. Several drives
    # share a load in proportion to their stiffness, as springs do; a drive without stiffness counts as a weak spring.
    stiff = np.array([max(_WEAK, stiffness.get(j, 0.0)) if j in driven else _NO_DRIVE for j in model.dof_jntid])
    root = np.sqrt(stiff)
    hold -= constraints.T @ np.linalg.lstsq(constraints.T / root[:, None], hold / root, rcond=_EXACT)[0]
    passive = [dof for dof, j in enumerate(model.dof_jntid.tolist()) if j not in driven or j in followers]
    coupled = [dof for dof in passive if np.abs(constraints[:, dof]).max(initial=0.0) > RANK]
    # Constraints can lock a joint; its inertias are those without constraints.
    free = np.where(mobility > _EXACT * inverse, mobility, inverse).diagonal()
    joints = {}
    for index, name in enumerate(robot.joint_names):
        joint, dof = model.joint(name), int(model.joint(name).dofadr[0])
        low, high = model.jnt_range[joint.id].tolist() if model.jnt_limited[joint.id] else (-math.inf, math.inf)
        armature, alone = float(model.dof_armature[dof]), float(matrix[dof, dof])
        default, speed = float(data.qpos[joint.qposadr[0]]), float(robot.layout.default_joint_vel[index])
        # The joint moves coupled joints without a drive, while all other joints stand still.
        moved = [dof, *(other for other in coupled if other != dof)]
        together = float(_mobility(matrix[np.ix_(moved, moved)], constraints[:, moved])[0, 0])
        load, effective = (1.0 / together if together * alone > _EXACT else alone) - armature, 1.0 / float(free[dof])
        drive = drives.get(name)
        joints[name] = Joint(default, speed, low, high, armature, load, effective, float(hold[dof]), drive)
    return joints


def _mobility(matrix: Array, constraints: Array) -> Array:
    """Return the accelerations per force (n, n) of a mass matrix (n, n), with constraints of the velocities (r, n)."""
    _, sizes, rows = np.linalg.svd(constraints)
    free = rows[np.count_nonzero(sizes > RANK) :].T
    return np.asarray(free @ np.linalg.inv(free.T @ matrix @ free) @ free.T)


def _balance(
    model: mujoco.MjModel, data: mujoco.MjData, bodies: Sequence[int], anatomy: Anatomy, gravity: float
) -> Balance | None:
    """Return the inverted pendulum of a robot on one axle; None if the robot has no wheels or several axles."""
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
    # The wheels of a falling robot roll, so the inertia about the ground contact includes the wheels.
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
    """A robot in its compiled MuJoCo scene; ``data`` is MuJoCo's data at the start of an episode.

    ``drawn`` describes the robot's wheels and legs in the robot file's pose, and ``anatomy`` at the start of an
    episode. ``report`` is the report of the conversion from USD or URDF; None if the robot file is an MJCF file.
    ``moved`` maps the joints that the file's pose puts outside their limits to their positions in that pose, rad (m).
    """

    model: mujoco.MjModel
    data: mujoco.MjData
    bodies: tuple[str, ...]
    drawn: Anatomy
    anatomy: Anatomy
    report: Report | None
    moved: Mapping[str, float] = field(default_factory=dict)

    def position(self, joint: str) -> float:
        """Return a joint's position at the start of episodes, rad (m)."""
        return float(self.data.qpos[self.model.joint(joint).qposadr[0]])

    def zero(self, joint: str) -> float:
        """Return a joint's position in the pose of the robot's file, rad (m)."""
        return float(self.model.qpos0[self.model.joint(joint).qposadr[0]])


def with_written_limits(model: mujoco.MjModel, report: Report | None) -> mujoco.MjModel:
    """Copy a model with the URDF's limits of continuous joints; ends of chains, which can be wheels, stay unlimited."""
    model = copy.copy(model)
    for item in report.findings if report is not None else ():
        if item.kind == "limits_ignored" and model.joint(item.subject).dofadr[0] in model.dof_parentid:
            joint = model.joint(item.subject).id
            model.jnt_limited[joint], model.jnt_range[joint] = True, (item.numbers["lower"], item.numbers["upper"])
    return model


def compiled_robot(
    model: mujoco.MjModel, robot: Robot, report: Report | None = None, driven: Collection[str] | None = None
) -> tuple[CompiledRobot, RobotFacts]:
    """Return the robot of a compiled scene, and measured facts such as its mass and wheel radius.

    ``driven`` names the joints with a motor in the robot file; None stands for a robot file without motors. ``driven``
    has no effect if the robot's config defines actuators.
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


def name_expression(name: str) -> str:
    """Return a regular expression that matches only the text ``name``."""
    return name if re.fullmatch(r"[\w /:-]*", name) else re.escape(name)


def provisional_robot(name: str, rotation: Sequence[float], positions: Mapping[str, float]) -> dict[str, object]:
    """Return a config section ``env.robot`` without actuators, with the default joint positions ``positions``."""
    joint_pos = {name_expression(joint): value for joint, value in positions.items()}
    state = {"pos": [0.0, 0.0, 0.0], "rot": list(rotation), "joint_pos": joint_pos, "joint_vel": {}}
    return {
        "profile": "survey",
        "asset": name,
        "base": "auto",
        "init_state": state,
        "joint_order": None,
        "soft_joint_pos_limit_factor": 1.0,
        "friction_source": "static",
        "actuators": {},
    }


def missing_colliders(report: Report, model: mujoco.MjModel) -> str:
    """Return a text that names colliders and wheels with missing or damaged mesh files; empty if there are none."""
    files = {match[1]: match[2] for text in report.warnings if (match := LOST_MESH.search(text))}
    bare = [item.subject for item in report.findings if item.kind == "end_without_collider"]
    if any(item.kind == "no_colliders" for item in report.findings):
        ends = zip(model.jnt_bodyid, model.jnt_dofadr, strict=True)
        bare = [model.body(int(body)).name for body, dof in ends if dof not in model.dof_parentid]
    layers = [item for item in report.findings if item.kind == "layer_not_found" and not item.numbers["looks"]]
    files |= {item.subject: "the layer is missing" for item in layers if bare}
    if not files:
        return ""
    hinges = [int(model.body(name).jntadr[0]) for name in bare if model.body(name).jntnum[0] == 1]
    endless = [j for j in hinges if model.jnt_type[j] == mujoco.mjtJoint.mjJNT_HINGE and not model.jnt_limited[j]]
    wheels = [repr(model.joint(j).name) for j in endless]
    named = [f"{name} ({reason})" for name, reason in files.items()]
    text = "colliders are missing: " + ", ".join(named[:_MOST_FILES]) + (", ..." if len(named) > _MOST_FILES else "")
    return text + (f"; {', '.join(wheels)} turn without limits as wheels do, but have no collider" if wheels else "")
