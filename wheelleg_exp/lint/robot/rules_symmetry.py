"""Left against right: wheels that turn against each other, links that are no mirror images, lopsided poses."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any

import mujoco
import numpy as np

from wheelleg_exp.lint.anatomy.parts import MirroredPair
from wheelleg_exp.lint.case import Case
from wheelleg_exp.lint.findings import Finding, rule
from wheelleg_exp.lint.robot.compiled import CompiledRobot

_ASSET = "env.robot.asset"
_PLACE = 0.015  # of the robot's size: between a joint and the image of the other side's
_TILT = math.radians(2)
_MASS = 0.1  # of the larger
_CENTRE = 0.02  # of the robot's size: between centres of mass
_ANGLE = 0.02  # rad, between limits or positions of two sides
_NEGLIGIBLE = 0.01  # of the robot's mass: a link whose centre of mass says little
_ALONG = 0.9  # cosine: a joint that turns about the wheels' axle
_HINT = "the same numbers on both sides of the file, with y and the signs of turns mirrored"
_MOST = 4  # findings of one kind


@rule
def wheel_senses(case: Case) -> Iterator[Finding]:
    """Wheels that turn in opposite senses while the robot rolls one way, and legs beside them that do not.

    One unit of action then drives one side forwards and the other back. Where every joint of one side turns the
    other way round, it is the file's convention, and nothing is said. Source: kinematics, v = omega x r.
    """
    robot = case.robot
    if robot is None:
        return
    anatomy = robot.drawn
    signs = {wheel.joint: wheel.sign for wheel in anatomy.wheels if not wheel.caster and wheel.sign}
    for pair in anatomy.mirrored:
        if pair.left == pair.right or signs.get(pair.left, 0) * signs.get(pair.right, 0) >= 0:
            continue
        if _legs_turn_alike(robot, pair) and not _compensated(case, pair):
            scale = f"{{{pair.left}: {signs[pair.left]:g}, {pair.right}: {signs[pair.right]:g}}}"
            yield Finding(
                _ASSET,
                f"positive speed of '{pair.left}' rolls the robot {_way(signs[pair.left])}, of '{pair.right}' "
                f"{_way(signs[pair.right])}, though the legs above them turn alike",
                f"the axis of one of them the other way round in the file, or an action's scale times {scale}",
            )


def _legs_turn_alike(robot: CompiledRobot, wheels: MirroredPair) -> bool:
    """Return whether the last joints of two legs that turn about the wheels' axle turn alike, or there are none."""
    anatomy, left = robot.drawn, np.array(robot.drawn.left)
    chain = {leg.wheel: leg.joints for leg in anatomy.legs}[wheels.left]
    signs = {
        name: pair.sign for pair in anatomy.mirrored if pair.left != pair.right for name in (pair.left, pair.right)
    }
    alike = [signs[name] > 0 for name in chain if name in signs and abs(float(_axis(robot, name) @ left)) > _ALONG]
    return not alike or alike[-1]


def _axis(robot: CompiledRobot, joint: str) -> np.ndarray:
    model = robot.model
    base = robot.data.xmat[model.body(robot.anatomy.base).id].reshape(3, 3)
    axis: np.ndarray = base.T @ robot.data.xaxis[model.joint(joint).id]
    return axis


def _compensated(case: Case, pair: MirroredPair) -> bool:
    """Return whether an action gives the two wheels scales of opposite signs."""
    for term in case.terms("actions"):
        scale: Any = term.node.get("scale")
        if isinstance(scale, Mapping):
            found = case.by_joint(scale, [pair.left, pair.right], 1.0)
            if found[pair.left] * found[pair.right] < 0:
                return True
    return False


def _way(sign: int) -> str:
    return "forwards" if sign > 0 else "backwards"


@rule
def mirror_images(case: Case) -> Iterator[Finding]:
    """Legs of the left and the right that are no mirror images: in place, mass, centre of mass, or limits.

    A robot that is meant to be symmetric drifts to one side, and rewards of symmetry ask for what is none. Source:
    the image of each joint and link in the plane between the sides, in the pose that the file draws.
    """
    robot = case.robot
    if robot is None or robot.drawn.left is None:
        return
    pairs = [pair for pair in robot.drawn.mirrored if pair.left != pair.right]
    displaced = [pair for pair in pairs if pair.offset > _PLACE * robot.drawn.size or pair.tilt > _TILT]
    if displaced:
        yield _displaced(displaced, set(robot.drawn.wheel_joints))
    told = [finding for pair in pairs if pair not in displaced for finding in _difference(robot, pair)]
    yield from told[:_MOST]
    legs = {name for leg in robot.drawn.legs for name in (*leg.joints, leg.wheel)}
    alone = [name for name in robot.drawn.unmatched if name in legs]
    if alone and len(robot.drawn.wheels) % 2 == 0:
        yield Finding(
            _ASSET,
            ", ".join(f"'{name}'" for name in alone) + " have no mirror image on the other side",
            "look at the origins of these joints in the file",
        )


