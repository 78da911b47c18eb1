"""Find the anatomy of a compiled robot: wheels, legs, forward direction, mirrored joints, and support."""

from __future__ import annotations

import itertools
from collections.abc import Collection, Sequence
from statistics import median

import mujoco
import numpy as np

from wheelleg_exp.anatomy.anatomy_parts import Anatomy, Array, MirroredPair, Side, Tree, Vec3, Wheel, find_base
from wheelleg_exp.anatomy.collider_shapes import colliders, reach
from wheelleg_exp.anatomy.limbs import LEVEL, TURNS, Found, driven_joints, find_legs, find_mirrored, find_wheels

_PARALLEL = 0.9  # share of the axles that lie along one line, from which on they have a direction
_ROLLS = 0.5  # cosine between a wheel's rolling and the forward axis, below which it rolls another way
_MIDDLE = 0.05  # of the widest track: how far off the middle a wheel still is in it
_LEVEL_WITH = 0.03  # of the robot's size, above the lowest contact: a wheel this low stands on the ground
_AHEAD = 0.3  # of a level direction: from here on its sign follows the base's x, else its y
_TRAILS = 0.1  # of a wheel's radius: a caster's contact is at least this far from its steering axis


def anatomy_of(
    model: mujoco.MjModel, qpos: Array | Sequence[float] | None = None, driven: Collection[str] | None = None
) -> Anatomy:
    """Find out what a robot's parts are for.

    A wheel turns on a hinge without limits (or with more than one and a half turns between them), about a level axis,
    the last of its chain; its colliders are round about that axis, or nearly so with the masses of a wheel, and lie
    low enough to stand on.

    Args:
        model: the compiled robot, perhaps in its scene.
        qpos: the pose to look at, (nq,); by default the model's own.
        driven: joints that something drives; by default those with actuators in the model, or, where it has none, all.
            Without either, a caster is recognised by its geometry alone.

    Raises:
        ValueError: the model has no bodies.
    """
    data = mujoco.MjData(model)
    if qpos is not None:
        data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    tree = Tree(model, data, find_base(model))
    moved = driven_joints(model) if driven is None else {model.joint(name).id for name in driven}
    motors = moved if driven is not None or model.nu else set()
    found, near = find_wheels(tree)
    contacts = [wheel.centre + wheel.radius * _down(wheel.axis, tree.up) for wheel in found]
    steering = [_steering_joint(tree, wheel.joint) for wheel in found]
    casters = _casters(tree, found, [None if joint in motors else joint for joint in steering])
    forward = _forward(tree, [wheel.axis for wheel, caster in zip(found, casters, strict=True) if not caster])
    left = np.cross(tree.up, forward) if forward is not None else None
    size = _size(tree)
    middle, mirrored, unmatched = _mirrored(tree, found, left, size)
    lowest = min((float(contact @ tree.up) for contact in contacts), default=0.0)
    stands = [float(contact @ tree.up) <= lowest + _LEVEL_WITH * size for contact in contacts]
    ground = list(itertools.compress(contacts, stands))
    width, length = _span(ground, left), _span(ground, forward)
    wheels = [
        _wheel(
            tree,
            wheel,
            contact,
            forward,
            side=_side(wheel.centre, found, left),
            driven=wheel.joint in moved,
            stands=stood,
            steered=joint is not None,
            caster=caster,
        )
        for wheel, contact, stood, joint, caster in zip(found, contacts, stands, steering, casters, strict=True)
    ]
    legs = find_legs(tree, [wheel.joint for wheel in found], moved)
    taken = {name for leg in legs for name in (leg.wheel, *leg.joints, *leg.beside)}
    return Anatomy(
        base=tree.body_name(tree.base),
        floating=tree.floating,
        size=size,
        wheels=tuple(wheels),
        legs=tuple(legs),
        others=tuple(name for name in map(tree.joint_name, tree.joints) if name not in taken),
        forward=None if forward is None else _vec(tree.to_base @ forward),
        left=None if left is None else _vec(tree.to_base @ left),
        up=_vec(tree.to_base @ tree.up),
        middle=_vec(tree.point(middle)),
        mirrored=tuple(mirrored),
        unmatched=tuple(unmatched),
        support_height=min(float((c - data.xpos[tree.base]) @ tree.up) for c in contacts) if contacts else None,
        support_width=width,
        support_length=length,
        near={tree.joint_name(joint): why for joint, why in near.items()},
    )


def _wheel(
    tree: Tree,
    found: Found,
    contact: Array,
    forward: Array | None,
    *,
    side: Side,
    driven: bool,
    stands: bool,
    steered: bool,
    caster: bool,
) -> Wheel:
    rolling = float(np.cross(found.axis, tree.up) @ forward) if forward is not None else 0.0
    body = int(tree.model.jnt_bodyid[found.joint])
    return Wheel(
        joint=tree.joint_name(found.joint),
        body=tree.body_name(body),
        bodies=tuple(map(tree.body_name, found.bodies)),
        axis=_vec(tree.to_base @ found.axis),
        centre=_vec(tree.point(found.centre)),
        radius=found.radius,
        width=found.width,
        roundness=found.roundness,
        contact=_vec(tree.point(contact)),
        side=side,
        sign=0 if abs(rolling) < _ROLLS else (1 if rolling > 0 else -1),
        driven=driven,
        stands=stands,
        steered=steered,
        caster=caster,
        why=found.why,
    )


