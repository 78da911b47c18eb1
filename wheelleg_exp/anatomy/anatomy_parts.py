"""The parts of a robot, such as wheels and legs, in SI units and the root body's frame, and its tree in the world's."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import mujoco
import numpy as np
from numpy.typing import NDArray

Vec3 = tuple[float, float, float]
Side = Literal["left", "right", "middle"]
_NARROW = 0.5  # A robot on one wheel falls sideways if the wheel is narrower than half its radius.


@dataclass(frozen=True)
class Wheel:
    """One wheel of a robot: its joint, links, shape, ground contact, and motor."""

    joint: str  # the name of the hinge on which the wheel turns
    body: str  # the name of the wheel's link; ``bodies`` names this link and the links that are fixed to the link
    bodies: tuple[str, ...]
    axis: Vec3
    centre: Vec3  # the centre of the wheel's colliders in the base frame, m; ``axis`` is the wheel axle's unit vector
    radius: float  # the wheel's radius, m; ``width`` is the wheel's width along its axle, m
    width: float
    roundness: float  # the wheel's smallest radius divided by its largest radius; 1 for a perfect circle
    contact: Vec3  # the point at which the wheel touches level ground, m
    side: Side  # the side of the robot (left, right, or middle) on which the wheel is
    sign: int  # the direction in which a positive joint speed rolls the wheel: +1 forwards, -1 backwards, 0 sideways
    driven: bool  # whether a motor drives the wheel; false for a caster
    stands: bool  # whether the wheel touches level ground on which the robot stands
    steered: bool  # whether a vertical hinge without limits steers the wheel, as in a swerve drive
    # ``caster`` is true for a wheel behind joints without motor, ``swivels``, unless all wheels are behind such joints.
    caster: bool
    swivels: tuple[str, ...]
    why: str  # a text for the user: the reason why the link counts as a wheel


@dataclass(frozen=True)
class Leg:
    """The joints between the robot's base and a wheel; the joints in ``Leg.passive`` have no motor.

    ``Leg.beside`` names the leg's joints outside the chain from base to wheel, as in one half of a closed loop.
    ``Leg.loops`` names the MuJoCo equality constraints that close kinematic loops in a leg.
    """

    wheel: str
    joints: tuple[str, ...]
    passive: tuple[str, ...]
    beside: tuple[str, ...]
    loops: tuple[str, ...]


@dataclass(frozen=True)
class MirroredPair:
    """Two joints that are mirror images, ``left`` and ``right``, or one joint that is its own image.

    The image of the left position q is the right position ``sign`` · q. The image of the left axis is ``offset`` (m)
    and ``tilt`` (rad) away from the right axis. A shift along a hinge's axis, or of a slide, does not count.
    """

    left: str
    right: str
    sign: int
    offset: float
    tilt: float


@dataclass(frozen=True)
class Anatomy:
    """The wheels, legs, and other parts of a robot at one pose."""

    base: str  # the root link
    floating: bool  # whether the robot's base can move freely in the world
    size: float  # the longest edge of the robot's bounding box along the base's axes, m
    wheels: tuple[Wheel, ...]  # the robot's wheels, in the order of the model
    legs: tuple[Leg, ...]  # one for each wheel
    others: tuple[str, ...]  # the names of joints outside of legs and wheels, such as the joints of an arm
    # ``forward`` is the horizontal unit vector in which the wheels roll; None for a robot without parallel axles.
    forward: Vec3 | None
    left: Vec3 | None  # the horizontal unit vector to the left of the robot's forward direction
    up: Vec3  # against gravity
    middle: Vec3  # a point on the plane between the robot's left and right halves, m
    mirrored: tuple[MirroredPair, ...]  # the pairs of joints that are mirror images, with the left joint first
    unmatched: tuple[str, ...]  # names of the joints that have no mirror image on the other side of the robot
    # ``support_height`` is the height of the wheel contacts above the base frame's origin, m, so usually negative.
    support_height: float | None
    support_width: float  # the largest distance between two wheel contacts along the robot's left axis, m
    support_length: float  # the largest distance between two wheel contacts along the forward axis, m
    near: dict[str, str]  # maps joints and fixed links that look like wheels to the reason why they cannot roll

    @property
    def wheel_joints(self) -> list[str]:
        return [wheel.joint for wheel in self.wheels]

    @property
    def casters(self) -> set[str]:
        """Names of the casters' joints: the wheels and the swivels above them."""
        return {name for wheel in self.wheels if wheel.swivels for name in (wheel.joint, *wheel.swivels)}

    @property
    def standing(self) -> list[Wheel]:
        """The wheels that carry the robot on level ground."""
        return [wheel for wheel in self.wheels if wheel.stands]

    @property
    def cannot_stand(self) -> str:
        """Why the robot cannot stand on its wheels: one cannot roll, or it has one narrow wheel; empty if it can."""
        wheels, near = set(self.wheel_joints), set(self.near)
        pairs = [{pair.left, pair.right} for pair in self.mirrored]
        if near and (not wheels or any(wheels & pair and near & pair for pair in pairs)):
            return "; ".join(f"'{name}' would be a wheel, but {why}" for name, why in self.near.items())
        narrow = len(wheels) == 1 and self.wheels[0].width < _NARROW * self.wheels[0].radius
        return f"the robot stands on one wheel, '{self.wheels[0].joint}', and falls sideways" if narrow else ""

    @property
    def one_axle(self) -> bool:
        """Whether all wheels that carry the robot share one axle, so that the robot must balance."""
        return bool(self.wheels) and self.support_length < min(wheel.radius for wheel in self.standing) / 2


