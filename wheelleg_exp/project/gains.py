"""Gains and limits of a robot's joints: the file's own where it gives them, else modest ones from the inertias."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from wheelleg_exp.asset.description import Dof
from wheelleg_exp.project.survey import Survey

_LEG_RATE = 2 * math.pi * 3  # rad/s: how fast a leg joint follows its target
_DAMPING_RATIO = 0.7
_SAG = 0.05  # rad (m) that the weight may bend a leg joint by
_STRENGTH = 3.0  # times the torque that holds the pose
_LEG_SPEED = 15.0  # rad/s
_WHEEL_TIME = 0.1  # s in which a wheel takes up a speed
_TRACTION = 1.5  # times the torque at which a wheel slips
_GROUND_SPEED = 2.0  # m/s
_ENDLESS = 1e6  # from here on a limit is none


@dataclass(frozen=True)
class Gains:
    """Numbers of an actuator group, by joint.

    Attributes:
        stiffness: N·m/rad.
        damping: N·m·s/rad.
        effort: largest torque, N·m.
        velocity: largest speed, rad/s.
        given: what of these the file says.
    """

    stiffness: dict[str, float]
    damping: dict[str, float]
    effort: dict[str, float]
    velocity: dict[str, float]
    given: list[str]


def leg_gains(robot: Survey) -> Gains:
    """Return the legs' gains.

    Without a drive in the file: a stiffness with which the joint follows at 3 Hz, and the weight bends it by 0.05 rad
    at most, at a damping ratio of 0.7; three times the torque that holds the pose.
    """
    joints, dofs = robot.facts.joints, robot.dofs

    def modest_stiffness(name: str) -> float:
        return max(joints[name].effective * _LEG_RATE**2, abs(joints[name].hold) / _SAG)

    stiffness, given = _filled(robot.legs, dofs, _stiffness, modest_stiffness)

    def modest_damping(name: str) -> float:
        return 2 * _DAMPING_RATIO * math.sqrt(stiffness[name] * joints[name].effective)

    def modest_effort(name: str) -> float:
        return max(_STRENGTH * abs(joints[name].hold), modest_stiffness(name) * _SAG * _STRENGTH)

    damping, own = _filled(robot.legs, dofs, _damping, modest_damping)
    effort, limited = _filled(robot.legs, dofs, _effort, modest_effort)
    velocity, fast = _filled(robot.legs, dofs, _velocity, lambda _: _LEG_SPEED)
    found = {"stiffness": given, "damping": own, "effort": limited, "velocity": fast}
    return Gains(stiffness, damping, effort, velocity, [name for name, said in found.items() if said])


def wheel_gains(robot: Survey) -> Gains:
    """Return the wheels' gains: no stiffness, because they follow speeds.

    Without a drive in the file: a damping that accelerates the wheel's share of the robot in 0.1 s, 1.5 times the
    torque at which the wheel slips, and a speed of 2 m/s on the ground.
    """
    facts, count = robot.facts, max(1, len(robot.wheels))
    share = facts.mass / count * robot.radius**2

    def modest_damping(name: str) -> float:
        return (facts.joints[name].effective + share) / _WHEEL_TIME

    def modest_effort(_: str) -> float:
        return _TRACTION * max(facts.friction, 0.5) * facts.weight / count * robot.radius

    damping, own = _filled(robot.wheels, robot.dofs, _speed_gain, modest_damping)
    effort, limited = _filled(robot.wheels, robot.dofs, _effort, modest_effort)
    velocity, fast = _filled(robot.wheels, robot.dofs, _velocity, lambda _: _GROUND_SPEED / robot.radius)
    found = {"damping": own, "effort": limited, "velocity": fast}
    none = dict.fromkeys(robot.wheels, 0.0)
    return Gains(none, damping, effort, velocity, [name for name, said in found.items() if said])


def _filled(
    joints: list[str],
    dofs: Mapping[str, Dof],
    said: Callable[[Dof], float | None],
    modest: Callable[[str], float],
) -> tuple[dict[str, float], bool]:
    """Return a value for each joint, and whether the file says all of them."""
    found = {name: said(dofs[name]) for name in joints}
    values = {name: value if value is not None else float(f"{modest(name):.2g}") for name, value in found.items()}
    return values, all(value is not None for value in found.values())


def _stiffness(dof: Dof) -> float | None:
    return dof.drive.stiffness if dof.drive is not None and dof.drive.stiffness > 0 else None


def _damping(dof: Dof) -> float | None:
    drive = dof.drive
    return drive.damping if drive is not None and drive.stiffness > 0 and drive.damping > 0 else None


def _speed_gain(dof: Dof) -> float | None:
    """Return the damping of a drive that follows speeds; that of one that holds an angle is meant for another use."""
    drive = dof.drive
    return drive.damping if drive is not None and drive.stiffness == 0 and drive.damping > 0 else None


def _effort(dof: Dof) -> float | None:
    limits = [dof.drive.effort] if dof.drive is not None else []
    limits += [max(map(abs, dof.force_range))] if dof.force_range is not None else []
    return min((limit for limit in limits if limit is not None and 0 < limit < _ENDLESS), default=None)


def _velocity(dof: Dof) -> float | None:
    limit = dof.max_velocity
    return limit if limit is not None and 0 < limit < _ENDLESS else None
