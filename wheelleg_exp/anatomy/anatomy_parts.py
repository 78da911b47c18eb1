"""The parts of a robot as plain data in SI units, and the body tree of its compiled model.

Vectors of the parts are in the frame of the base body. Vectors of the body tree are in the world frame.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import mujoco
import numpy as np
from numpy.typing import NDArray

Vec3 = tuple[float, float, float]
Side = Literal["left", "right", "middle"]


@dataclass(frozen=True)
class Wheel:
    """A wheel that can carry the robot's weight."""

    joint: str  # the hinge that the wheel turns on
    body: str  # the link that the hinge moves; ``bodies`` also has the links that are fixed to it
    bodies: tuple[str, ...]
    axis: Vec3
    centre: Vec3  # centre of the collider, on the hinge's ``axis`` (a unit vector), m
    radius: float  # largest extent of the colliders across the axis, m; ``width`` is their extent along the axis
    width: float
    roundness: float  # smallest extent across the axis over the largest; 1 for a body of revolution
    contact: Vec3  # the point that touches level ground, m
    side: Side  # relative to the robot's middle, seen along its forward axis
    sign: int  # +1 if positive speed rolls the robot forwards, -1 backwards, 0 if the wheel rolls another way
    driven: bool  # whether a motor drives the wheel; false for a caster
    stands: bool  # whether the wheel is as low as the lowest wheel, and so carries the robot on level ground
    steered: bool  # whether its parent joint turns without limits about an upright axis, as in a swerve drive
    # whether the wheel is steered and trails a steering axis without motor. False for all wheels of a robot that has no
    # other wheels.
    caster: bool
    why: str  # the reason with its figures


@dataclass(frozen=True)
class Leg:
    """The chain of ``joints`` from the base to one wheel, without the wheel's joint; ``passive`` joints have no motor.

    ``beside`` are joints of the same limb on no wheel's chain, usually the other half of a closed loop. ``loops`` names
    the equality constraints that close loops in the limb.
    """

    wheel: str
    joints: tuple[str, ...]
    passive: tuple[str, ...]
    beside: tuple[str, ...]
    loops: tuple[str, ...]


@dataclass(frozen=True)
class MirroredPair:
    """Two joints that are mirror images, ``left`` and ``right``, or one joint that is its own image.

    The mirror image of ``left`` at position q is ``right`` at position ``sign`` · q. ``offset`` is the distance of the
    right joint's axis from the image of the left joint's axis, m, and ``tilt`` is the angle between them, rad.
    """

    left: str
    right: str
    sign: int
    offset: float
    tilt: float


@dataclass(frozen=True)
class Anatomy:
    """A robot's parts at one pose."""

    base: str  # the root link
    floating: bool  # whether the base moves freely
    size: float  # longest edge of the box, along the base's axes, around all colliders and joints, m
    wheels: tuple[Wheel, ...]  # in the order of the model
    legs: tuple[Leg, ...]  # one for each wheel
    others: tuple[str, ...]  # joints of no leg and no wheel: arms, or the legs of a robot without wheels
    # the level direction in which the wheels roll, casters ignored; None without wheels, or if their axles are not
    # parallel
    forward: Vec3 | None
    left: Vec3 | None  # the level direction to the left of ``forward``
    up: Vec3  # against gravity
    middle: Vec3  # a point of the plane between left and right, m
    mirrored: tuple[MirroredPair, ...]  # mirrored joints; each pair once, the left one first
    unmatched: tuple[str, ...]  # joints without a mirror image
    # of the wheels' contacts relative to the base's origin, m (negative: below); None without wheels
    support_height: float | None
    support_width: float  # between the outermost contacts across ``forward``, m
    support_length: float  # between the outermost contacts along ``forward``, m; almost 0 on one axle
    near: dict[str, str]  # joints that lack one property of a wheel, and which

    @property
    def wheel_joints(self) -> list[str]:
        """Names of the wheels' joints."""
        return [wheel.joint for wheel in self.wheels]

    @property
    def standing(self) -> list[Wheel]:
        """The wheels that carry the robot on level ground."""
        return [wheel for wheel in self.wheels if wheel.stands]

    @property
    def one_axle(self) -> bool:
        """Whether all wheels that carry the robot share one axle, so that the robot must balance."""
        return bool(self.wheels) and self.support_length < min(wheel.radius for wheel in self.standing) / 2


