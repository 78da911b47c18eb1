"""Which joints are mirror images of one another, and how well."""

from __future__ import annotations

import math

import numpy as np

from wheelleg_exp.lint.anatomy.parts import MirroredPair
from wheelleg_exp.lint.anatomy.tree import Array, Tree

_APART = 0.15  # of the robot's size: farther off is no image
_TILTED = math.radians(30)
_MIDDLE = 0.01  # of the robot's size: how near to the plane the middle is


def find_mirrored(
    tree: Tree, left: Array, middle: Array, size: float, wheels: dict[int, Array]
) -> tuple[list[MirroredPair], list[str]]:
    """Return the mirrored pairs, and the joints without an image.

    Args:
        tree: the robot.
        left: unit normal of the mirror's plane, to the left, in the world, (3,).
        middle: a point of the plane, m, (3,).
        size: of the robot, m.
        wheels: the centres of wheels, m, by joint: their colliders say better where they are than their anchors.
    """
    flip = np.eye(3) - 2.0 * np.outer(left, left)
    joints = tree.joints
    places = {joint: wheels.get(joint, tree.data.xanchor[joint]) - middle for joint in joints}
    depths = {joint: len(tree.chain(int(tree.model.jnt_bodyid[joint]))) for joint in joints}
    images: dict[int, tuple[int, float, float, int]] = {}
    for joint in joints:
        options = []
        for other in joints:
            if tree.model.jnt_type[other] == tree.model.jnt_type[joint] and depths[other] == depths[joint]:
                offset = float(np.linalg.norm(flip @ places[joint] - places[other]))
                tilt, sign = _turn(tree, flip, joint, other)
                if offset <= _APART * size and tilt <= _TILTED:
                    options.append((offset / size + tilt, other, offset, tilt, sign))
        if options:
            _, other, offset, tilt, sign = min(options)
            images[joint] = other, offset, tilt, sign
    pairs, matched = [], set()
    for joint, (other, offset, tilt, sign) in images.items():
        if joint in matched or images.get(other, (None,))[0] != joint:
            continue
        matched |= {joint, other}
        first, second = (joint, other) if places[joint] @ left >= -_MIDDLE * size else (other, joint)
        pairs.append(MirroredPair(tree.joint_name(first), tree.joint_name(second), sign, offset, tilt))
    return pairs, [tree.joint_name(joint) for joint in joints if joint not in matched]


def _turn(tree: Tree, flip: Array, joint: int, other: int) -> tuple[float, int]:
    """Return the angle between a joint's mirrored axis and another's, rad, and the sign of its motion.

    A mirror turns the axis of a rotation about: the image of a turn by q about a is one by q about -M a.
    """
    image = flip @ tree.data.xaxis[joint] * (-1.0 if tree.is_hinge(joint) else 1.0)
    cosine = float(image @ tree.data.xaxis[other])
    return math.acos(min(1.0, abs(cosine))), 1 if cosine >= 0 else -1
