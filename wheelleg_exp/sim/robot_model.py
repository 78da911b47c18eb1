"""The robot in the model: its file before compilation, then its names, order, default state, limits, and ids."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
import torch

from wheelleg_exp.asset.mjcf.coupled_positions import JointCouplings, constraint_rows
from wheelleg_exp.errors import AssetError, ConfigError
from wheelleg_exp.sim.names import order_errors, values_by_name
from wheelleg_exp.sim.options import RobotOptions
from wheelleg_exp.state import Stateful

_ROUNDING = 0.01  # rad or m


class RobotLayout:
    """The robot's joints, bodies, defaults, and limits; raise ConfigError if ``env.robot`` does not fit the robot."""

    def __init__(self, options: RobotOptions, spec: mujoco.MjSpec, root_name: str, device: torch.device) -> None:
        self._options = options
        self._device = device
        bodies = [spec.body(root_name)]
        for body in bodies:
            bodies.extend(body.bodies)
        self.body_names = [body.name for body in bodies]
        self.floating = any(j.type == mujoco.mjtJoint.mjJNT_FREE for j in bodies[0].joints)
        base = "floating" if self.floating else "fixed"
        if options.base not in ("auto", base):
            message = f"the model's base is {base}, not '{options.base}'"
            raise ConfigError(message, key="env.robot.base", expected="auto, or the base that the model has")
        found = [j.name for body in bodies for j in body.joints if j.type != mujoco.mjtJoint.mjJNT_FREE]
        for error in () if options.joint_order is None else order_errors(options.joint_order, found):
            raise error
        self.joint_names = found if options.joint_order is None else list(options.joint_order)
        init, names, key = options.init_state, self.joint_names, "env.robot.init_state"
        pos = values_by_name(init.joint_pos, names, 0.0, key=f"{key}.joint_pos", what="joint")
        vel = values_by_name(init.joint_vel, names, 0.0, key=f"{key}.joint_vel", what="joint")
        self._default_positions = [float(value) for value in pos]
        self.default_joint_pos, self.default_joint_vel = self._numbers(self._default_positions), self._numbers(vel)
        self.default_root_pos = self._numbers(init.pos)
        self.default_root_quat = torch.nn.functional.normalize(self._numbers(init.rot), dim=0)
        if not self.floating:  # Events and actions cannot move a fixed base.
            bodies[0].pos, bodies[0].quat = init.pos, init.rot

    def bind(self, model: mujoco.MjModel) -> None:
        """Read ids and limits from the compiled model; raise ConfigError if a joint's default is outside its limits."""
        self.qpos_ids = self._ids(int(model.joint(j).qposadr[0]) for j in self.joint_names)
        self.dof_ids = self._ids(int(model.joint(j).dofadr[0]) for j in self.joint_names)
        self.joint_ids = self._ids(int(model.joint(j).id) for j in self.joint_names)
        self.body_ids = self._ids(int(model.body(b).id) for b in self.body_names)
        self.actuated_ids = self._ids(())
        self.all_limited = all(model.jnt_limited[model.joint(j).id] for j in self.joint_names)
        self.couplings = JointCouplings(model, {joint: column for column, joint in enumerate(self.joint_ids.tolist())})
        given, state = self._default_positions, np.array([self._default_positions, self.default_joint_vel.tolist()])
        self.couplings.follow(*state)
        self._default_positions = state[0].tolist()
        self.default_joint_pos, self.default_joint_vel = map(self._numbers, state.tolist())
        # ``admissible`` (J, J) projects small motions on those of closed loops, and moves joints with motors the least.
        data = mujoco.MjData(model)
        data.qpos[self.qpos_ids.tolist()] = self._default_positions
        data.eq_active[model.eq_type == mujoco.mjtEq.mjEQ_JOINT] = 0
        mujoco.mj_forward(model, data)
        loops = constraint_rows(model, data)[:, self.dof_ids.tolist()]
        pull = loops * np.where(np.isin(self.joint_ids.tolist(), model.actuator_trnid[:, 0]), 1e-6, 1.0)
        opened = pull.T @ np.linalg.pinv(loops @ pull.T, rcond=1e-9) @ loops
        self.admissible = self._numbers((np.eye(len(opened)) - opened).tolist())
        self.coupled = bool(self.couplings.rows or len(loops))
        ranges = []
        for name, value, written in zip(self.joint_names, self._default_positions, given, strict=True):
            if written and abs(written - value) > _ROUNDING:
                message = f"the default position {written:g} of joint '{name}' breaks a coupling of joints in the robot"
                raise ConfigError(message, key="env.robot.init_state.joint_pos", expected=f"{value:.6g}, or no value")
            index = model.joint(name).id
            low, high = model.jnt_range[index].tolist() if model.jnt_limited[index] else (-torch.inf, torch.inf)
            if not low <= value <= high:
                message = f"the default position {value} of joint '{name}' is outside its limits"
                key = "env.robot.init_state.joint_pos"
                raise ConfigError(message, key=key, expected=f"a value in [{low:.6g}, {high:.6g}]")
            ranges.append((low, high))
        self.joint_pos_limits = limits = self._numbers(ranges).view(-1, 2)
        self.soft_joint_pos_limits = soft_limits(limits, self._options.soft_joint_pos_limit_factor)
        self.velocity_limits = torch.full((len(self.joint_names),), torch.inf, device=self._device)
        self.effort_limits = torch.full_like(self.velocity_limits, torch.inf)

    def _ids(self, ids: Iterable[int]) -> torch.Tensor:
        return torch.tensor(list(ids), dtype=torch.long, device=self._device)

    def _numbers(self, values: object) -> torch.Tensor:
        return torch.tensor(values, dtype=torch.float32, device=self._device)


