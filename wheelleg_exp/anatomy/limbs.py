"""Find wheels, legs, and mirrored joints of a robot by shape and motion, not by names."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from statistics import median

import mujoco
import numpy as np

from wheelleg_exp.anatomy.anatomy_parts import Array, Leg, MirroredPair, Tree
from wheelleg_exp.anatomy.collider_shapes import colliders, reach

TURNS = 3 * math.pi  # A wheel's hinge with a range above 3 pi rad counts as unlimited.
LEVEL = 0.5  # An axle counts as horizontal if the vertical component of its unit vector is below 0.5.
_ROUND = 0.9  # A body counts as round if its smallest radius is at least 90 % of its largest radius.
_ROUGH = 0.6  # A body with a smallest radius below 60 % of its largest radius is never a wheel.
_LOW = 0.4  # A wheel's lowest point must be in the lowest 40 % of the robot's height.
_OFF_AXIS = 0.05  # The centre of a wheel's outline is at most 5 % of the wheel's radius away from the hinge axis.
_SWIVELS = 3.0  # rad; a caster's swivel turns by about half a turn or more.
_TRAILS = 0.1  # A caster's ground contact is at least 10 % of the wheel radius away from the steering axis.
_DISC = 1.5  # A collider counts as a disc if it is narrower than 1.5 times its radius; a sphere is not a disc.
_SMALLEST = 1e-3  # m, radius
_EQUAL = 0.1  # Two moments of inertia count as equal if they differ by at most 10 %.
_CENTRED = 0.1  # A wheel's centre of mass is at most 10 % of the wheel's radius away from the axle.
_ENDLESS = 1e3  # rad; a wheel with a smaller range stops after a short drive.
_HALF_TURN = 3.0  # rad; a round body on a hinge with limits looks like a wheel from about half a turn on.
_AROUND = 48


@dataclass(frozen=True)
class Found:
    """The hinge and the shape of a part that may be a wheel, in the world frame, m.

    The hinge ``joint`` moves ``bodies``. ``centre`` is on its axis, midway between the sides of the colliders.
    ``radius`` is the largest radius about the axis, and ``roundness`` the smallest divided by it. ``off_axis`` is the
    distance of a round wheel's own axis from the hinge's; 0 for colliders that are not round.
    """

    joint: int
    bodies: tuple[int, ...]
    axis: Array
    centre: Array
    radius: float
    width: float
    roundness: float
    off_axis: float
    why: str


def find_wheels(tree: Tree) -> tuple[list[Found], dict[str, str]]:
    """Return the wheels; also return, by the name of a joint or fixed link that looks like a wheel's, why it is not."""
    found, near = [], dict[str, str]()
    everything, ends = colliders(tree.model, tree.bodies), np.array([-tree.up, tree.up])
    down, top = reach(tree.model, tree.data, everything, np.zeros(3), ends).tolist() if everything else (0.0, 0.0)
    highest = -down + _LOW * (top + down)  # A wheel's lowest point is at most at this world height, m.
    for joint in tree.joints:
        # A wheel's joint is a horizontal hinge and the last joint of its kinematic chain.
        bodies = tree.below(int(tree.model.jnt_bodyid[joint]))
        last = sum(len(tree.joints_of(body)) for body in bodies) == 1
        if not (tree.is_hinge(joint) and last and abs(float(tree.data.xaxis[joint] @ tree.up)) < LEVEL):
            continue
        solid = colliders(tree.model, bodies)
        drawn = [geom for geom in range(tree.model.ngeom) if int(tree.model.geom_bodyid[geom]) in bodies]
        name = tree.joint_name(joint)
        if not solid:
            round_enough = _measured(tree, joint, bodies, drawn).roundness >= _ROUND if drawn else True
            if tree.turns(joint) > TURNS and round_enough and float(tree.data.xanchor[joint] @ tree.up) <= highest:
                near[name] = "nothing of what it turns collides"
            continue
        shape = _measured(tree, joint, bodies, solid)
        round_enough = shape.roundness >= _ROUND or (shape.roundness >= _ROUGH and _spins_freely(tree, shape))
        if shape.radius < _SMALLEST or not round_enough:
            if tree.turns(joint) > TURNS and _spins_freely(tree, shape):
                near[name] = f"its colliders are round about a line {1e3 * shape.off_axis:.3g} mm off its axis"
                if shape.off_axis <= _OFF_AXIS * shape.radius:
                    extent = f"between {1e3 * shape.radius * shape.roundness:.3g} and {1e3 * shape.radius:.3g} mm"
                    text = "its colliders, unlike its masses, are not round about its axis"
                    near[name] = f"{text}: they reach {extent} from the axis"
            continue
        low = float(shape.centre @ tree.up) - shape.radius
        if low > highest:
            continue
        if tree.turns(joint) > _ENDLESS:
            found.append(shape)
        elif tree.turns(joint) >= _HALF_TURN:
            low_limit, high_limit = tree.model.jnt_range[joint]
            near[name] = f"its limits of {low_limit:.4g} to {high_limit:.4g} rad keep it from rolling on"
    return found, near | _fixed_wheels(tree, everything, -down, near)


