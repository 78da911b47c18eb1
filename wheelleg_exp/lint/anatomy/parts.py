"""The parts of a robot, as plain data in SI units; vectors are in the frame of the base body."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

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
