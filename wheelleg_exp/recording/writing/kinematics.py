"""The robot's default pose, its weight, and angles of its orientation."""

from __future__ import annotations

import mujoco
import numpy as np

from wheelleg_exp.rendering.shapes import Array
from wheelleg_exp.sim.robot import Robot


def default_pose(robot: Robot, model: mujoco.MjModel) -> Array:
    """Return the positions (nq,) with every joint at its default; the base is where the model has it.

    Not the present pose: what is drawn in units of the robot's height must not depend on when a recording begins.
    """
    qpos: Array = model.qpos0.copy()
    for joint, position in zip(robot.joint_names, robot.layout.default_joint_pos.flatten().tolist(), strict=True):
        qpos[model.joint(joint).qposadr[0]] = position
    return qpos


def weight(model: mujoco.MjModel, root: int) -> float:
    """Return the weight of the tree below ``root``, N (1 N when it weighs nothing or there is no gravity)."""
    weight = float(model.body_subtreemass[root] * np.linalg.norm(model.opt.gravity))
    return weight if weight > 0 else 1.0


def roll_pitch_yaw(quaternion: Array) -> Array:
    """Return the angles (n, 3), rad, of R = Rz(yaw) Ry(pitch) Rx(roll) for unit quaternions (n, 4), wxyz."""
    w, x, y, z = quaternion.T
    roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = np.arcsin(np.clip(2 * (w * y - x * z), -1.0, 1.0))
    yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return np.stack((roll, pitch, yaw), axis=1)
