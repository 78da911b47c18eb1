"""Which body is the image of which when the robot is mirrored left to right, and whose axes are images too."""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np

from wheelleg_exp.errors import ConfigError

_APART = 0.02  # of the robot's size: farther off is no image
_TURNED = 0.02  # of the entries of two frames' matrices: more is no image
MIRROR = np.diag([1.0, -1.0, 1.0])  # in the plane of the base's x and z axes


class BodyImages:
    """The images of a robot's bodies, found from its joints' images and, where a body has none, from the places.

    Args:
        model: the compiled scene.
        names: the robot's bodies, the root first.
        joint_names: its joints.
        joint_images: the index of each joint's image.
    """

    def __init__(
        self, model: mujoco.MjModel, names: Sequence[str], joint_names: Sequence[str], joint_images: Sequence[int]
    ) -> None:
        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
        self.names = list(names)
        ids = [model.body(name).id for name in names]
        turn, origin = data.xmat[ids[0]].reshape(3, 3), data.xpos[ids[0]]
        self._places = (data.xpos[ids] - origin) @ turn
        self._frames = turn.T @ data.xmat[ids].reshape(-1, 3, 3)
        size = float(np.abs(self._places).max()) or 1.0
        self._far = _APART * size
        number = {body: i for i, body in enumerate(ids)}
        moved = [number[int(model.jnt_bodyid[model.joint(name).id])] for name in joint_names]
        self._images: list[int | None] = [None] * len(ids)
        self._images[0] = 0
        for joint, image in enumerate(joint_images):
            self._images[moved[joint]] = moved[image]
        parents = [number.get(int(model.body_parentid[body])) for body in ids]
        for body in sorted(range(len(ids)), key=lambda i: ids[i]):
            if self._images[body] is None:
                self._images[body] = self._by_place(body, parents)

    def image(self, name: str, key: str, *, with_axes: bool = False) -> str:
        """Return the name of a body's image.

        Args:
            name: the body.
            key: the config key that names it.
            with_axes: whether its axes must be images of each other too.

        Raises:
            ConfigError: it has none.
        """
        body = self.names.index(name)
        image = self._images[body]
        far = np.inf if image is None else np.linalg.norm(self._places[image] - MIRROR @ self._places[body])
        if image is None or far > self._far:
            message = f"the body '{name}' has no image to the other side of the robot"
            raise ConfigError(message, key=key, expected="bodies of both sides, or in the middle")
        turned = MIRROR @ self._frames[body] @ MIRROR
        if with_axes and np.abs(turned - self._frames[image]).max() > _TURNED:
            raise ConfigError(
                f"the axes of the body '{name}' are no mirror images of those of '{self.names[image]}'",
                key=key,
                expected="bodies whose frames are images, or a rule of your own",
            )
        return self.names[image]

    def _by_place(self, body: int, parents: Sequence[int | None]) -> int | None:
        """Return the body below the image of the parent that lies where the image is to be."""
        parent = parents[body]
        above = None if parent is None else self._images[parent]
        others = [i for i, other in enumerate(parents) if above is not None and other == above]
        wanted = MIRROR @ self._places[body]
        return min(others, key=lambda i: float(np.linalg.norm(self._places[i] - wanted)), default=None)
