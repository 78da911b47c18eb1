"""Event terms that set the robot's state at the start of an episode."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Literal

import mujoco
import torch

from wheelleg_exp.constraints import Count, Interval, Positive, Share
from wheelleg_exp.errors import ConfigError
from wheelleg_exp.managers import Env, SceneEntityCfg, TermBase, bounds
from wheelleg_exp.mdp.events.randomization import POSE, PoseRange, all_ids
from wheelleg_exp.mdp.root_motion import resting_side
from wheelleg_exp.sim import rotation
from wheelleg_exp.sim.ids import picked
from wheelleg_exp.sim.terrain import Plane

_ROBOT = SceneEntityCfg("robot")


class reset_root_state_uniform(TermBase):
    """Place the root at the sum of the root's default position, the environment's origin, and a uniform offset.

    The orientation is ``default * euler_xyz(U)``, in body axes; the velocity is the centre of mass's, in world axes.

    Args:
        pose_range: ``x``, ``y``, ``z`` in m, and ``roll``, ``pitch``, ``yaw`` in rad.
        velocity_range: ``x``, ``y``, ``z`` in m/s, and ``roll``, ``pitch``, ``yaw`` in rad/s.
    """

    def __init__(
        self,
        env: Env,
        pose_range: PoseRange,
        velocity_range: PoseRange,
        generator: torch.Generator,
        asset_cfg: SceneEntityCfg = _ROBOT,
    ) -> None:
        low, high = bounds(pose_range, POSE, "pose_range", env.device)
        low_v, high_v = bounds(velocity_range, POSE, "velocity_range", env.device)
        self._low, self._high = torch.cat((low, low_v)), torch.cat((high, high_v))
        self._generator = generator
        self._robot = env.scene[asset_cfg.name]

    def __call__(self, env: Env, env_ids: torch.Tensor | None) -> None:
        ids = all_ids(env, env_ids)
        robot = self._robot
        u = rotation.uniform(self._low, self._high, ids.shape[0], self._generator)
        start = robot.data.default_root_state.index_select(0, ids)
        position = start[:, 0:3] + env.scene.env_origins.index_select(0, ids) + u[:, 0:3]
        pose = torch.cat((position, self.orientation(start[:, 3:7], u[:, 3:6])), dim=1)
        robot.write_root_pose_to_sim(pose, ids)
        robot.write_root_velocity_to_sim(start[:, 7:13] + u[:, 6:12], ids)

    def orientation(self, default: torch.Tensor, euler: torch.Tensor) -> torch.Tensor:
        """Return root orientations (n, 4) from default orientations (n, 4) and random Euler angles (n, 3), rad."""
        return rotation.quat_mul(default, rotation.quat_from_euler_xyz(*euler.unbind(dim=1)))


class reset_root_state_with_random_orientation(reset_root_state_uniform):
    """Place the root as ``reset_root_state_uniform`` does, but with an orientation that is uniform on SO(3)."""

    def orientation(self, default: torch.Tensor, euler: torch.Tensor) -> torch.Tensor:
        del default
        return rotation.random_quat(len(euler), self._generator)


def _drop(model: mujoco.MjModel, addresses: list[int], start: list[float], seconds: float) -> list[float]:
    """Return the positions at ``addresses`` of ``qpos`` after a fall from ``start`` without torques of motors."""
    limp, flags = mujoco.MjData(model), model.opt.disableflags
    limp.qpos[addresses] = start
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_ACTUATION
    try:
        mujoco.mj_step(model, limp, round(seconds / model.opt.timestep))
    finally:
        model.opt.disableflags = flags
    return list(map(float, limp.qpos[addresses]))


class reset_to_resting_pose(TermBase):
    """Lay the robot on level ground in a random pose in which the limp robot came to rest. Not in Isaac Lab.

    The resting poses come from ``num_poses`` drops without torques, from random poses. Checkpoints store them.

    Args:
        share: share of resets that lay the robot down; the others keep the pose that earlier events have set.
        by_side: whether each side on which the robot can lie is equally likely, instead of each pose.
        num_poses: number of drops.
        drop_height: height of the root link at the start of a drop, m.
        drop_s: duration of a drop, s.
    """

    def __init__(
        self,
        env: Env,
        generator: torch.Generator,
        share: Share = 1.0,
        by_side: bool = False,
        num_poses: Count = 256,
        drop_height: Positive = 0.15,
        drop_s: Positive = 3.0,
        asset_cfg: SceneEntityCfg = _ROBOT,
    ) -> None:
        self._robot, self._generator, self._share = env.scene[asset_cfg.name], generator, share
        self._robot.require_floating()
        if not isinstance(env.scene.terrain, Plane):
            raise ConfigError("the resting poses fit only level ground", expected="scene=flat")
        layout, model = self._robot.layout, env.scene.model
        root = int(model.jnt_qposadr[model.body_jntadr[int(layout.body_ids[0])]])
        addresses = [*range(root, root + 7), *layout.qpos_ids.tolist()]
        limits = layout.joint_pos_limits
        low, high = torch.where(limits.isfinite(), limits, 0.0).unbind(dim=1)
        position = torch.tensor([[0.0, 0.0, drop_height]], device=env.device).expand(num_poses, 3)
        turns = rotation.random_quat(num_poses, generator)
        starts = torch.cat((position, turns, rotation.uniform(low, high, num_poses, generator)), dim=1)
        rests = [_drop(model, addresses, start, drop_s) for start in starts.tolist()]
        # The root's height, m, its quaternion, and the joint positions, rad, (num_poses, 5 + J).
        self.poses = torch.tensor(rests, device=env.device)[:, 2:]
        sides = resting_side(-rotation.quat_to_matrix(self.poses[:, 1:5])[:, 2])
        counts = torch.bincount(sides)[sides] if by_side else torch.ones_like(sides)
        self.weights = 1.0 / counts

    def __call__(self, env: Env, env_ids: torch.Tensor | None) -> None:
        ids = all_ids(env, env_ids)
        device = self.poses.device
        lies = torch.rand(len(ids), generator=self._generator, device=device) < self._share
        drawn = torch.multinomial(self.weights, max(1, len(ids)), replacement=True, generator=self._generator)
        ids, pose = ids[lies], self.poses[drawn[: len(ids)][lies]]
        n = len(ids)
        yaw = torch.pi * (2.0 * torch.rand(n, generator=self._generator, device=device) - 1.0)
        zero = torch.zeros_like(yaw)
        position = env.scene.env_origins[ids] + torch.stack((zero, zero, pose[:, 0]), dim=1)
        turned = rotation.quat_mul(rotation.quat_from_euler_xyz(zero, zero, yaw), pose[:, 1:5])
        self._robot.write_root_pose_to_sim(torch.cat((position, turned), dim=1), ids)
        self._robot.write_root_velocity_to_sim(torch.zeros(n, 6, device=device), ids)
        self._robot.write_joint_state_to_sim(pose[:, 5:], torch.zeros_like(pose[:, 5:]), env_ids=ids)


class reset_root_state_from_terrain(TermBase):
    """Place the root above a random flat patch of the environment's terrain tile, with a random orientation.

    The patches are the terrain's ``flat_patches.init_pos``. The root is placed at the patch plus its default position;
    its default orientation has no effect. The velocity is that of the root's centre of mass in world axes.

    Args:
        pose_range: ``roll``, ``pitch``, ``yaw`` in rad.
        velocity_range: ``x``, ``y``, ``z`` in m/s, and ``roll``, ``pitch``, ``yaw`` in rad/s.
    """

    def __init__(
        self,
        env: Env,
        pose_range: Mapping[Literal["roll", "pitch", "yaw"], Interval],
        velocity_range: PoseRange,
        generator: torch.Generator,
        asset_cfg: SceneEntityCfg = _ROBOT,
    ) -> None:
        low, high = bounds(pose_range, POSE[3:], "pose_range", env.device)
        low_v, high_v = bounds(velocity_range, POSE, "velocity_range", env.device)
        self._low, self._high = torch.cat((low, low_v)), torch.cat((high, high_v))
        self._generator = generator
        self._robot, self._terrain = env.scene[asset_cfg.name], env.scene.terrain
        if "init_pos" not in self._terrain.flat_patches:
            message = "the terrain has no flat patches named 'init_pos', from which this event draws start positions"
            raise ConfigError(message, expected="flat patches 'init_pos' in env.scene.terrain")

    def __call__(self, env: Env, env_ids: torch.Tensor | None) -> None:
        ids, terrain, robot = all_ids(env, env_ids), self._terrain, self._robot
        places = terrain.flat_patches["init_pos"]
        chosen = torch.randint(places.shape[2], (ids.shape[0],), generator=self._generator, device=ids.device)
        place = places[terrain.terrain_levels[ids], terrain.terrain_types[ids], chosen]
        u = rotation.uniform(self._low, self._high, ids.shape[0], self._generator)
        start = robot.data.default_root_state[ids]
        turn = rotation.quat_from_euler_xyz(*u[:, 0:3].unbind(dim=1))
        robot.write_root_pose_to_sim(torch.cat((place + start[:, 0:3], turn), dim=1), ids)
        robot.write_root_velocity_to_sim(start[:, 7:13] + u[:, 3:9], ids)


def reset_joints_by_scale(
    env: Env,
    env_ids: torch.Tensor | None,
    position_range: Interval,
    velocity_range: Interval,
    generator: torch.Generator,
    asset_cfg: SceneEntityCfg = _ROBOT,
) -> None:
    """Set joint positions and velocities to their defaults times uniform factors, clipped to the soft limits.

    Defaults of 0 remain 0. Coupled joints follow, as in ``reset_joints_by_offset``.
    """
    _reset_joints(env, env_ids, torch.mul, (position_range, velocity_range), generator, asset_cfg)


def reset_joints_by_offset(
    env: Env,
    env_ids: torch.Tensor | None,
    position_range: Interval,
    velocity_range: Interval,
    generator: torch.Generator,
    asset_cfg: SceneEntityCfg = _ROBOT,
) -> None:
    """Set joint positions (rad) and velocities (rad/s) to their defaults plus uniform offsets, clipped to limits.

    Mimic joints follow, and so do passive joints of closed loops, up to second order.
    """
    _reset_joints(env, env_ids, torch.add, (position_range, velocity_range), generator, asset_cfg)


def _reset_joints(
    env: Env,
    env_ids: torch.Tensor | None,
    operate: Callable[[torch.Tensor, torch.Tensor], torch.Tensor],
    ranges: tuple[Interval, Interval],
    generator: torch.Generator,
    cfg: SceneEntityCfg,
) -> None:
    ids, robot, joints = all_ids(env, env_ids), env.scene[cfg.name], cfg.joint_ids
    data = robot.data
    pos, vel = (picked(of.index_select(0, ids), joints) for of in (data.default_joint_pos, data.default_joint_vel))
    u = torch.rand(2, *pos.shape, generator=generator, device=pos.device)
    drawn_pos, drawn_vel = (low + (high - low) * part for (low, high), part in zip(ranges, u.unbind(), strict=True))
    pos, vel = operate(pos, drawn_pos), operate(vel, drawn_vel)
    lowest, highest = picked(data.soft_joint_pos_limits.index_select(0, ids), joints).unbind(dim=2)
    fastest = picked(data.soft_joint_vel_limits.index_select(0, ids), joints)
    robot.write_joint_state_to_sim(pos.clamp(lowest, highest), vel.clamp(-fastest, fastest), joints, ids)
    if robot.layout.coupled:
        default, allowed = data.default_joint_pos[ids], robot.layout.admissible.T
        pos, vel = default + (data.joint_pos[ids] - default) @ allowed, data.joint_vel[ids] @ allowed
        robot.layout.couplings.follow(pos, vel)
        robot.write_joint_state_to_sim(pos, vel, env_ids=ids)


def reset_scene_to_default(env: Env, env_ids: torch.Tensor | None, reset_joint_targets: bool = False) -> None:
    """Reset the robot, and with ``reset_joint_targets`` also its joint targets, to its default root and joint state."""
    ids = all_ids(env, env_ids)
    robot = env.scene.robot
    data = robot.data
    if robot.floating:
        state = data.default_root_state[ids]
        state[:, :3] += env.scene.env_origins[ids]
        robot.write_root_state_to_sim(state, ids)
    robot.write_joint_state_to_sim(data.default_joint_pos[ids], data.default_joint_vel[ids], env_ids=ids)
    if reset_joint_targets:
        data.joint_pos_target[ids] = data.default_joint_pos[ids]
        data.joint_vel_target[ids] = data.default_joint_vel[ids]