def _displaced(pairs: list[MirroredPair], wheels: set[str]) -> Finding:
    first, more = pairs[0], len(pairs) - 1
    what = "the wheels of " if first.left in wheels else ""
    by = ", by the middles of their colliders" if what else ""
    others = f", nor are {more} more pairs" if more > 1 else ", nor is one more pair" if more else ""
    return Finding(
        _ASSET,
        f"{what}'{first.left}' and '{first.right}' are no mirror images: {1e3 * first.offset:.3g} mm and "
        f"{math.degrees(first.tilt):.2g}° off{by}{others}",
        _HINT,
        {"offset_m": first.offset, "tilt_rad": first.tilt, "pairs": float(len(pairs))},
    )


def _difference(robot: CompiledRobot, pair: MirroredPair) -> Iterator[Finding]:
    model = robot.model
    one, other = (int(model.jnt_bodyid[model.joint(name).id]) for name in (pair.left, pair.right))
    masses = float(model.body_mass[one]), float(model.body_mass[other])
    if abs(masses[0] - masses[1]) > _MASS * max(masses):
        yield Finding(
            _ASSET,
            f"'{model.body(one).name}' weighs {masses[0]:.4g} kg and '{model.body(other).name}' {masses[1]:.4g} kg",
            _HINT,
            {"left_kg": masses[0], "right_kg": masses[1]},
        )
    else:
        yield from _centres(robot, one, other, max(masses))
    yield from _limits(robot, pair)


def _centres(robot: CompiledRobot, one: int, other: int, mass: float) -> Iterator[Finding]:
    model, size = robot.model, robot.drawn.size
    if mass < _NEGLIGIBLE * float(model.body_mass.sum()):
        return
    data = mujoco.MjData(model)
    data.qpos[:] = model.qpos0
    mujoco.mj_kinematics(model, data)
    base = model.body(robot.drawn.base).id
    frame = data.xmat[base].reshape(3, 3)
    left = frame @ np.array(robot.drawn.left)
    flip = np.eye(3) - 2 * np.outer(left, left)
    middle = data.xpos[base] + frame @ np.array(robot.drawn.middle)
    offset = flip @ (data.xipos[one] - middle) - (data.xipos[other] - middle)
    distance = float(np.linalg.norm(offset))
    if distance > _CENTRE * size:
        yield Finding(
            _ASSET,
            f"the centres of mass of '{model.body(one).name}' and '{model.body(other).name}' are no mirror images: "
            f"{1e3 * distance:.3g} mm off",
            _HINT,
            {"offset_m": distance},
        )


def _limits(robot: CompiledRobot, pair: MirroredPair) -> Iterator[Finding]:
    model = robot.model
    one, other = (model.joint(name).id for name in (pair.left, pair.right))
    if not (model.jnt_limited[one] and model.jnt_limited[other]):
        return
    low, high = (model.jnt_range[one] - robot.zero(pair.left)).tolist()
    image = sorted((pair.sign * (model.jnt_range[other] - robot.zero(pair.right))).tolist())
    worst = max(abs(low - image[0]), abs(high - image[1]))
    if worst > _ANGLE:
        ranges = [f"{a:.4g} to {b:.4g}" for a, b in (model.jnt_range[one], model.jnt_range[other])]
        yield Finding(
            _ASSET,
            f"the limits of '{pair.left}' ({ranges[0]}) and '{pair.right}' ({ranges[1]}) are no mirror images: "
            f"{worst:.3g} off",
            _HINT,
            {"difference": worst},
        )


@rule
def lopsided_pose(case: Case) -> Iterator[Finding]:
    """A default pose whose left and right are no mirror images, though the robot's legs are.

    Most often a sign: joints of two sides that turn in opposite senses want positions of opposite signs. Source: the
    mirrored axes of the joints.
    """
    robot = case.robot
    if robot is None or robot.drawn.left is None:
        return
    legs = {name for leg in robot.drawn.legs for name in leg.joints}
    wrong = []
    for pair in robot.drawn.mirrored:
        if pair.left == pair.right or not {pair.left, pair.right} <= legs:
            continue
        here = robot.position(pair.left) - robot.zero(pair.left)
        there = robot.position(pair.right) - robot.zero(pair.right)
        if abs(there - pair.sign * here) > _ANGLE:
            wanted = robot.zero(pair.right) + pair.sign * here
            wrong.append((pair, robot.position(pair.left), robot.position(pair.right), wanted))
    if wrong:
        told = ", ".join(f"{p.left} at {a:.4g} and {p.right} at {b:.4g}" for p, a, b, _ in wrong[:_MOST])
        hint = ", ".join(f"{p.right}: {wanted:.4g}" for p, _, _, wanted in wrong[:_MOST])
        yield Finding(
            "env.robot.init_state.joint_pos",
            f"the default pose is lopsided: {told}",
            f"{hint} mirrors the left side",
            {"pairs": float(len(wrong))},
        )
