"""Where the weight lies, and which way the wheels roll."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from wheelleg_exp.lint.case import Case
from wheelleg_exp.lint.findings import Finding, rule
from wheelleg_exp.lint.robot.balancing import balanced_pose, weight_over_axle
from wheelleg_exp.lint.robot.compiled import CompiledRobot

_LEAN = 0.06  # rad: an offset that a policy takes up without a word
_DRAWN_LEAN = 0.17  # rad: the same of a pose that a file draws, which nobody has chosen
_EDGE = 0.1  # of the support's length, from its ends
_AHEAD = math.radians(5)
_TOE = math.radians(2)


@rule
def balance_pose(case: Case) -> Iterator[Finding]:
    """A centre of mass that does not lie over the wheels where episodes begin.

    On one axle the robot begins to fall at once, the faster the more it leans: it balances where the mass above the
    axle stands upright over it. The hint's pose of the legs is solved from the kinematics. On more axles the weight
    has to lie between the outermost contacts. Source: statics of the inverted pendulum.
    """
    robot = case.robot
    if robot is None or robot.anatomy.forward is None:
        return
    weight = weight_over_axle(robot)
    chosen = "task" in case.config
    if not robot.anatomy.one_axle:
        yield from _outside(robot, weight.place, _EDGE if chosen else 0.0)
        return
    if abs(weight.lean) <= (_LEAN if chosen else _DRAWN_LEAN):
        return
    side = "in front of" if weight.ahead > 0 else "behind"
    pose = balanced_pose(robot)
    figures = {"offset_m": weight.ahead, "lean_rad": weight.lean, "height_m": weight.above}
    if pose is not None:
        hint = "with the base level, the weight is over the axle at " + ", ".join(
            f"{name}: {value:g}" for name, value in pose.items()
        )
        key = "env.robot.init_state.joint_pos"
    else:
        hint = f"begin with the base turned by {-weight.lean:.3g} rad about its left axis, or move the masses"
        key = "env.robot.init_state.rot"
    yield Finding(
        key,
        f"the centre of mass above the wheels is {1e3 * abs(weight.ahead):.3g} mm {side} the axle and "
        f"{1e3 * weight.above:.4g} mm above it: the robot leans by {math.degrees(abs(weight.lean)):.2g}° as it begins",
        hint,
        figures,
    )


def _outside(robot: CompiledRobot, place: np.ndarray, edge: float) -> Iterator[Finding]:
    anatomy, base = robot.anatomy, robot.model.body(robot.anatomy.base).id
    local = robot.data.xmat[base].reshape(3, 3).T @ (place - robot.data.xpos[base])
    ahead = float(local @ np.array(anatomy.forward))
    contacts = [float(np.array(wheel.contact) @ np.array(anatomy.forward)) for wheel in anatomy.standing]
    margin = min(ahead - min(contacts), max(contacts) - ahead)
    if margin < edge * anatomy.support_length:
        yield Finding(
            "env.robot.init_state.joint_pos",
            f"the centre of mass is {1e3 * abs(margin):.3g} mm {'outside' if margin < 0 else 'inside'} the outermost "
            f"wheels, which are {1e3 * anatomy.support_length:.4g} mm apart: the robot tips over them",
            "a pose with the wheels farther apart, or the masses nearer to the middle",
            {"margin_m": margin, "length_m": anatomy.support_length},
        )


@rule
def rolling_direction(case: Case) -> Iterator[Finding]:
    """Wheels that do not roll along the base's x, or not along one line.

    Commands, rewards and observations speak of x as forwards. Source: Isaac Lab's convention, ROS REP 103; the
    directions of the axles.
    """
    robot = case.robot
    if robot is None or not robot.anatomy.wheels:
        return
    anatomy = robot.anatomy
    if anatomy.forward is None:
        steered = ", ".join(f"'{wheel.joint}'" for wheel in anatomy.wheels if wheel.steered)
        yield Finding(
            "env.robot.asset",
            f"the wheels of {steered} are steered, and no two axles are parallel here"
            if steered
            else "the axles of the wheels cross: they do not roll along one line",
            "axes, or positions of the joints above, that make the wheels' axles parallel",
        )
        return
    axles = [np.array(wheel.axis) for wheel in anatomy.wheels if not wheel.caster]
    toe = max(math.asin(min(1.0, abs(float(axis @ np.array(anatomy.forward))))) for axis in axles)
    if toe > _TOE:
        yield Finding(
            "env.robot.asset",
            f"the axle of a wheel is turned by {math.degrees(toe):.2g}° from the others: it scrubs as it rolls",
            "axes of the wheels' joints that are parallel",
            {"toe_rad": toe},
        )
    x, y, _ = anatomy.forward
    angle = math.atan2(y, x)
    if abs(angle) > _AHEAD:
        yield Finding(
            "env.robot.asset",
            f"the wheels roll along ({x:.3g}, {y:.3g}) of the base '{anatomy.base}', and x is forwards in commands, "
            "rewards and observations",
            f"turn the base's frame in the file by {math.degrees(angle):.3g}° about z (a link before it, joined "
            f"fixed), or command and reward lin_vel_y in place of lin_vel_x",
            {"angle_rad": angle},
        )
