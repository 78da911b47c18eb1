"""The tree of bodies of a compiled model: names, what hangs on what, axes in the world."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import mujoco
import numpy as np
from numpy.typing import NDArray

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