def soft_limits(limits: torch.Tensor, factor: float) -> torch.Tensor:
    """Scale the ranges (..., 2) of joint limits by ``factor`` about their middles; infinite limits do not change."""
    middle, half = limits.mean(dim=-1), (limits[..., 1] - limits[..., 0]) / 2 * factor
    soft = torch.stack((middle - half, middle + half), dim=-1)
    return torch.where(limits.isfinite().all(dim=-1, keepdim=True), soft, limits)


@dataclass
class JointTargets(Stateful):
    """Targets of every joint in the robot's order, (N, J): positions, rad, velocities, rad/s, and efforts, N·m."""

    pos: torch.Tensor
    vel: torch.Tensor
    effort: torch.Tensor

    def __post_init__(self) -> None:
        for name in ("pos", "vel", "effort"):
            self.buffer(name, getattr(self, name))


def read_robot(mjcf: Path) -> tuple[mujoco.MjSpec, str]:
    """Return a robot and its root body's name; raise AssetError unless the MJCF file contains exactly one robot.

    Actuators, keyframes and sensors are removed, because the config defines actuators and sensors.
    """
    try:
        spec = mujoco.MjSpec.from_file(str(mjcf))
    except ValueError as error:
        reason = " ".join(str(error).split())
        message = f"MuJoCo cannot read the robot file: {reason}"
        raise AssetError(message, key=str(mjcf), expected="an MJCF file") from error
    for element in [*spec.actuators, *spec.keys, *spec.sensors]:
        spec.delete(element)
    roots = [body for body in spec.worldbody.bodies if body.joints or body.bodies]
    if len(roots) != 1:
        message = f"the file contains {len(roots)} robots"
        raise AssetError(message, key=str(mjcf), expected="exactly one tree of moving bodies")
    roots[0].simple = 0  # MuJoCo ignores changes of a body's centre of mass if body.simple is 1.
    return spec, str(roots[0].name)


def turn_root_frame(spec: mujoco.MjSpec, root_name: str, frame: Sequence[float]) -> None:
    """Rotate the root link's frame about its origin without moving the robot's shapes and masses.

    ``frame`` (w, x, y, z) rotates the MJCF file's frame to a frame with x forwards and z upwards. Observations,
    rewards, commands and ``env.robot.init_state.rot`` refer to the new frame.
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
        # Convert the root link's inertia from the MJCF file to the rotated axes of the root link.
        ipos = np.empty(3)
        mujoco.mju_rotVecQuat(ipos, np.asarray(root.ipos, dtype=float), back)
        root.ipos = ipos
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