Array = NDArray[np.float64]

_JOINT = mujoco.mjtJoint
_OBJECT = mujoco.mjtObj


@dataclass(frozen=True)
class Tree:
    """A robot in its compiled model at one pose, with positions and axes computed; ``base`` is the root body."""

    model: mujoco.MjModel
    data: mujoco.MjData
    base: int

    @cached_property
    def bodies(self) -> list[int]:
        """The base and all bodies below it, in the model's order."""
        return self.below(self.base)

    @cached_property
    def joints(self) -> list[int]:
        """The robot's hinge, slide, and ball joints, in the model's order."""
        model, bodies = self.model, set(self.bodies)
        return [
            joint
            for joint in range(model.njnt)
            if int(model.jnt_bodyid[joint]) in bodies and model.jnt_type[joint] != _JOINT.mjJNT_FREE
        ]

    @property
    def floating(self) -> bool:
        """Whether the base moves freely."""
        model = self.model
        return any(model.jnt_type[joint] == _JOINT.mjJNT_FREE for joint in self.joints_of(self.base))

    def below(self, body: int) -> list[int]:
        """Return a body and all bodies below it."""
        found = {body}
        for other in range(body + 1, self.model.nbody):  # In MuJoCo, parents have smaller indices than children.
            if int(self.model.body_parentid[other]) in found:
                found.add(other)
        return sorted(found)

    def fixed_to(self, body: int) -> list[int]:
        """Return a body and all descendants that are welded to this body."""
        weld = self.model.body_weldid
        return [other for other in self.below(body) if weld[other] == weld[body]]

    def joints_of(self, body: int) -> list[int]:
        """Return the joints between a body and its parent."""
        start = int(self.model.body_jntadr[body])
        return list(range(start, start + int(self.model.body_jntnum[body])))

    def chain(self, body: int) -> list[int]:
        """Return the joints from the base to a body, in this order, without the joints of the base."""
        found: list[int] = []
        while body not in (self.base, 0):
            found = self.joints_of(body) + found
            body = int(self.model.body_parentid[body])
        return found

    def is_hinge(self, joint: int) -> bool:
        """Return whether a joint is a hinge."""
        return bool(self.model.jnt_type[joint] == _JOINT.mjJNT_HINGE)

    def turns(self, joint: int) -> float:
        """Return the width of a hinge's range, rad; inf if the hinge has no limits."""
        low, high = self.model.jnt_range[joint]
        return float(high - low) if self.model.jnt_limited[joint] else float("inf")

    def joint_name(self, joint: int) -> str:
        """Return a joint's name, or its number if the joint has no name."""
        return mujoco.mj_id2name(self.model, _OBJECT.mjOBJ_JOINT, joint) or f"#{joint}"

    def body_name(self, body: int) -> str:
        """Return a body's name, or its number if the body has no name."""
        return mujoco.mj_id2name(self.model, _OBJECT.mjOBJ_BODY, body) or f"#{body}"

    @cached_property
    def to_base(self) -> Array:
        """The rotation from the world's axes to the base's, (3, 3)."""
        rotation: Array = self.data.xmat[self.base].reshape(3, 3).T
        return rotation

    def point(self, world: Array) -> Array:
        """Return a point of the world in the base's frame, m."""
        found: Array = self.to_base @ (world - self.data.xpos[self.base])
        return found

    @cached_property
    def up(self) -> Array:
        """The direction against gravity in the world; z without gravity."""
        gravity = self.model.opt.gravity
        size = float(np.linalg.norm(gravity))
        return -gravity / size if size > 0 else np.array([0.0, 0.0, 1.0])


def find_base(model: mujoco.MjModel) -> int:
    """Return the robot's root: the body on the world with the most joints below it; ValueError without bodies."""
    roots = [body for body in range(1, model.nbody) if model.body_parentid[body] == 0]
    if not roots:
        raise ValueError("the model has no bodies")
    joints = np.bincount(model.body_rootid[model.jnt_bodyid], minlength=model.nbody)
    return max(roots, key=lambda body: (int(joints[body]), -body))
