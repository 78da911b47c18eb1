"""Find the anatomy of a compiled robot: wheels, legs, forward direction, mirrored joints, and support."""

from __future__ import annotations

import itertools
from collections.abc import Collection, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from wheelleg_exp.anatomy.anatomy_parts import Anatomy, Array, MirroredPair, Side, Tree, Vec3, Wheel
from wheelleg_exp.anatomy.collider_shapes import colliders, reach
from wheelleg_exp.anatomy.limbs import LEVEL, TURNS, Found, driven_joints, find_legs, find_pairs, find_wheels, swivels

_PARALLEL = 0.9  # A robot has a forward direction if at least about 90 % of its axles are parallel.
# ``Wheel.sign`` is 0 for a wheel that rolls at more than 60° to the robot's forward axis.
_ROLLS = 0.5
_IN_THE_MIDDLE = 0.05  # A middle wheel is at most 5 % of the track width away from the robot's middle.
_LEVEL_WITH = 0.03  # A wheel that carries weight is at most 3 % of the robot's size higher than the lowest wheel.
_AHEAD = 0.3  # The forward direction's first component (x, y, or z) of size 0.3 or more is positive.


def anatomy_of(
    model: mujoco.MjModel, qpos: Array | Sequence[float] | None = None, driven: Collection[str] | None = None
) -> Anatomy:
    """Find the parts of a robot at the pose ``qpos`` (nq,), by default qpos0; ValueError for a model without bodies.

    A wheel turns on a horizontal hinge, the last joint of its chain, without limits or with a range of more than one
    and a half turns. Its colliders are near the ground and round about the axis; nearly round ones suffice with a
    wheel's mass distribution. ``driven`` are the joints with a motor: by default those with actuators, or all joints in
    a model without actuators, where only geometry decides which wheels are casters.
    """
    data = mujoco.MjData(model)
    if qpos is not None:
        data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    roots = [body for body in range(1, model.nbody) if model.body_parentid[body] == 0]
    if not roots:
        raise ValueError("the MuJoCo model has no robot bodies")
    below = np.bincount(model.body_rootid[model.jnt_bodyid], minlength=model.nbody)
    tree = Tree(model, data, max(roots, key=lambda body: (int(below[body]), -body)))  # the root of the most joints
    moved = driven_joints(model) if driven is None else {model.joint(name).id for name in driven}
    motors = moved if driven is not None or model.nu else set()
    found, near = find_wheels(tree)
    axles = _axles(tree, found, motors)
    legs = find_legs(tree, [wheel.joint for wheel in found], moved)
    middle, mirrored, unmatched = _mirrored(tree, found, axles.left, axles.size)
    taken = {name for leg in legs for name in (leg.wheel, *leg.joints, *leg.beside)}
    ground = list(itertools.compress(axles.contacts, axles.stands))
    heights = [float((contact - tree.data.xpos[tree.base]) @ tree.up) for contact in axles.contacts]
    return Anatomy(
        base=tree.body_name(tree.base),
        floating=tree.floating,
        size=axles.size,
        wheels=tuple(_wheel(tree, found, axles, number, moved) for number in range(len(found))),
        legs=tuple(legs),
        others=tuple(name for name in map(tree.joint_name, tree.joints) if name not in taken),
        forward=None if axles.forward is None else _vec(tree.to_base @ axles.forward),
        left=None if axles.left is None else _vec(tree.to_base @ axles.left),
        up=_vec(tree.to_base @ tree.up),
        middle=_vec(tree.point(middle)),
        mirrored=tuple(mirrored),
        unmatched=tuple(unmatched),
        support_height=min(heights, default=None),
        support_width=_span(ground, axles.left),
        support_length=_span(ground, axles.forward),
        near=near,
    )


@dataclass(frozen=True)
class _Axles:
    """The robot's size and directions, and each wheel's ground contact and swivels, in world coordinates."""

    size: float
    forward: Array | None
    left: Array | None
    contacts: list[Array]
    stands: list[bool]
    swivels: list[list[int]]


def _axles(tree: Tree, found: Sequence[Found], motors: Collection[int]) -> _Axles:
    contacts = [wheel.centre + wheel.radius * _down(wheel.axis, tree.up) for wheel in found]
    # A wheel behind a swivel without motor is a caster, unless all wheels are behind such joints.
    passive = [[] if set(above) & set(motors) else above for above in (swivels(tree, wheel) for wheel in found)]
    passive = [[] for _ in found] if all(passive) else passive
    forward = _forward(tree, [wheel.axis for wheel, above in zip(found, passive, strict=True) if not above])
    left = np.cross(tree.up, forward) if forward is not None else None
    # ``size`` is the longest edge of the bounding box of the robot's colliders and joints in the base frame, m.
    origin, edges = tree.data.xpos[tree.base], tree.to_base
    solid = colliders(tree.model, tree.bodies)
    anchors = [tree.to_base @ (tree.place(joint) - origin) for joint in tree.joints]
    high, low = np.max([*anchors, np.zeros(3)], axis=0), np.min([*anchors, np.zeros(3)], axis=0)
    if solid:
        high = np.maximum(high, reach(tree.model, tree.data, solid, origin, edges))
        low = np.minimum(low, -reach(tree.model, tree.data, solid, origin, -edges))
    size = float((high - low).max())
    lowest = min((float(contact @ tree.up) for contact in contacts), default=0.0)
    stands = [float(contact @ tree.up) <= lowest + _LEVEL_WITH * size for contact in contacts]
    return _Axles(size, forward, left, contacts, stands, passive)


