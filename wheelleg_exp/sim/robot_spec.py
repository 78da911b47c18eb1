"""The robot's file as a spec, and what the config changes in it before it is compiled."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import mujoco
import numpy as np

from wheelleg_exp.errors import AssetError
from wheelleg_exp.sim.terrain import GROUND_GROUP, is_ground

_ROBOT_GROUP = 1  # of geoms that came without one; drawn like the ground's


def read_robot(mjcf: Path) -> tuple[mujoco.MjSpec, str]:
    """Return a robot without controls, keyframes and sensors, which come from the config, and its root body's name.

    Raises:
        AssetError: the file is no MJCF, or holds no robot or several.
    """
    try:
        spec = mujoco.MjSpec.from_file(str(mjcf))
    except ValueError as error:
        reason = " ".join(str(error).split())
        raise AssetError(f"MuJoCo cannot read it: {reason}", key=str(mjcf), expected="an MJCF file") from error
    for element in [*spec.actuators, *spec.keys, *spec.sensors]:
        spec.delete(element)
    roots = [body for body in spec.worldbody.bodies if body.joints or body.bodies]
    if len(roots) != 1:
        raise AssetError(
            f"the file holds {len(roots)} robots", key=str(mjcf), expected="exactly one tree of moving bodies"
        )
    roots[0].simple = 0  # else no event could move the centre of mass of a robot of one body
    return spec, str(roots[0].name)


def set_self_collisions(spec: mujoco.MjSpec, wanted: bool | None) -> None:
    """Let the robot's geoms meet each other or the ground alone; excluded pairs of bodies stay excluded."""
    if wanted is None:
        return
    for geom in spec.geoms:
        if geom.contype or geom.conaffinity:
            geom.contype, geom.conaffinity = int(wanted), 1


def leave_group_to_ground(spec: mujoco.MjSpec) -> None:
    """Put the ground's geoms into a group that is theirs alone, so that rays may ask for the ground."""
    for geom in spec.geoms:
        if is_ground(geom.name):
            geom.group = GROUND_GROUP
        elif geom.group == GROUND_GROUP:
            geom.group = _ROBOT_GROUP


def turn_root_frame(spec: mujoco.MjSpec, root_name: str, frame: Sequence[float]) -> None:
    """Give the root link another frame at the same origin; nothing of the robot moves against the rest of it.

    For robots whose file does not have x forwards and z upwards. Every term reads velocities, gravity and commands in
    this frame. Where a floating robot begins is said of the new frame as well (``env.robot.init_state.rot``).

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