def _fixed_wheels(tree: Tree, solid: Sequence[int], lowest: float, near: Collection[str]) -> dict[str, str]:
    """Return, by link name, why a disc that stands on the ground, round about a level axis, cannot roll."""
    model, data, found = tree.model, tree.data, dict[str, str]()
    for geom in solid:
        body = int(model.geom_bodyid[geom])
        hinges = [joint for joint in tree.joints_of(int(model.body_weldid[body])) if tree.is_hinge(joint)]
        round_about = [joint for joint in hinges if _measured(tree, joint, [body], [geom]).roundness >= _ROUND]
        if round_about or any(tree.joint_name(joint) in near for joint in hinges):
            continue
        for axis in data.geom_xmat[geom].reshape(3, 3).T:
            disc = _outlined(tree, -1, [body], [geom], axis, data.geom_xpos[geom])
            stands = float(disc.centre @ tree.up) - disc.radius - lowest < _OFF_AXIS * disc.radius
            level = abs(float(axis @ tree.up)) < LEVEL
            if level and stands and disc.roundness >= _ROUND and _SMALLEST < disc.width < _DISC * disc.radius:
                found[tree.body_name(body)] = "it is fixed to a link that does not turn about its axle"
    return found


def _measured(tree: Tree, joint: int, bodies: Collection[int], geoms: list[int]) -> Found:
    return _outlined(tree, joint, bodies, geoms, tree.data.xaxis[joint].copy(), tree.data.xanchor[joint].copy())


def _outlined(tree: Tree, joint: int, bodies: Collection[int], geoms: list[int], axis: Array, anchor: Array) -> Found:
    model, data = tree.model, tree.data
    across = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    across /= np.linalg.norm(across)
    angles = np.linspace(0.0, 2 * math.pi, _AROUND, endpoint=False)
    circle = np.outer(np.cos(angles), across) + np.outer(np.sin(angles), np.cross(axis, across))
    # Measure how far the wheel's colliders reach from the hinge, along the axle and perpendicular to the axle.
    outline = reach(model, data, geoms, anchor, np.vstack([circle, axis, -axis]))
    there, back = outline[-2], outline[-1]
    outline = outline[:-2]
    radius = float(outline.max())
    roundness = float(outline.min()) / radius if radius > 0 else 0.0
    # ``off_axis`` is the distance of the centre of a wheel's round outline from the wheel's hinge axis, m.
    # A circle of radius r, shifted by d, has the outline r + d · cos(angle - direction of the shift).
    shift = 2 * np.array([(outline * np.cos(angles)).mean(), (outline * np.sin(angles)).mean()])
    centred = outline - shift[0] * np.cos(angles) - shift[1] * np.sin(angles)
    off_axis = float(np.linalg.norm(shift)) if centred.min() >= _ROUND * centred.max() > 0 else 0.0
    centre, width = anchor + axis * (there - back) / 2, float(there + back)
    why = f"turns without limits about a level axis, last of its chain; its colliders reach {1e3 * radius:.4g} mm "
    why += f"from the axis all round, within {100 * (1 - roundness):.1f} %"
    return Found(joint, tuple(bodies), axis, centre, radius, width, roundness, off_axis, why)