Array = NDArray[np.float64]

_JOINT = mujoco.mjtJoint
_OBJECT = mujoco.mjtObj


@dataclass(frozen=True)
class Tree:
    """The body tree of a MuJoCo model at the pose in ``data``; ``base`` is the id of the root body."""

    model: mujoco.MjModel
    data: mujoco.MjData
    base: int

    @cached_property
    def bodies(self) -> list[int]:
        """The ids of the root body and of all its descendants, in the order of the MuJoCo model."""
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
        model = self.model
        return any(model.jnt_type[joint] == _JOINT.mjJNT_FREE for joint in self.joints_of(self.base))

    def below(self, body: int) -> list[int]:
        """Return a body and all bodies below it."""
        found = {body}
        for other in range(body + 1, self.model.nbody):  # In MuJoCo, a parent has a smaller index than its children.
            if int(self.model.body_parentid[other]) in found:
                found.add(other)
        return sorted(found)

    def joints_of(self, body: int) -> list[int]:
        """Return the joints between a body and its parent."""
        start = int(self.model.body_jntadr[body])
        return list(range(start, start + int(self.model.body_jntnum[body])))

    def chain(self, body: int) -> list[int]:
        """Return the joints between the base and a body, nearest to the base first, without the base's own joints."""
        found: list[int] = []
        while body not in (self.base, 0):
            found = self.joints_of(body) + found
            body = int(self.model.body_parentid[body])
        return found

    def is_hinge(self, joint: int) -> bool:
        return bool(self.model.jnt_type[joint] == _JOINT.mjJNT_HINGE)

    def turns(self, joint: int) -> float:
        """Return the width of a hinge's range, rad; inf if the hinge has no limits."""
        low, high = self.model.jnt_range[joint]
        return float(high - low) if self.model.jnt_limited[joint] else float("inf")

    def place(self, joint: int) -> Array:
        """Return a hinge axis' point nearest to the centre of mass that it moves, or for a slide, this centre, m."""
        anchor, axis = self.data.xanchor[joint], self.data.xaxis[joint]
        centre: Array = self.data.subtree_com[self.model.jnt_bodyid[joint]].copy()
        return anchor + (centre - anchor) @ axis * axis if self.is_hinge(joint) else centre

    def joint_name(self, joint: int) -> str:
        """Return a joint's name, or its number if the joint has no name."""
        return mujoco.mj_id2name(self.model, _OBJECT.mjOBJ_JOINT, joint) or f"#{joint}"

    def body_name(self, body: int) -> str:
        """Return a body's name, or its number if the body has no name."""
        return mujoco.mj_id2name(self.model, _OBJECT.mjOBJ_BODY, body) or f"#{body}"

    @cached_property
    def to_base(self) -> Array:
        """The rotation from the axes of the world to the axes of the base, (3, 3)."""
        return np.asarray(self.data.xmat[self.base].reshape(3, 3).T)

    def point(self, world: Array) -> Array:
        """Convert a point from world coordinates to coordinates of the base, m."""
        return np.asarray(self.to_base @ (world - self.data.xpos[self.base]))

    @cached_property
    def up(self) -> Array:
        """The direction opposite to gravity in the world; the z axis if the model has no gravity."""
        gravity = self.model.opt.gravity
        size = float(np.linalg.norm(gravity))
        return -gravity / size if size > 0 else np.array([0.0, 0.0, 1.0])
