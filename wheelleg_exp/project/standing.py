"""Chooses how a robot stands: the frame of its root link, the pose of its legs, and the lean that balances it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from wheelleg_exp.lint.anatomy.parts import Anatomy
from wheelleg_exp.lint.stance import Stance, solve_stance

Quaternion = tuple[float, float, float, float]
Array = NDArray[np.float64]

_ALONG = math.cos(math.radians(15))  # an axis within 15 degrees of another lies along it
_LEAN = math.radians(0.5)  # leans below are none


@dataclass(frozen=True)
class Standing:
    """How a robot stands.

    Attributes:
        frame: the root link's new frame in the file's, (w, x, y, z); None where that has x forwards, z upwards.
        rotation: of the root link in that frame, in the world, (w, x, y, z).
        positions: of the legs' joints, rad (m), by name; none for a robot that does not roll.
        stance: what is known of the pose; None likewise.
        lean: of the base, rad; positive forwards down; 0 where the legs alone balance the robot.
    """

    frame: Quaternion | None
    rotation: Quaternion
    positions: dict[str, float]
    stance: Stance | None
    lean: float


def stand(model: mujoco.MjModel, anatomy: Anatomy, qpos: Array) -> Standing:
    """Choose how a robot stands, next to a given pose.

    Args:
        model: the compiled robot in its scene, on a free base.
        anatomy: what its parts are for, at that pose.
        qpos: the pose, (nq,).
    """
    stance = solve_stance(model, anatomy, qpos)
    lean = 0.0
    if stance is not None and not stance.balanced and abs(stance.lean) > _LEAN:
        lean = stance.lean
    frame = _frame(anatomy, lean)
    w, x, y, z = (float(part) for part in qpos[3:7]) if frame is None else (1.0, 0.0, 0.0, 0.0)
    return Standing(frame, (w, x, y, z), {} if stance is None else stance.positions, stance, lean)


def _frame(anatomy: Anatomy, lean: float) -> Quaternion | None:
    """Return the frame with x forwards, y to the left and z upwards while the base leans.

    Axes near the file's own are the file's.
    """
    if anatomy.forward is None or anatomy.left is None:
        return None
    axes = np.array([anatomy.forward, anatomy.left, anatomy.up])
    near = np.rint(axes)
    if np.all((axes * near).sum(axis=1) >= _ALONG) and abs(np.linalg.det(near) - 1.0) < 1e-9:
        axes = near
    forward, left, up = axes
    axes = np.array(
        [math.cos(lean) * forward + math.sin(lean) * up, left, math.cos(lean) * up - math.sin(lean) * forward]
    )
    if np.allclose(axes, np.eye(3)):
        return None
    quat = np.empty(4)
    mujoco.mju_mat2Quat(quat, axes.T.ravel().copy())
    w, x, y, z = (round(float(part), 6) + 0.0 for part in quat)
    return w, x, y, z