def _wheel(tree: Tree, wheels: Sequence[Found], axles: _Axles, number: int, moved: Collection[int]) -> Wheel:
    found = wheels[number]
    rolling = float(np.cross(found.axis, tree.up) @ axles.forward) if axles.forward is not None else 0.0
    above = tree.chain(int(tree.model.jnt_bodyid[found.joint]))[-2:-1]
    turning = [joint for joint in above if tree.is_hinge(joint) and tree.turns(joint) > TURNS]
    return Wheel(
        joint=tree.joint_name(found.joint),
        body=tree.body_name(int(tree.model.jnt_bodyid[found.joint])),
        bodies=tuple(map(tree.body_name, found.bodies)),
        axis=_vec(tree.to_base @ found.axis),
        centre=_vec(tree.point(found.centre)),
        radius=found.radius,
        width=found.width,
        roundness=found.roundness,
        contact=_vec(tree.point(axles.contacts[number])),
        side=_side(found.centre, wheels, axles.left),
        sign=0 if abs(rolling) < _ROLLS else (1 if rolling > 0 else -1),
        driven=found.joint in moved and not axles.swivels[number],
        stands=axles.stands[number],
        steered=any(abs(float(tree.data.xaxis[joint] @ tree.up)) > 1.0 - LEVEL / 2 for joint in turning),
        caster=bool(axles.swivels[number]),
        swivels=tuple(map(tree.joint_name, axles.swivels[number])),
        why=found.why,
    )


def _down(axis: Array, up: Array) -> Array:
    """Return the direction from a wheel's centre to the ground: down, in the wheel's plane."""
    down = -up + (up @ axis) * axis
    return down / np.linalg.norm(down)


def _forward(tree: Tree, axes: Sequence[Array]) -> Array | None:
    """Return the horizontal direction in which a robot's parallel axles roll; None if the axles are not parallel."""
    if not axes:
        return None
    level = [axis - (axis @ tree.up) * tree.up for axis in axes]
    # Average the outer products axis axisᵀ, so that the signs of the wheels' axes do not matter.
    sizes, directions = np.linalg.eigh(sum(np.outer(axis, axis) for axis in level) / len(level))
    if sizes[-1] < _PARALLEL * sizes.sum():
        return None
    forward = np.cross(directions[:, -1], tree.up)
    forward /= np.linalg.norm(forward)
    x, y, z = tree.to_base @ forward
    along = next(part for part in (x, y, z) if abs(part) >= _AHEAD)
    return forward if along > 0 else -forward


def _side(centre: Array, wheels: Sequence[Found], left: Array | None) -> Side:
    if left is None:
        return "middle"
    places = [float(wheel.centre @ left) for wheel in wheels]
    offset = float(centre @ left) - (max(places) + min(places)) / 2
    if abs(offset) <= _IN_THE_MIDDLE * (max(places) - min(places)):
        return "middle"
    return "left" if offset > 0 else "right"


def _span(points: Sequence[Array], direction: Array | None) -> float:
    if direction is None or not points:
        return 0.0
    places = [float(point @ direction) for point in points]
    return max(places) - min(places)


def _mirrored(
    tree: Tree, wheels: Sequence[Found], left: Array | None, size: float
) -> tuple[Array, list[MirroredPair], list[str]]:
    """Return a point of the mirror plane (world, m), the mirrored pairs of joints, and the joints without a partner."""
    normal, origin = left if left is not None else tree.to_base[1], tree.data.xpos[tree.base]
    # Try mirror planes through the base's origin and midway between the wheels; keep the plane that pairs more joints.
    middles = [origin]
    if wheels:
        places = [float(wheel.centre @ normal) for wheel in wheels]
        middles.append(origin + ((max(places) + min(places)) / 2 - float(origin @ normal)) * normal)
    centres = {wheel.joint: wheel.centre for wheel in wheels}
    found = [(middle, *find_pairs(tree, normal, middle, max(size, 1e-9), centres)) for middle in middles]
    return min(found, key=lambda one: (len(one[2]), one[3]))[:3]


def _vec(vector: Array) -> Vec3:
    x, y, z = (round(float(part), 9) + 0.0 for part in vector)
    return x, y, z