def _down(axis: Array, up: Array) -> Array:
    """Return the direction from a wheel's centre to the ground: straight down, in the wheel's plane."""
    down = -up + (up @ axis) * axis
    unit: Array = down / np.linalg.norm(down)
    return unit


def _steering_joint(tree: Tree, wheel: int) -> int | None:
    """Return the joint right above a wheel's if it is an upright hinge without limits, else None."""
    for joint in tree.chain(int(tree.model.jnt_bodyid[wheel]))[-2:-1]:
        upright = abs(float(tree.data.xaxis[joint] @ tree.up)) > 1.0 - LEVEL / 2
        if upright and tree.is_hinge(joint) and tree.turns(joint) > TURNS:
            return joint
    return None


def _casters(tree: Tree, wheels: Sequence[Found], hinges: Sequence[int | None]) -> list[bool]:
    """Return which wheels trail their passive steering hinge; none of them if all do."""
    casters = [hinge is not None and _trails(tree, wheel, hinge) for wheel, hinge in zip(wheels, hinges, strict=True)]
    return [caster and not all(casters) for caster in casters]


def _trails(tree: Tree, wheel: Found, steering: int) -> bool:
    """Return whether a wheel touches the ground beside its steering axis, along its own rolling direction."""
    offset = (wheel.centre - tree.data.xanchor[steering]) @ np.cross(wheel.axis, tree.up)
    return abs(float(offset)) > _TRAILS * wheel.radius


def _forward(tree: Tree, axes: Sequence[Array]) -> Array | None:
    """Return the level direction across the axles, along the base's x rather than against it; None unless parallel."""
    if not axes:
        return None
    level = [axis - (axis @ tree.up) * tree.up for axis in axes]
    sizes, directions = np.linalg.eigh(sum(np.outer(axis, axis) for axis in level) / len(level))
    if sizes[-1] < _PARALLEL * sizes.sum():
        return None
    forward = np.cross(directions[:, -1], tree.up)
    forward /= np.linalg.norm(forward)
    x, y, z = tree.to_base @ forward
    along = next(part for part in (x, y, z) if abs(part) >= _AHEAD)
    ahead: Array = forward if along > 0 else -forward
    return ahead


def _side(centre: Array, wheels: Sequence[Found], left: Array | None) -> Side:
    if left is None:
        return "middle"
    places = [float(wheel.centre @ left) for wheel in wheels]
    offset = float(centre @ left) - (max(places) + min(places)) / 2
    if abs(offset) <= _MIDDLE * (max(places) - min(places)):
        return "middle"
    return "left" if offset > 0 else "right"


def _span(points: Sequence[Array], direction: Array | None) -> float:
    if direction is None or not points:
        return 0.0
    places = [float(point @ direction) for point in points]
    return max(places) - min(places)


def _size(tree: Tree) -> float:
    """Return the longest edge of the box around all colliders and joints, along the base's axes, m."""
    origin, edges = tree.data.xpos[tree.base], tree.to_base
    solid = colliders(tree.model, tree.bodies)
    anchors = [tree.to_base @ (tree.data.xanchor[joint] - origin) for joint in tree.joints]
    high, low = np.max([*anchors, np.zeros(3)], axis=0), np.min([*anchors, np.zeros(3)], axis=0)
    if solid:
        high = np.maximum(high, reach(tree.model, tree.data, solid, origin, edges))
        low = np.minimum(low, -reach(tree.model, tree.data, solid, origin, -edges))
    return float((high - low).max())


def _mirrored(
    tree: Tree, wheels: Sequence[Found], left: Array | None, size: float
) -> tuple[Array, list[MirroredPair], list[str]]:
    """Match joints across the base's own middle or that between the wheels, whichever shows the better images.

    Returns:
        A point of the mirror's plane in the world, m, (3,), the pairs, and the joints without an image.
    """
    normal, origin = left if left is not None else tree.to_base[1], tree.data.xpos[tree.base]
    middles = [origin]
    if wheels:
        places = [float(wheel.centre @ normal) for wheel in wheels]
        middles.append(origin + ((max(places) + min(places)) / 2 - float(origin @ normal)) * normal)
    centres = {wheel.joint: wheel.centre for wheel in wheels}
    found = [(middle, *find_mirrored(tree, normal, middle, max(size, 1e-9), centres)) for middle in middles]
    return min(found, key=lambda one: (len(one[2]), median([0.0, *(pair.offset for pair in one[1])])))


def _vec(vector: Array) -> Vec3:
    x, y, z = (round(float(part), 9) + 0.0 for part in vector)
    return x, y, z
