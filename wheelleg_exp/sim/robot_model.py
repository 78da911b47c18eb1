"""The robot in the model: its file before compilation, then its names, order, default state, limits, and ids."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import torch

from wheelleg_exp.errors import AssetError, ConfigError
from wheelleg_exp.sim.names import order_errors, values_by_name
from wheelleg_exp.sim.options import RobotOptions
from wheelleg_exp.sim.terrain import GROUND_GROUP, is_ground
from wheelleg_exp.state import Kept


class RobotLayout(Kept):
    """The robot's names, order, defaults and limits.

    Args:
        options: the ``env.robot`` section.
        spec: the scene's spec, before compilation.
        root_name: the robot's root body.
        device: device of the tensors.

    Raises:
        ConfigError: the section does not fit the robot.
    """

    def __init__(self, options: RobotOptions, spec: mujoco.MjSpec, root_name: str, device: torch.device) -> None:
        self._options = options
        self._device = device
        bodies = _breadth_first(spec.body(root_name))
        self.body_names = [body.name for body in bodies]
        self.floating = any(j.type == mujoco.mjtJoint.mjJNT_FREE for j in bodies[0].joints)
        self._require_base()
        found = [j.name for body in bodies for j in body.joints if j.type != mujoco.mjtJoint.mjJNT_FREE]
        self.joint_names = self._order(found)
        self._read_defaults()
        if not self.floating:  # init_state places a fixed base for good, and a floating base at the start
            bodies[0].pos, bodies[0].quat = options.init_state.pos, options.init_state.rot

    def bind(self, model: mujoco.MjModel) -> None:
        """Read ids and limits from the compiled model; ConfigError when a default is outside its joint's limits."""
        self.qpos_ids = self._ids(int(model.joint(j).qposadr[0]) for j in self.joint_names)
        self.dof_ids = self._ids(int(model.joint(j).dofadr[0]) for j in self.joint_names)
        self.joint_ids = self._ids(int(model.joint(j).id) for j in self.joint_names)
        self.body_ids = self._ids(int(model.body(b).id) for b in self.body_names)
        self.actuated_ids = self._ids(())
        self.all_limited = all(model.jnt_limited[model.joint(j).id] for j in self.joint_names)
        self._read_limits(model)
        self.velocity_limits = torch.full((len(self.joint_names),), torch.inf, device=self._device)
        self.effort_limits = torch.full_like(self.velocity_limits, torch.inf)

    def add_drive(self, joint_ids: torch.Tensor, velocity_limit: torch.Tensor, effort_limit: torch.Tensor) -> None:
        """Add the joints (k,) of an actuator group with their limits (k,), rad/s and N·m."""
        self.actuated_ids = torch.cat((self.actuated_ids, joint_ids))
        self.velocity_limits[joint_ids] = velocity_limit
        self.effort_limits[joint_ids] = effort_limit

    def _ids(self, ids: Iterable[int]) -> torch.Tensor:
        return torch.tensor(list(ids), dtype=torch.long, device=self._device)

    def _numbers(self, values: Any) -> torch.Tensor:
        return torch.tensor(values, dtype=torch.float32, device=self._device)

    def _require_base(self) -> None:
        wanted = self._options.base
        if wanted != "auto" and (wanted == "floating") != self.floating:
            raise ConfigError(
                f"is '{wanted}', but the model's base is {'floating' if self.floating else 'fixed'}",
                key="env.robot.base",
                expected="auto, or the base that the model has",
            )

    def _order(self, found: list[str]) -> list[str]:
        wanted = self._options.joint_order
        if wanted is None:
            return found
        for error in order_errors(wanted, found):
            raise error
        return list(wanted)

    def _read_defaults(self) -> None:
        """Read the initial state of each joint; a joint that no expression matches starts at 0."""
        init, names = self._options.init_state, self.joint_names
        key = "env.robot.init_state"
        pos = values_by_name(init.joint_pos, names, 0.0, key=f"{key}.joint_pos", what="joint")
        vel = values_by_name(init.joint_vel, names, 0.0, key=f"{key}.joint_vel", what="joint")
        self._default_positions = [float(value) for value in pos]
        self.default_joint_pos = self._numbers(self._default_positions)
        self.default_joint_vel = self._numbers(vel)
        self.default_root_pos = self._numbers(init.pos)
        self.default_root_quat = torch.nn.functional.normalize(self._numbers(init.rot), dim=0)

    def _read_limits(self, model: mujoco.MjModel) -> None:
        """Read hard limits from the compiled model, check the default positions, and derive soft limits."""
        ranges = []
        for name, value in zip(self.joint_names, self._default_positions, strict=True):
            index = model.joint(name).id
            low, high = model.jnt_range[index].tolist() if model.jnt_limited[index] else (-torch.inf, torch.inf)
            if not low <= value <= high:
                raise ConfigError(
                    f"the default position {value} of joint '{name}' is outside its limits",
                    key="env.robot.init_state.joint_pos",
                    expected=f"a value in [{low:.6g}, {high:.6g}]",
                )
            ranges.append((low, high))
        limits = self._numbers(ranges).view(-1, 2)
        self.joint_pos_limits = limits
        self.soft_joint_pos_limits = soft_limits(limits, self._options.soft_joint_pos_limit_factor)


