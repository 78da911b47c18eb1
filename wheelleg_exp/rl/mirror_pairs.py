"""Find the mirror image of each joint and each body of a left-right symmetric robot."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

import mujoco
import numpy as np

from wheelleg_exp.errors import ConfigError, nearest_name, not_one_of
from wheelleg_exp.sim.names import compiled

JOINT_PAIRS_KEY = "agent.symmetry.joint_pairs"
_MAX_JOINT_DISTANCE = 0.02  # of the robot's size
_FLIP = np.array([1.0, -1.0, 1.0])  # mirrors y
MIRROR = np.diag(_FLIP)
# The axes of two paired joints may deviate from mirror symmetry by 8 degrees (cosine 0.99).
_MIN_AXIS_COSINE = 0.99


def joint_images(names: Sequence[str], pairs: Mapping[str, str | None]) -> list[int]:
    r"""Return the index of each joint's mirror image; a joint that no key of ``pairs`` matches is its own mirror image.

    A key of ``pairs`` is a regular expression for the full names of joints on one side. Its value is the name on the
    other side, with ``\1`` for the first group of the key, or None, which pairs no joints.
    """
    found = list(range(len(names)))
    for expression, image in pairs.items():
        if image is None:
            continue
        key = f"{JOINT_PAIRS_KEY}[{expression}]"
        try:
            matches = [match for name in names if (match := compiled(expression, names, key).fullmatch(name))]
            images = [match.expand(image) for match in matches]
        except (re.error, IndexError) as error:
            expected = "expressions, such as 'l(.*)': 'r\\1'"
            raise ConfigError(f"the regular expression is invalid: {error}", key=key, expected=expected) from error
        if not matches:
            expected, nearest = "the whole name of one of " + ", ".join(names), nearest_name(expression, names)
            raise ConfigError("the regular expression matches no joint", key=key, expected=expected, nearest=nearest)
        for match, other in zip(matches, images, strict=True):
            if other not in names:
                raise not_one_of(f"the robot has no joint '{other}'", other, names, key=key)
            one, two = names.index(match.string), names.index(other)
            found[one], found[two] = two, one
    return found


def joint_signs(model: mujoco.MjModel, root: str, names: Sequence[str], images: Sequence[int]) -> list[float]:
    """Return the factors, 1 or -1, by which a mirror changes joint positions. Raise ConfigError for asymmetric joints.

    A mirror M turns the axis a of a hinge into -M a, and that of a slide into M a. Paired joints must have mirrored
    anchors, and move bodies with mirrored centres of mass and equal masses. ``images[i]`` mirrors joint i.
    """
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    base = model.body(root).id
    turn, origin = data.xmat[base].reshape(3, 3).T, data.xpos[base].copy()
    ids = [model.joint(name).id for name in names]
    bodies = [model.jnt_bodyid[joint] for joint in ids]
    # ``places`` contains each joint's anchor and the centre of mass of the moved body, relative to the base, m.
    pairs = zip(data.xanchor[ids], data.xipos[bodies], strict=True)
    places = np.array([[turn @ (anchor - origin), turn @ (centre - origin)] for anchor, centre in pairs])
    axes = np.array([turn @ data.xaxis[j] for j in ids])
    size = float(np.abs(places).max()) or 1.0
    found = []
    for name, joint, place, axis, other in zip(names, ids, places, axes, images, strict=True):
        hinge = model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_HINGE
        cosine = float(axes[other] @ (_FLIP * axis)) * (-1.0 if hinge else 1.0)
        apart = float(np.linalg.norm(places[other] - _FLIP * place, axis=1).max())
        mass, its = (float(model.body_mass[model.jnt_bodyid[j]]) for j in (joint, ids[other]))
        wrong = ""
        if model.jnt_type[joint] != model.jnt_type[ids[other]]:
            wrong = "one is a hinge and one a slide"
        elif apart > _MAX_JOINT_DISTANCE * size:
            wrong = f"they, or what they carry, lie {1e3 * apart:.1f} mm off the image"
        elif abs(cosine) < _MIN_AXIS_COSINE:
            wrong = f"the axes differ by {np.degrees(np.arccos(abs(cosine))):.1f} degrees"
        elif abs(mass - its) > _MAX_JOINT_DISTANCE * max(mass, its):
            wrong = f"they carry {mass:.4g} and {its:.4g} kg"
        if wrong:
            alone = f"joint '{name}' is not its own mirror image"
            what = alone if names[other] == name else f"joints '{name}' and '{names[other]}' are not mirror images"
            expected = "pairs of joints to the left and right of the base"
            raise ConfigError(f"{what}: {wrong}", key=JOINT_PAIRS_KEY, expected=expected)
        found.append(1.0 if cosine > 0 else -1.0)
    return found


_MAX_BODY_DISTANCE = 0.02  # of the robot's size
# Entries of a body's mirrored rotation matrix may deviate by 0.02 from the matrix of its mirror image.
_MAX_FRAME_ERROR = 0.02


class BodyImages:
    """Finds the mirror image of each body of a robot.

    If a joint moves a body, the mirrored joint moves the body's image. The image of any other body is the body at the
    mirrored position. ``names`` starts with the root. ``joint_images`` has the index of each joint's mirror image.
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
        self._far = _MAX_BODY_DISTANCE * (float(np.abs(self._places).max()) or 1.0)
        number = {body: i for i, body in enumerate(ids)}
        moved = [number[int(model.jnt_bodyid[model.joint(name).id])] for name in joint_names]
        self._images: list[int | None] = [None] * len(ids)
        self._images[0] = 0
        for joint, image in enumerate(joint_images):
            self._images[moved[joint]] = moved[image]
        parents = [number.get(int(model.body_parentid[body])) for body in ids]
        for body in sorted(range(len(ids)), key=lambda i: ids[i]):
            if self._images[body] is None:
                # A body's mirror image is that child of the parent's image that is nearest to the mirrored position.
                above = None if (parent := parents[body]) is None else self._images[parent]
                others = [i for i, other in enumerate(parents) if above is not None and other == above]
                apart = np.linalg.norm(self._places[others] - MIRROR @ self._places[body], axis=1)
                self._images[body] = others[int(apart.argmin())] if others else None

    def image(self, name: str, key: str, *, with_axes: bool = False) -> str:
        """Return the name of a body's image, ``with_axes`` that are mirrored, too; raise ConfigError without one."""
        body = self.names.index(name)
        image = self._images[body]
        far = np.inf if image is None else np.linalg.norm(self._places[image] - MIRROR @ self._places[body])
        if image is None or far > self._far:
            message = f"the body '{name}' has no image to the other side of the robot"
            raise ConfigError(message, key=key, expected="bodies of both sides, or in the middle")
        turned = MIRROR @ self._frames[body] @ MIRROR
        if with_axes and np.abs(turned - self._frames[image]).max() > _MAX_FRAME_ERROR:
            message = f"the axes of the body '{name}' are not mirror images of those of '{self.names[image]}'"
            raise ConfigError(message, key=key, expected="bodies whose frames are images, or a rule of your own")
        return self.names[image]
