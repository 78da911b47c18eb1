"""Rules about the robot's geometry: overlaps, contacts at the start, round wheels, balance, and left-right symmetry."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping

import mujoco
import numpy as np

from wheelleg_exp.anatomy.anatomy_parts import MirroredPair
from wheelleg_exp.anatomy.collider_shapes import colliders, find_overlaps, lowest_point
from wheelleg_exp.anatomy.compiled_robot import CompiledRobot
from wheelleg_exp.anatomy.stance import balanced_pose, weight_over_axle
from wheelleg_exp.lint.rule import Case, Finding, by_joint, listed, rule
from wheelleg_exp.lint.rules_links import records
from wheelleg_exp.sim.names import match_names

_ASSET = "env.robot.asset"
_TOUCHES = 2e-3  # Overlaps of bodies up to 0.2 % of the robot's size are normal, because contacts are soft.
_DEEP = 0.25  # Two links that share a joint may overlap by at most 25 % of the robot's size.
_STANDS = 5e-3  # A body touches the ground if it is at most 0.5 % of the robot's size above the robot's lowest point.
_BUMP = 0.05  # A wheel's smallest radius may be at most 5 % below its largest radius.
_UNEQUAL = 0.02  # The radii of a left and a right wheel may differ by at most 2 %.
_SHOWN = 4  # pairs in one message


@rule
def overlapping_bodies(_case: Case, robot: CompiledRobot) -> Iterator[Finding]:
    """At the start of an episode, two bodies of the robot overlap and can push each other apart.

    The contact force pushes them apart in the first physics step. MuJoCo disables contacts between bodies that a joint
    connects, so these are reported only if they overlap by more than a quarter of the robot's size. Source: MuJoCo
    documentation, Computation, "Collision detection".
    """
    size = robot.anatomy.size
    pairs = find_overlaps(robot.model, robot.data.qpos, robot.bodies)
    acting = [pair for pair in pairs if pair.acts and not pair.neighbours and pair.depth > _TOUCHES * size]
    if acting:
        texts = [f"'{p.bodies[0]}' and '{p.bodies[1]}' by {1e3 * p.depth:.3g} mm" for p in acting[:_SHOWN]]
        more = f", and {len(acting) - _SHOWN} more pairs" if len(acting) > _SHOWN else ""
        message = f"bodies overlap at the start and will be thrown apart: {', '.join(texts)}{more}"
        hint = "env.robot.self_collisions: false lets them pass through each other; or another default pose, smaller "
        hint += "colliders, or these pairs filtered in the file"
        figures = {"pairs": float(len(acting)), "depth_m": acting[0].depth}
        yield Finding("env.robot.self_collisions", message, hint, figures)
    for pair in pairs:
        if pair.neighbours and pair.depth > _DEEP * size:
            message = f"'{pair.bodies[1]}' is {1e3 * pair.depth:.3g} mm deep inside its parent '{pair.bodies[0]}': "
            message += f"more than a quarter of the robot's size of {size:.3g} m"
            hint = "check the origin of the joint between them, and the units and origins of their colliders"
            yield Finding(_ASSET, message, hint, {"depth_m": pair.depth, "size_m": size})


@rule
def contact_at_start(case: Case, robot: CompiledRobot) -> Iterator[Finding]:
    """A contact termination watches a body that touches the ground or a second body at the start of an episode.

    A body has contact if it is as low as the robot's lowest point, or overlaps another body of the robot. Contact at
    the start ends every episode at once, so the policy learns nothing. Source: kinematics of the default pose.
    """
    size = robot.anatomy.size
    lows = {name: lowest_point(robot.model, robot.data, [robot.model.body(name).id]) for name in robot.bodies}
    ground = min(lows.values())
    pairs = find_overlaps(robot.model, robot.data.qpos, robot.bodies)
    inside = {name for pair in pairs if pair.acts and pair.depth > _TOUCHES * size for name in pair.bodies}
    for term in case.terms("terminations", "terminations.illegal_contact"):
        watched = match_names(term.node["sensor_cfg"]["body_names"], robot.bodies, key=term.path, what="body")[1]
        low = ground + _STANDS * size if math.isfinite(ground) else -math.inf
        touching = [name for name in watched if name in inside or lows[name] < low]
        if touching:
            message = f"{listed(touching)} touch something at the start: every episode ends at once"
            hint = "remove the bodies that the robot stands on; separate those that are inside others"
            yield Finding(f"{term.path}.sensor_cfg.body_names", message, hint, {"bodies": float(len(touching))})


@rule
def wheels_that_do_not_roll(_case: Case, robot: CompiledRobot) -> Iterator[Finding]:
    """A wheel is not round, differs from the opposite wheel, is fixed, is blocked by joint limits, or has no collider.

    The colliders of a round wheel have the same radius at all angles. A box or a coarse hull does not roll smoothly,
    and different radii make the robot lean or turn. Source: the support function of the colliders.
    """
    for name, why in robot.anatomy.near.items():
        hint = (
            "a cylinder on the joint's axis as collider" if "collide" in why else "a joint without limits on its axle"
        )
        yield Finding(_ASSET, f"'{name}' would be a wheel, but {why}", hint)
    wheels = robot.anatomy.wheels
    for wheel in wheels:
        if wheel.roundness < 1.0 - _BUMP:
            bump = wheel.radius * (1.0 - wheel.roundness)
            message = f"the wheel of '{wheel.joint}' is not round about its axle: its colliders reach between "
            message += f"{1e3 * (wheel.radius - bump):.4g} and {1e3 * wheel.radius:.4g} mm"
            hint = f"a cylinder of {1e3 * wheel.radius:.4g} mm radius on the axle"
            yield Finding(_ASSET, message, hint, {"radius_m": wheel.radius, "bump_m": bump})
    radii = {wheel.joint: wheel.radius for wheel in wheels}
    for pair in robot.drawn.mirrored:
        one, other = radii.get(pair.left, 0.0), radii.get(pair.right, 0.0)
        if one > 0 and other > 0 and abs(one - other) > _UNEQUAL * max(one, other):
            message = f"the wheels of '{pair.left}' and '{pair.right}' have radii of {1e3 * one:.4g} and "
            message += f"{1e3 * other:.4g} mm"
            yield Finding(_ASSET, message, "colliders of one size", {"left_m": one, "right_m": other})


@rule
def cylinder_edges(_case: Case, robot: CompiledRobot) -> Iterator[Finding]:
    """MuJoCo 4.0.0 computes wrong contacts of the robot's cylinders with the edges of boxes and height fields.

    A driven wheel of 20 mm radius penetrates the edge of a step by 9 mm with MuJoCo 4.0.0 and by 4 mm with 4.0.1, so
    the robot climbs steps that it cannot climb with 4.0.1. Source: MuJoCo's pull requests 3748 and 3752.
    """
    kind, types = mujoco.mjtGeom, robot.model.geom_type
    own = types[colliders(robot.model, [robot.model.body(name).id for name in robot.bodies])].tolist()
    edges = {kind.mjGEOM_BOX, kind.mjGEOM_HFIELD} & set(types[robot.model.geom_bodyid == 0].tolist())
    if mujoco.mj_versionString() == "4.0.0" and edges and kind.mjGEOM_CYLINDER in own:
        message = "MuJoCo 4.0.0 computes wrong contacts of the robot's cylinders with the edges of this ground"
        yield Finding("env.scene.terrain", message, "pip install --no-deps mujoco-core==4.0.1")


_LEAN = 0.06  # A policy easily corrects a lean of the robot of at most 0.06 rad.
_DRAWN_LEAN = 0.17  # Robot files often have unbalanced poses, so a pose from a file may lean by up to 0.17 rad.
_EDGE = 0.1  # The centre of mass must be at least 10 % of the wheelbase behind the front and before the rear contacts.
_AHEAD = math.radians(5)
_TOE = math.radians(2)


@rule
def balance_pose(case: Case, robot: CompiledRobot) -> Iterator[Finding]:
    """At the start of an episode, the robot's centre of mass is not above the wheels.

    On one axle, the robot starts to fall at once unless the centre of mass of the parts above the axle is vertically
    above it; the hint lists leg joint positions at which the robot can balance. On several axles, the centre of mass
    must be between the outermost wheel contacts. A robot on one narrow wheel falls sideways. The rule skips a robot
    file whose pose violates joint limits. Source: statics of the inverted pendulum.
    """
    if robot.anatomy.forward is None or robot.moved:
        return
    if robot.anatomy.cannot_stand and not robot.anatomy.near:
        yield Finding(_ASSET, robot.anatomy.cannot_stand, "wheels on both sides: check that no leg is missing")
    weight = weight_over_axle(robot)
    if not robot.anatomy.one_axle:
        anatomy, base = robot.anatomy, robot.model.body(robot.anatomy.base).id
        local = robot.data.xmat[base].reshape(3, 3).T @ (weight.place - robot.data.xpos[base])
        ahead = float(local @ np.array(anatomy.forward))
        contacts = [float(np.array(wheel.contact) @ np.array(anatomy.forward)) for wheel in anatomy.standing]
        margin = min(ahead - min(contacts), max(contacts) - ahead)
        if margin < (_EDGE if case.of_task else 0.0) * anatomy.support_length:
            yield Finding(
                "env.robot.init_state.joint_pos",
                f"the centre of mass is {1e3 * abs(margin):.3g} mm {'outside' if margin < 0 else 'inside'} the "
                f"outermost wheels, which are {1e3 * anatomy.support_length:.4g} mm apart: the robot tips over them",
                "a pose with the wheels farther apart, or the masses nearer to the middle",
                {"margin_m": margin, "length_m": anatomy.support_length},
            )
        return
    if abs(weight.lean) <= (_LEAN if case.of_task else _DRAWN_LEAN):
        return
    side = "in front of" if weight.ahead > 0 else "behind"
    pose = balanced_pose(robot)
    figures = {"offset_m": weight.ahead, "lean_rad": weight.lean, "height_m": weight.above}
    if pose is not None:
        positions = ", ".join(f"{name}: {value:g}" for name, value in pose.items())
        hint = f"with a level base, the centre of mass is over the axle at {positions}"
        key = "env.robot.init_state.joint_pos"
    else:
        hint = f"start with the base turned by {-weight.lean:.3g} rad about its left axis, or move the masses"
        key = "env.robot.init_state.rot"
    yield Finding(
        key,
        f"the centre of mass above the wheels is {1e3 * abs(weight.ahead):.3g} mm {side} the axle and "
        f"{1e3 * weight.above:.4g} mm above it: the robot leans by {math.degrees(abs(weight.lean)):.2g}° at the start",
        hint,
        figures,
    )


@rule
def rolling_direction(_case: Case, robot: CompiledRobot) -> Iterator[Finding]:
    """The wheels do not roll along the x axis of the robot's base, or do not roll in one common direction.

    Commands, rewards, and observations assume that x points forwards. Source: the convention of Isaac Lab, ROS REP 103.
    """
    if not robot.anatomy.wheels:
        return
    anatomy = robot.anatomy
    if anatomy.forward is None:
        steered = ", ".join(f"'{wheel.joint}'" for wheel in anatomy.wheels if wheel.steered)
        yield Finding(
            "env.robot.asset",
            f"the wheels of {steered} are steered, and no two axles are parallel here"
            if steered
            else "the axles of the wheels are not parallel, so they do not roll in one direction",
            "joint axes or positions that make the wheels' axles parallel",
        )
        return
    axles = [np.array(wheel.axis) for wheel in anatomy.wheels if not wheel.caster]
    toe = max(math.asin(min(1.0, abs(float(axis @ np.array(anatomy.forward))))) for axis in axles)
    if toe > _TOE:
        message = f"the axle of a wheel is turned by {math.degrees(toe):.2g}° from the other axles: the wheel scrubs"
        yield Finding("env.robot.asset", message, "axes of the wheels' joints that are parallel", {"toe_rad": toe})
    x, y, _ = (round(part, 3) + 0.0 for part in anatomy.forward)
    angle = math.atan2(y, x)
    if abs(angle) > _AHEAD:
        yield Finding(
            "env.robot.asset",
            f"the wheels roll along ({x:g}, {y:g}) of the base '{anatomy.base}', but x is forwards in commands, "
            "rewards, and observations",
            f"turn the base's frame in the file by {math.degrees(angle):.3g}° about z (a link before it, joined "
            f"fixed), or command and reward lin_vel_y in place of lin_vel_x",
            {"angle_rad": angle},
        )


_PLACE = 0.015  # A joint may be at most 1.5 % of the robot's size away from its partner's mirror image.
_TILT = math.radians(2)
_MASS = 0.1  # allowed relative difference
_CENTRE = 0.02  # A link's centre of mass may be at most 2 % of the robot's size away from its partner's mirror image.
_ANGLE = 0.02  # The limits or positions of a left and a right joint may differ by at most 0.02 rad.
_NO_MASS = 1e-5  # share of the robot's mass
_NEGLIGIBLE = 0.01  # Symmetry checks ignore the centre of mass of a link with less than 1 % of the robot's mass.
_ALONG = 0.9  # A joint counts as parallel to the wheels' axle if the cosine of the angle between them is above 0.9.
_HINT = "the same numbers on both sides of the file, with y and the signs of rotations mirrored"
_MOST = 4  # findings of one kind


@rule
def wheel_senses(case: Case, robot: CompiledRobot) -> Iterator[Finding]:
    """Left and right wheel joints have opposite signs, although left and right leg joints have equal signs.

    An action of 1 then drives one wheel forwards and the opposite wheel backwards. A robot file that reverses both leg
    and wheel axes on one side is consistent, and is not reported. Source: kinematics, v = omega x r.
    """
    anatomy = robot.drawn
    signs = {wheel.joint: wheel.sign for wheel in anatomy.wheels if not wheel.caster and wheel.sign}
    for pair in anatomy.mirrored:
        if pair.left == pair.right or signs.get(pair.left, 0) * signs.get(pair.right, 0) >= 0:
            continue
        scales = [scale for term in case.terms("actions") if isinstance(scale := term.node.get("scale"), Mapping)]
        factors = (by_joint(scale, list(case.facts.joints), 1.0) for scale in scales)
        if _legs_turn_alike(robot, pair) and not any(one[pair.left] * one[pair.right] < 0 for one in factors):
            scale = f"{{{pair.left}: {signs[pair.left]:g}, {pair.right}: {signs[pair.right]:g}}}"
            message = f"positive speed of '{pair.left}' rolls the robot {_way(signs[pair.left])}, of '{pair.right}' "
            message += f"{_way(signs[pair.right])}, though the legs above them have equal signs"
            hint = f"the axis of one wheel reversed in the file, or an action's scale times {scale}"
            yield Finding(_ASSET, message, hint)


def _legs_turn_alike(robot: CompiledRobot, wheels: MirroredPair) -> bool:
    """Return whether equal positions of the lowest pitch joints turn both legs in the same direction."""
    anatomy, model = robot.drawn, robot.model
    # The pitch axis of the robot in the world's frame.
    left = robot.data.xmat[model.body(robot.anatomy.base).id].reshape(3, 3) @ np.array(anatomy.left)
    chain = {leg.wheel: leg.joints for leg in anatomy.legs}[wheels.left]
    signs = {name: p.sign for p in anatomy.mirrored if p.left != p.right for name in (p.left, p.right)}
    pitched = [n for n in chain if n in signs and abs(float(robot.data.xaxis[model.joint(n).id] @ left)) > _ALONG]
    alike = [signs[name] > 0 for name in pitched]
    return not alike or alike[-1]


def _way(sign: int) -> str:
    return "forwards" if sign > 0 else "backwards"


@rule
def mirror_images(case: Case, robot: CompiledRobot) -> Iterator[Finding]:
    """Left and right legs are not mirror images in position, mass, centre of mass, or limits.

    An asymmetric robot drifts to one side. Source: the mirror image of each joint and link, at the robot file's pose.
    """
    if robot.drawn.left is None:
        return
    pairs = [pair for pair in robot.drawn.mirrored if pair.left != pair.right]
    displaced = [pair for pair in pairs if pair.offset > _PLACE * robot.drawn.size or pair.tilt > _TILT]
    if displaced:
        first, more = displaced[0], len(displaced) - 1
        what = "the wheels of " if first.left in set(robot.drawn.wheel_joints) else ""
        by = ", by the middles of their colliders" if what else ""
        others = f"; nor are {more} more pairs" if more > 1 else "; nor is one more pair" if more else ""
        message = f"{what}'{first.left}' and '{first.right}' are not mirror images: {1e3 * first.offset:.3g} mm and "
        message += f"{math.degrees(first.tilt):.2g}° off{by}{others}"
        figures = {"offset_m": first.offset, "tilt_rad": first.tilt, "pairs": float(len(displaced))}
        yield Finding(_ASSET, message, _HINT, figures)
    massless = {pair: list(_massless(case, robot, pair)) for pair in pairs}
    yield from [finding for found in massless.values() for finding in found]
    alike = [pair for pair in pairs if pair not in displaced and not massless[pair]]
    yield from [finding for pair in alike for finding in _difference(robot, pair)][:_MOST]
    legs = {name for leg in robot.drawn.legs for name in (*leg.joints, leg.wheel)}
    alone = [name for name in robot.drawn.unmatched if name in legs]
    if alone and len(robot.drawn.wheels) % 2 == 0:
        message = ", ".join(f"'{name}'" for name in alone) + " have no mirror image on the other side"
        yield Finding(_ASSET, message, "check the origins of these joints in the file")


def _massless(case: Case, robot: CompiledRobot, pair: MirroredPair) -> Iterator[Finding]:
    """Yield a finding if a link of one side, but not its mirror image, has next to no mass in the robot file."""
    model, assumed = robot.model, {item.subject for item in records(case, "no_inertial")}
    joints = [model.joint(name).id for name in (pair.left, pair.right)]
    sides = [np.flatnonzero(model.body_weldid == model.body_weldid[model.jnt_bodyid[joint]]) for joint in joints]
    light = model.body_mass <= _NO_MASS * model.body_mass.sum()
    names = [[n for i in side for n in [model.body(i).name] if light[i] or n in assumed] for side in sides]
    if len(sides[0]) == len(sides[1]) and len(names[0]) != len(names[1]):
        shown = listed(max(names, key=len))
        yield Finding(_ASSET, f"{shown} has no mass in the file, unlike its mirror image", _HINT)


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
    left_id, right_id = (model.joint(name).id for name in (pair.left, pair.right))
    if not (model.jnt_limited[left_id] and model.jnt_limited[right_id]):
        return
    low, high = (model.jnt_range[left_id] - robot.zero(pair.left)).tolist()
    image = sorted((pair.sign * (model.jnt_range[right_id] - robot.zero(pair.right))).tolist())
    worst = max(abs(low - image[0]), abs(high - image[1]))
    if worst > _ANGLE:
        ranges = [f"{a:.4g} to {b:.4g}" for a, b in (model.jnt_range[left_id], model.jnt_range[right_id])]
        message = f"the limits of '{pair.left}' ({ranges[0]}) and '{pair.right}' ({ranges[1]}) are not mirror images: "
        message += f"{worst:.3g} off"
        yield Finding(_ASSET, message, _HINT, {"difference": worst})


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
            f"the centres of mass of '{model.body(one).name}' and '{model.body(other).name}' are not mirror images: "
            f"{1e3 * distance:.3g} mm off",
            _HINT,
            {"offset_m": distance},
        )


@rule
def lopsided_pose(_case: Case, robot: CompiledRobot) -> Iterator[Finding]:
    """The default joint positions of a symmetric robot's left and right legs are not mirror images.

    The usual cause is a sign: mirrored joints with opposite axes need opposite positions. Source: the mirrored axes.
    """
    if robot.drawn.left is None:
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
        positions = ", ".join(f"{p.left} at {a:.4g} and {p.right} at {b:.4g}" for p, a, b, _ in wrong[:_MOST])
        hint = ", ".join(f"{p.right}: {wanted:.4g}" for p, _, _, wanted in wrong[:_MOST]) + " mirrors the left side"
        message = f"the default pose is asymmetric: {positions}"
        yield Finding("env.robot.init_state.joint_pos", message, hint, {"pairs": float(len(wrong))})