def soft_limits(limits: torch.Tensor, factor: float) -> torch.Tensor:
    """Return soft limits (..., 2): ``factor`` times the range about its middle; an infinite range stays infinite."""
    middle, half = limits.mean(dim=-1), (limits[..., 1] - limits[..., 0]) / 2
    half = half * factor
    soft = torch.stack((middle - half, middle + half), dim=-1)
    return torch.where(limits.isfinite().all(dim=-1, keepdim=True), soft, limits)


def _breadth_first(root: Any) -> list[Any]:
    order, queue = [], deque([root])
    while queue:
        body = queue.popleft()
        order.append(body)
        queue.extend(body.bodies)
    return order


@dataclass
class JointTargets(Kept):
    """Targets of every joint in the robot's order, (N, J).

    Attributes:
        pos: positions, rad.
        vel: velocities, rad/s.
        effort: feed-forward efforts, N·m.
    """

    pos: torch.Tensor
    vel: torch.Tensor
    effort: torch.Tensor

    def state_dict(self) -> dict[str, torch.Tensor]:
        """Return the targets."""
        return {f"joint_{name}_target": value.clone() for name, value in vars(self).items()}

    def load_state_dict(self, saved: dict[str, torch.Tensor]) -> None:
        """Restore what ``state_dict`` returned."""
        for name, value in vars(self).items():
            value.copy_(saved[f"joint_{name}_target"])


_ROBOT_GROUP = 1  # geom group for the robot's geoms that are in the ground's group; also drawn by default


def read_robot(mjcf: Path) -> tuple[mujoco.MjSpec, str]:
    """Return a robot and the name of its root body.

    Actuators, keyframes and sensors of the file are removed: the config defines them.

    Raises:
        AssetError: the file is not MJCF, or does not contain exactly one robot.
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
            f"the file contains {len(roots)} robots", key=str(mjcf), expected="exactly one tree of moving bodies"
        )
    roots[0].simple = 0  # MuJoCo's shortcut for simple bodies would ignore events that move the centre of mass
    return spec, str(roots[0].name)


def set_self_collisions(spec: mujoco.MjSpec, wanted: bool | None) -> None:
    """Turn collisions between the robot's geoms on or off; excluded pairs of bodies stay excluded."""
    if wanted is None:
        return
    for geom in spec.geoms:
        if geom.contype or geom.conaffinity:
            geom.contype, geom.conaffinity = int(wanted), 1


def leave_group_to_ground(spec: mujoco.MjSpec) -> None:
    """Reserve one geom group for the ground, so that rays can select the ground by its group."""
    for geom in spec.geoms:
        if is_ground(geom.name):
            geom.group = GROUND_GROUP
        elif geom.group == GROUND_GROUP:
            geom.group = _ROBOT_GROUP


def turn_root_frame(spec: mujoco.MjSpec, root_name: str, frame: Sequence[float]) -> None:
    """Rotate the frame of the root link about its origin; the robot's shape and mass stay where they are.

    For robots whose file does not have x forwards and z upwards. Every term reads velocities, gravity and commands in
    the new frame. ``env.robot.init_state.rot`` is the orientation of the new frame, too.

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
    """Rotate the inertia that the file states; an inertia that MuJoCo derives from shapes rotates with them."""
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
