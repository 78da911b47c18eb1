"""The parts of a robot as plain data in SI units, and the body tree of its compiled model.

Vectors of the parts are in the frame of the base body; those of the tree are in the world frame.
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
    """A wheel that can carry the robot.

    Attributes:
        joint: the hinge that it turns on.
        body: the link that the hinge moves.
        bodies: that link and those fixed to it.
        axis: of the hinge, a unit vector.
        centre: of the collider, on the axis, m.
        radius: largest reach of the colliders across the axis, m.
        width: of the colliders along the axis, m.
        roundness: least reach across the axis over the largest; 1 for a body of revolution about the axis.
        contact: the point that touches level ground, m.
        side: of the robot's middle, seen along its forward axis.
        sign: +1 when positive speed rolls the robot forwards, -1 backwards, 0 when it does not roll that way.
        driven: whether something drives it; a caster is not.
        stands: whether it is as low as the lowest, and so carries the robot on level ground.
        steered: whether the joint right above turns without limits about an upright axis, as that of a swerve drive.
        caster: whether the wheel is steered, trails its steering axis, and nothing drives that axis. False for all
            wheels of a robot that has no others.
        why: how it is known, with the figures.
    """

    joint: str
    body: str
    bodies: tuple[str, ...]
    axis: Vec3
    centre: Vec3
    radius: float
    width: float
    roundness: float
    contact: Vec3
    side: Side
    sign: int
    driven: bool
    stands: bool
    steered: bool
    caster: bool
    why: str


@dataclass(frozen=True)
class Leg:
    """The chain from the base to one wheel.

    Attributes:
        wheel: the wheel's joint.
        joints: of the chain, from the base on, without the wheel's.
        passive: those of ``joints`` that nothing drives.
        beside: joints of the same limb on no wheel's chain: the other half of a closed loop, most often.
        loops: names of the equality constraints that close loops in the limb.
    """

    wheel: str
    joints: tuple[str, ...]
    passive: tuple[str, ...]
    beside: tuple[str, ...]
    loops: tuple[str, ...]


@dataclass(frozen=True)
class MirroredPair:
    """Two joints that are mirror images, or one that is its own.

    Attributes:
        left: the joint on the left, or in the middle.
        right: its image.
        sign: the image of ``left`` at q is ``right`` at sign · q.
        offset: distance of the right joint's axis from the image of the left one's, m.
        tilt: angle between them, rad.
    """

    left: str
    right: str
    sign: int
    offset: float
    tilt: float


@dataclass(frozen=True)
class Anatomy:
    """A robot's parts at one pose.

    Attributes:
        base: the root link.
        floating: whether it moves freely.
        size: longest edge of the box, along the base's axes, around all colliders and joints, m.
        wheels: in the order of the model.
        legs: one for each wheel.
        others: joints of no leg and no wheel: arms, or the legs of a robot without wheels.
        forward: the level direction in which the wheels roll; None without wheels, or if their axles are not parallel.
            Casters do not count.
        left: the level direction to the left of ``forward``.
        up: against gravity.
        middle: a point of the plane between left and right, m.
        mirrored: mirrored joints; a pair once, with the left one first.
        unmatched: joints without a mirror image.
        support_height: of the wheels' contacts under the base's origin, m (negative: below); None without wheels.
        support_width: between the outermost contacts across ``forward``, m.
        support_length: between the outermost contacts along ``forward``, m; next to 0 on one axle.
        near: joints that lack one thing to be a wheel's, and what.
    """

    base: str
    floating: bool
    size: float
    wheels: tuple[Wheel, ...]
    legs: tuple[Leg, ...]
    others: tuple[str, ...]
    forward: Vec3 | None
    left: Vec3 | None
    up: Vec3
    middle: Vec3
    mirrored: tuple[MirroredPair, ...]
    unmatched: tuple[str, ...]
    support_height: float | None
    support_width: float
    support_length: float
    near: dict[str, str]

    @property
    def wheel_joints(self) -> list[str]:
        """Names of the joints that wheels turn on."""
        return [wheel.joint for wheel in self.wheels]

    @property
    def standing(self) -> list[Wheel]:
        """The wheels that carry the robot on level ground."""
        return [wheel for wheel in self.wheels if wheel.stands]

    @property
    def one_axle(self) -> bool:
        """Whether all wheels that carry the robot turn about the same line, so that it has to balance."""
        return bool(self.wheels) and self.support_length < min(wheel.radius for wheel in self.standing) / 2


Array = NDArray[np.float64]

_JOINT = mujoco.mjtJoint
_OBJECT = mujoco.mjtObj


@dataclass(frozen=True)
class Tree:
    """A robot in its model, at one pose.

    Attributes:
        model: the compiled robot, perhaps in its scene.
        data: its pose, with positions and axes computed.
        base: the root body.
    """

    model: mujoco.MjModel
    data: mujoco.MjData
    base: int

    @cached_property
    def bodies(self) -> list[int]:
        """The base and all that hangs on it, in the model's order."""
        return self.below(self.base)

    @cached_property
    def joints(self) -> list[int]:
        """Hinges, slides and balls of the robot, in the model's order."""
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
        """Return a body and those that hang on it."""
        found = {body}
        for other in range(body + 1, self.model.nbody):  # parents stand before their children
            if int(self.model.body_parentid[other]) in found:
                found.add(other)
        return sorted(found)

    def fixed_to(self, body: int) -> list[int]:
        """Return a body and those below it that do not move against it."""
        weld = self.model.body_weldid
        return [other for other in self.below(body) if weld[other] == weld[body]]

    def joints_of(self, body: int) -> list[int]:
        """Return the joints that move a body against its parent."""
        start = int(self.model.body_jntadr[body])
        return list(range(start, start + int(self.model.body_jntnum[body])))

    def chain(self, body: int) -> list[int]:
        """Return the joints from the base to a body, its own last; those of the base itself are left out."""
        found: list[int] = []
        while body not in (self.base, 0):
            found = self.joints_of(body) + found
            body = int(self.model.body_parentid[body])
        return found

    def is_hinge(self, joint: int) -> bool:
        """Return whether a joint turns about one axis."""
        return bool(self.model.jnt_type[joint] == _JOINT.mjJNT_HINGE)

    def turns(self, joint: int) -> float:
        """Return the range of a hinge in rad; inf without limits."""
        low, high = self.model.jnt_range[joint]
        return float(high - low) if self.model.jnt_limited[joint] else float("inf")

    def joint_name(self, joint: int) -> str:
        """Return a joint's name, or its number where it has none."""
        return mujoco.mj_id2name(self.model, _OBJECT.mjOBJ_JOINT, joint) or f"#{joint}"

    def body_name(self, body: int) -> str:
        """Return a body's name, or its number where it has none."""
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
        """The direction against gravity in the world; z where there is no gravity."""
        gravity = self.model.opt.gravity
        size = float(np.linalg.norm(gravity))
        return -gravity / size if size > 0 else np.array([0.0, 0.0, 1.0])


def find_base(model: mujoco.MjModel) -> int:
    """Return the body on the world with the most joints below it: the robot's, beside loose things.

    Raises:
        ValueError: the model has no bodies.
    """
    roots = [body for body in range(1, model.nbody) if model.body_parentid[body] == 0]
    if not roots:
        raise ValueError("the model has no bodies")
    joints = np.bincount(model.body_rootid[model.jnt_bodyid], minlength=model.nbody)
    return max(roots, key=lambda body: (int(joints[body]), -body))