def _spins_freely(tree: Tree, shape: Found) -> bool:
    """Return whether masses are distributed about an axis as a wheel's: centred, with equal moments across the axis."""
    model, data = tree.model, tree.data
    bodies = list(shape.bodies)
    mass = model.body_mass[bodies]
    if mass.sum() <= 0:
        return False
    centre = mass @ data.xipos[bodies] / mass.sum()
    arm = centre - data.xanchor[shape.joint]
    if np.linalg.norm(arm - (arm @ shape.axis) * shape.axis) > _CENTRED * shape.radius:
        return False
    inertia = np.zeros((3, 3))
    for body, weight in zip(bodies, mass, strict=True):
        frame = data.ximat[body].reshape(3, 3)
        offset = data.xipos[body] - centre
        inertia += frame @ np.diag(model.body_inertia[body]) @ frame.T
        inertia += weight * (offset @ offset * np.eye(3) - np.outer(offset, offset))
    cross = np.linalg.svd(shape.axis[None])[2][1:]  # two unit vectors perpendicular to the axle, as rows
    moments = np.linalg.eigvalsh(cross @ inertia @ cross.T)
    skew = np.linalg.norm(cross @ inertia @ shape.axis)
    return bool(moments[1] - moments[0] <= _EQUAL * moments[1] and skew <= _EQUAL * moments[1])


def swivels(tree: Tree, wheel: Found) -> list[int]:
    """Return the joints above a wheel that make a caster of it: a vertical hinge in front, or more axles of a ball."""
    found: list[int] = []
    geoms = colliders(tree.model, wheel.bodies)
    for joint in reversed(tree.chain(int(tree.model.jnt_bodyid[wheel.joint]))[:-1]):
        axis, anchor = tree.data.xaxis[joint], tree.data.xanchor[joint]
        offset = float((wheel.centre - anchor) @ np.cross(wheel.axis, tree.up))
        trails = abs(float(axis @ tree.up)) > 1.0 - LEVEL / 2 and abs(offset) > _TRAILS * wheel.radius and not found
        ball = tree.turns(joint) > TURNS and _measured(tree, joint, wheel.bodies, geoms).roundness >= _ROUND
        if not tree.is_hinge(joint) or tree.turns(joint) < _SWIVELS or not (trails or ball):
            break
        found.append(joint)
    return found


def driven_joints(model: mujoco.MjModel) -> set[int]:
    """Return the joints with actuators; if the model has no actuators, return all joints except mimic joints."""
    followers = set(model.eq_obj1id[(model.eq_type == mujoco.mjtEq.mjEQ_JOINT)].tolist())
    through = {int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT)}
    moved = {int(model.actuator_trnid[i, 0]) for i in range(model.nu) if int(model.actuator_trntype[i]) in through}
    return moved or set(range(model.njnt)) - followers


_HOLDS = {int(mujoco.mjtEq.mjEQ_CONNECT), int(mujoco.mjtEq.mjEQ_WELD)}
_BODY = int(mujoco.mjtObj.mjOBJ_BODY)


