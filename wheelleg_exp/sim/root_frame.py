"""Turns the frame of the root link, for robots whose file does not have x forwards and z upwards."""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np


def turn_root_frame(spec: mujoco.MjSpec, root_name: str, frame: Sequence[float]) -> None:
    """Give the root link another frame at the same origin; nothing of the robot moves against the rest of it.

    Every term reads velocities, gravity and commands in this frame. Where a floating robot begins is said of the new
    frame as well (``env.robot.init_state.rot``).

    Args:
        spec: the robot, before compilation.
        root_name: its root body.
        frame: the new frame's orientation in the file's, (w, x, y, z), of any length.
    """
    root = spec.body(root_name)
    back = np.array(frame, dtype=float) / np.linalg.norm(frame)
    back[1:] *= -1.0
    held = [*root.geoms, *root.sites, *root.cameras, *root.lights, *root.bodies]
    held += [joint for joint in root.joints if joint.type != mujoco.mjtJoint.mjJNT_FREE]
    turned = root.add_frame(quat=back)
    for frame_or_element in [*(f for f in root.frames if f is not turned and f.frame is None), *held]:
        if frame_or_element.frame is None:
            frame_or_element.set_frame(turned)
    if root.explicitinertial:
        _turn_inertia(root, back)


def _turn_inertia(root: mujoco.MjsBody, back: np.ndarray) -> None:
    """Turn the mass that stands in the file; what MuJoCo works out of the shapes turns with them."""
    root.ipos = _rotated(root.ipos, back)
    if not np.isnan(root.fullinertia[0]):
        matrix = np.empty(9)
        mujoco.mju_quat2Mat(matrix, back)
        turn = matrix.reshape(3, 3)
        xx, yy, zz, xy, xz, yz = root.fullinertia
        tensor = turn @ np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]) @ turn.T
        root.fullinertia = [*np.diag(tensor), tensor[0, 1], tensor[0, 2], tensor[1, 2]]
    else:
        quat = np.empty(4)
        mujoco.mju_mulQuat(quat, back, np.asarray(root.iquat, dtype=float))
        root.iquat = quat


def _rotated(vector: Sequence[float], quat: np.ndarray) -> np.ndarray:
    result = np.empty(3)
    mujoco.mju_rotVecQuat(result, np.asarray(vector, dtype=float), quat)
    return result
