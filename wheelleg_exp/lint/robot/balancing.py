"""Where the weight lies over the wheels, and the pose of the legs that puts it over the axle."""

from __future__ import annotations

import math
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from wheelleg_exp.lint.robot.compiled import CompiledRobot

Array = NDArray[np.float64]

_PITCH = 0.9  # cosine between a joint's axis and the axle, from which on it moves the weight forwards
_STEP = 1e-5  # rad
_ROUNDS = 40
_LONGEST = 0.2  # rad in one round
_EXACT = 1e-6  # m
_INSIDE = 0.02  # of a joint's range that stays free at its ends
_DIGITS = 3


@dataclass(frozen=True)
class Weight:
    """The centre of mass of all but the wheels, against the middle of the axle.

    Attributes:
        ahead: along the forward axis, m.
        above: upwards, m.
        place: world, m, (3,).
    """

    ahead: float
    above: float
    place: Array

    @property
    def lean(self) -> float:
        """Angle from the upright to the line from the axle to the centre of mass, rad; positive to the front."""
        return math.atan2(self.ahead, self.above)


def weight_over_axle(robot: CompiledRobot, qpos: Array | None = None) -> Weight:
    """Return where the weight lies; of a robot with wheels that roll one way.

    Args:
        robot: the robot.
        qpos: another pose than that where episodes begin, (nq,).
    """
    model, anatomy = robot.model, robot.anatomy
    data = robot.data if qpos is None else _at(model, qpos)
    base = data.xmat[model.body(anatomy.base).id].reshape(3, 3)
    turned = {model.body(name).id for wheel in anatomy.standing for name in wheel.bodies}
    upper = [body for body in (model.body(name).id for name in robot.bodies) if body not in turned]
    mass = model.body_mass[upper]
    place = mass @ data.xipos[upper] / mass.sum()
    wheels = [wheel.joint for wheel in anatomy.standing]
    axle = np.mean([data.xanchor[model.joint(name).id] for name in wheels], axis=0)
    arm = base.T @ (place - axle)
    return Weight(float(arm @ np.array(anatomy.forward)), float(arm @ np.array(anatomy.up)), place)


def balanced_pose(robot: CompiledRobot) -> dict[str, float] | None:
    """Return leg positions that put the weight over the axle while the base stays level; None when there are none.

    Of all such poses near the present one, that with the same height of the base where there is one. Joints move as
    mirrored pairs; legs with closed loops are left alone, because their joints cannot move one by one.

    Method: Newton's, with steps of least norm, on the kinematics.
    """
    pairs = _movable(robot)
    if not pairs:
        return None
    for keeps_height in (True, False):
        found = _solved(robot, pairs, keeps_height=keeps_height)
        if found is not None:
            return found
    return None


def _movable(robot: CompiledRobot) -> list[tuple[str, str, int]]:
    """Return the mirrored pairs of driven joints that turn the legs about the axle's direction."""
    anatomy = robot.anatomy
    if anatomy.left is None or any(leg.loops for leg in anatomy.legs):
        return []
    usable = {name for leg in anatomy.legs for name in leg.joints if name not in leg.passive}
    base = robot.data.xmat[robot.model.body(anatomy.base).id].reshape(3, 3)
    left = base @ np.array(anatomy.left)
    found = []
    for pair in robot.drawn.mirrored:
        axes = [robot.data.xaxis[robot.model.joint(name).id] for name in (pair.left, pair.right)]
        if {pair.left, pair.right} <= usable and all(abs(float(axis @ left)) > _PITCH for axis in axes):
            found.append((pair.left, pair.right, pair.sign))
    return found


def _solved(robot: CompiledRobot, pairs: list[tuple[str, str, int]], *, keeps_height: bool) -> dict[str, float] | None:
    start = _height(robot, robot.data.qpos)

    def error(qpos: Array) -> Array:
        ahead = weight_over_axle(robot, qpos).ahead
        return np.array([ahead, _height(robot, qpos) - start] if keeps_height else [ahead])

    qpos = robot.data.qpos.copy()
    for _ in range(_ROUNDS):
        here = error(qpos)
        if np.abs(here).max() < _EXACT:
            return _told(robot, pairs, qpos)
        slope = np.array([(error(_moved(robot, qpos, pair, _STEP)) - here) / _STEP for pair in pairs]).T
        steps = np.linalg.lstsq(slope, -here, rcond=1e-6)[0]
        steps *= min(1.0, _LONGEST / max(float(np.abs(steps).max()), 1e-12))
        for pair, step in zip(pairs, steps, strict=True):
            qpos = _moved(robot, qpos, pair, float(step))
    return None


def _moved(robot: CompiledRobot, qpos: Array, pair: tuple[str, str, int], step: float) -> Array:
    left, right, sign = pair
    moved = qpos.copy()
    for name, by in ((left, step), (right, sign * step)):
        joint = robot.model.joint(name)
        place = moved[joint.qposadr[0]] + by
        if robot.model.jnt_limited[joint.id]:
            low, high = robot.model.jnt_range[joint.id]
            margin = _INSIDE * (high - low)
            place = min(max(place, low + margin), high - margin)
        moved[joint.qposadr[0]] = place
    return moved


def _told(robot: CompiledRobot, pairs: list[tuple[str, str, int]], qpos: Array) -> dict[str, float]:
    names = [name for left, right, _ in pairs for name in (left, right)]
    return {name: round(float(qpos[robot.model.joint(name).qposadr[0]]), _DIGITS) + 0.0 for name in names}


def _height(robot: CompiledRobot, qpos: Array) -> float:
    """Return the height of the base over the axle, m."""
    data = _at(robot.model, qpos)
    wheels = [wheel.joint for wheel in robot.anatomy.standing]
    axle = np.mean([data.xanchor[robot.model.joint(name).id] for name in wheels], axis=0)
    base = robot.model.body(robot.anatomy.base).id
    up = data.xmat[base].reshape(3, 3) @ np.array(robot.anatomy.up)
    return float((data.xpos[base] - axle) @ up)


def _at(model: mujoco.MjModel, qpos: Array) -> mujoco.MjData:
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    return data