def find_legs(tree: Tree, wheels: Sequence[int], driven: Collection[int]) -> list[Leg]:
    """Return the leg of each wheel; ``wheels`` and ``driven`` are indices of joints."""
    model = tree.model
    chains = {wheel: tree.chain(int(model.jnt_bodyid[wheel]))[:-1] for wheel in wheels}
    on_chains = {joint for chain in chains.values() for joint in chain} | set(wheels)
    # ``closures`` lists the name and both body indices of each MuJoCo equality constraint between robot bodies.
    closures = []
    for index in range(model.neq):
        if int(model.eq_type[index]) not in _HOLDS:
            continue
        pair = int(model.eq_obj1id[index]), int(model.eq_obj2id[index])
        if model.eq_objtype[index] != _BODY:
            pair = int(model.site_bodyid[pair[0]]), int(model.site_bodyid[pair[1]])
        if set(pair) <= set(tree.bodies):
            closures.append((mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_EQUALITY, index) or f"#{index}", pair))
    # ``limbs`` maps each body that moves relative to the base to the set of all bodies of the same limb.
    limbs = {body: {body} for body in tree.bodies if model.body_weldid[body] != model.body_weldid[tree.base]}
    links = [(body, int(model.body_parentid[body])) for body in limbs]
    for one, other in [*links, *[pair for _, pair in closures]]:
        if one in limbs and other in limbs and limbs[one] is not limbs[other]:
            limbs[one] |= limbs[other]
            for body in limbs[other]:
                limbs[body] = limbs[one]
    legs = []
    for wheel, chain in chains.items():
        limb = limbs.get(int(model.jnt_bodyid[wheel]), set())
        beside = [joint for joint in tree.joints if int(model.jnt_bodyid[joint]) in limb and joint not in on_chains]
        joints, others = tuple(map(tree.joint_name, chain)), tuple(map(tree.joint_name, beside))
        passive = tuple(tree.joint_name(joint) for joint in chain if joint not in driven)
        loops = tuple(name for name, pair in closures if limb & set(pair))
        legs.append(Leg(tree.joint_name(wheel), joints, passive, others, loops))
    return legs


_APART = 0.15  # Mirrored joints deviate from exact symmetry by at most 15 % of the robot's size.
_TILTED = math.radians(30)
_MIDDLE = 0.01  # A left joint may be to the right of the mirror plane by at most 1 % of the robot's size.


def find_pairs(
    tree: Tree, left: Array, middle: Array, size: float, wheels: dict[int, Array]
) -> tuple[list[MirroredPair], list[str], float]:
    """Return the pairs of mirrored joints, the joints without a mirror image, and the median distance of images, m.

    The mirror plane has the unit normal ``left`` (3,) and contains ``middle`` (3,), m. ``size`` is the longest edge of
    the bounding box, m. ``wheels`` maps wheel joints to centres, m, which are used instead of the joints' places.
    """
    flip = np.eye(3) - 2.0 * np.outer(left, left)
    joints = tree.joints
    places = {joint: wheels.get(joint, tree.place(joint)) - middle for joint in joints}
    depths = {joint: len(tree.chain(int(tree.model.jnt_bodyid[joint]))) for joint in joints}
    images: dict[int, tuple[int, float, float, int, float]] = {}
    for joint in joints:
        options = []
        for other in joints:
            if tree.model.jnt_type[other] == tree.model.jnt_type[joint] and depths[other] == depths[joint]:
                gap, axis, hinge = flip @ places[joint] - places[other], tree.data.xaxis[other], tree.is_hinge(joint)
                # ``tilt`` is the angle between the first joint's mirrored axis and the second joint's axis, rad.
                # In a mirror-symmetric pose, both joints have equal (``sign`` 1) or opposite (``sign`` -1) positions.
                # A reflection M turns a rotation about the axis a into the rotation by the same angle about -M a.
                cosine = float(flip @ tree.data.xaxis[joint] * (-1.0 if hinge else 1.0) @ axis)
                tilt, sign = math.acos(min(1.0, abs(cosine))), 1 if cosine >= 0 else -1
                distance = float(np.linalg.norm(gap))
                if distance <= _APART * size and tilt <= _TILTED:
                    if joint not in wheels:
                        gap = np.cross(gap, axis) if hinge else 0.0 * gap
                    options.append((distance / size + tilt, other, float(np.linalg.norm(gap)), tilt, sign, distance))
        if options:
            _, other, offset, tilt, sign, distance = min(options)
            images[joint] = other, offset, tilt, sign, distance
    # Two joints are a mirrored pair only if each joint is the best match of the other.
    pairs, matched, distances = [], set(), [0.0]
    for joint, (other, offset, tilt, sign, distance) in images.items():
        if joint in matched or images.get(other, (None,))[0] != joint:
            continue
        matched |= {joint, other}
        distances.append(distance)
        first, second = (joint, other) if places[joint] @ left >= -_MIDDLE * size else (other, joint)
        pairs.append(MirroredPair(tree.joint_name(first), tree.joint_name(second), sign, offset, tilt))
    return pairs, [tree.joint_name(joint) for joint in joints if joint not in matched], median(distances)
