"""What the robot's shapes do: bodies inside one another, contacts at the start, wheels that do not roll."""

from __future__ import annotations

import math
from collections.abc import Iterator

from wheelleg_exp.lint.case import Case
from wheelleg_exp.lint.collider_depth import lowest_point
from wheelleg_exp.lint.findings import Finding, rule
from wheelleg_exp.lint.robot.overlaps import find_overlaps
from wheelleg_exp.sim.names import match_names

_ASSET = "env.robot.asset"
_TOUCHES = 2e-3  # of the robot's size: a depth that soft contacts hide
_DEEP = 0.25  # of the robot's size, for neighbours, whose shapes meet at their joint
_STANDS = 5e-3  # of the robot's size, above its lowest point: a body this low touches the ground
_BUMP = 0.05  # of a wheel's radius by which its rim may vary
_UNEQUAL = 0.02  # of the radius, between the wheels of two sides
_TOLD = 4  # pairs in one message


@rule
def overlapping_bodies(case: Case) -> Iterator[Finding]:
    """Bodies that begin inside one another, and that the model lets push each other apart.

    The contact's spring throws them apart in the first step. Pairs that a joint connects do not touch in MuJoCo and
    count only where they overlap by a quarter of the robot. Source: MuJoCo's own collision detection at the default
    pose; MuJoCo documentation, Computation, "Collision detection", on which pairs are checked.
    """
    robot = case.robot
    if robot is None:
        return
    size = robot.anatomy.size
    pairs = find_overlaps(robot.model, robot.data.qpos, robot.bodies)
    acting = [pair for pair in pairs if pair.acts and not pair.neighbours and pair.depth > _TOUCHES * size]
    if acting:
        told = ", ".join(f"'{p.bodies[0]}' and '{p.bodies[1]}' by {1e3 * p.depth:.3g} mm" for p in acting[:_TOLD])
        more = f", and {len(acting) - _TOLD} more pairs" if len(acting) > _TOLD else ""
        yield Finding(
            "env.robot.self_collisions",
            f"bodies begin inside one another and will be thrown apart: {told}{more}",
            "env.robot.self_collisions: false lets them pass through each other; or another default pose, smaller "
            "colliders, or these pairs filtered in the file",
            {"pairs": float(len(acting)), "depth_m": acting[0].depth},
        )
    for pair in pairs:
        if pair.neighbours and pair.depth > _DEEP * size:
            yield Finding(
                _ASSET,
                f"'{pair.bodies[1]}' lies {1e3 * pair.depth:.3g} mm deep inside '{pair.bodies[0]}', on which it hangs: "
                f"a quarter of the robot's size of {size:.3g} m",
                "look at the origin of the joint between them, and at the units and origins of their colliders",
                {"depth_m": pair.depth, "size_m": size},
            )


@rule
def contact_at_start(case: Case) -> Iterator[Finding]:
    """A contact that ends the episode, on a body that touches something as it begins.

    The body is as low as what the robot stands on, or inside another body. Every episode ends within its first
    steps, and nothing is learnt. Source: kinematics of the default pose.
    """
    robot = case.robot
    if robot is None:
        return
    size = robot.anatomy.size
    lows = {name: lowest_point(robot.model, robot.data, [robot.model.body(name).id]) for name in robot.bodies}
    ground = min(lows.values())
    pairs = find_overlaps(robot.model, robot.data.qpos, robot.bodies)
    inside = {name for pair in pairs if pair.acts and pair.depth > _TOUCHES * size for name in pair.bodies}
    for term in case.terms("terminations", "terminations.illegal_contact"):
        watched = match_names(term.node["sensor_cfg"]["body_names"], robot.bodies, key=term.path, what="body")[1]
        touching = [
            name
            for name in watched
            if name in inside or (math.isfinite(ground) and lows[name] < ground + _STANDS * size)
        ]
        if touching:
            yield Finding(
                f"{term.path}.sensor_cfg.body_names",
                f"{_listed(touching)} touch something where episodes begin: every episode ends at once",
                "leave out the bodies that the robot stands on; free those that are inside others",
                {"bodies": float(len(touching))},
            )


@rule
def wheels_that_do_not_roll(case: Case) -> Iterator[Finding]:
    """A wheel that is not round, not as large as that of the other side, held by limits, or without a collider.

    The reach of the colliders across the axle is measured all round: a box or a coarse hull rolls in bumps, and a
    wheel of another radius lets the robot lean or turn. Source: the support function of the shapes.
    """
    robot = case.robot
    if robot is None:
        return
    for name, why in robot.anatomy.near.items():
        yield Finding(
            _ASSET,
            f"'{name}' would be a wheel's joint, but {why}",
            'no limits (URDF: type="continuous")' if "limits" in why else "a cylinder on the joint's axis as collider",
        )
    wheels = robot.anatomy.wheels
    for wheel in wheels:
        if wheel.roundness < 1.0 - _BUMP:
            bump = wheel.radius * (1.0 - wheel.roundness)
            yield Finding(
                _ASSET,
                f"the wheel of '{wheel.joint}' is not round about its axle: its colliders reach between "
                f"{1e3 * (wheel.radius - bump):.4g} and {1e3 * wheel.radius:.4g} mm",
                f"a cylinder of {1e3 * wheel.radius:.4g} mm radius on the axle",
                {"radius_m": wheel.radius, "bump_m": bump},
            )
    radii = {wheel.joint: wheel.radius for wheel in wheels}
    for pair in robot.drawn.mirrored:
        one, other = radii.get(pair.left, 0.0), radii.get(pair.right, 0.0)
        if one > 0 and other > 0 and abs(one - other) > _UNEQUAL * max(one, other):
            yield Finding(
                _ASSET,
                f"the wheels of '{pair.left}' and '{pair.right}' have radii of {1e3 * one:.4g} and "
                f"{1e3 * other:.4g} mm",
                "colliders of one size",
                {"left_m": one, "right_m": other},
            )


def _listed(names: list[str]) -> str:
    shown = ", ".join(f"'{name}'" for name in names[:_TOLD])
    return shown + (f" and {len(names) - _TOLD} more" if len(names) > _TOLD else "")
