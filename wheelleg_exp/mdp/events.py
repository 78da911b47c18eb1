"""Event terms. Names and behaviour are Isaac Lab's; where its name misleads, an explicit one stands beside it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Annotated, Any, Literal, get_args

import torch

from wheelleg_exp.constraints import (
    Broken,
    Count,
    Interval,
    Length,
    NonNegativeInterval,
    Ordered,
    Positive,
    Share,
    relation,
)
from wheelleg_exp.managers import Env, SceneEntityCfg, TermBase, bounds
from wheelleg_exp.sim import rotation

Operation = Literal["add", "scale", "abs"]
Distribution = Literal["uniform", "log_uniform", "gaussian"]

Pose = Literal["x", "y", "z", "roll", "pitch", "yaw"]
PoseRange = Mapping[Pose, Interval]
POSE = get_args(Pose)
_ROBOT = SceneEntityCfg("robot")


def draw(
    low: float, high: float, shape: tuple[int, ...], distribution: Distribution, generator: torch.Generator
) -> torch.Tensor:
    """Return draws of ``shape``: uniform or log-uniform on [low, high], or Gaussian with mean low and std high."""
    if distribution == "gaussian":
        return low + high * torch.randn(shape, generator=generator, device=generator.device)
    u = torch.rand(shape, generator=generator, device=generator.device)
    if distribution == "log_uniform":
        return low * (high / low) ** u
    return low + (high - low) * u


def operate(default: torch.Tensor, drawn: torch.Tensor, operation: Operation) -> torch.Tensor:
    """Return default + drawn (add), default * drawn (scale) or drawn (abs)."""
    if operation == "add":
        return default + drawn
    return default * drawn if operation == "scale" else drawn


def all_ids(env: Env, env_ids: torch.Tensor | None) -> torch.Tensor:
    """Return ``env_ids``, or all environments for None."""
    return torch.arange(env.num_envs, device=env.device) if env_ids is None else env_ids


class randomize_rigid_body_material(TermBase):
    """Give each shape of each environment one of ``num_buckets`` materials, drawn once at construction.

    PhysX averages the coefficients of the two touching shapes and MuJoCo takes the larger: the effective value
    (robot + ground) / 2 is written, which the robot's higher contact priority makes MuJoCo use. MuJoCo has one
    Coulomb coefficient; ``env.robot.friction_source`` says which of the two it is. Restitution is drawn and kept
    in ``materials``, but has no counterpart and does not act.

    Args:
        env: the environment.
        static_friction_range: [low, high].
        dynamic_friction_range: [low, high].
        restitution_range: [low, high].
        num_buckets: number of different materials.
        generator: the term's random stream.
        make_consistent: whether dynamic friction is cut to static friction.
        asset_cfg: the bodies whose shapes are written.
    """

    def __init__(
        self,
        env: Env,
        static_friction_range: NonNegativeInterval,
        dynamic_friction_range: NonNegativeInterval,
        restitution_range: Annotated[Sequence[Share], Ordered()],
        num_buckets: Count,
        generator: torch.Generator,
        make_consistent: bool = False,
        asset_cfg: SceneEntityCfg = _ROBOT,
    ) -> None:
        pairs = (static_friction_range, dynamic_friction_range, restitution_range)
        ranges = torch.tensor(pairs, dtype=torch.float32, device=env.device)
        self._generator = generator
        self.buckets = rotation.uniform(ranges[:, 0], ranges[:, 1], num_buckets, generator)
        if make_consistent:
            self.buckets[:, 1] = torch.minimum(self.buckets[:, 0], self.buckets[:, 1])
        robot = env.scene[asset_cfg.name]
        self._geom_ids = robot.shape_ids(asset_cfg.body_ids)
        source = robot.options.friction_source
        self._column = 0 if source == "static" else 1
        self._ground = env.scene.terrain.friction(source)
        self.materials = torch.zeros(env.num_envs, len(self._geom_ids), 3, device=env.device)

    def __call__(self, env: Env, env_ids: torch.Tensor | None) -> None:
        """Draw a bucket per environment and shape, and write the effective friction."""
        ids = all_ids(env, env_ids)
        chosen = torch.randint(
            len(self.buckets), (len(ids), len(self._geom_ids)), generator=self._generator, device=ids.device
        )
        self.materials[ids] = self.buckets[chosen]
        effective = (self.materials[ids, :, self._column] + self._ground) / 2
        env.scene.sim.expand("geom_friction")[ids.unsqueeze(1), self._geom_ids, 0] = effective.to(env.scene.sim.dtype)


def _masses_are_masses(given: Mapping[str, Any]) -> Iterator[Broken]:
    """Hold the range against what it is drawn by; what is drawn below ``min_mass`` is cut to it."""
    name = "mass_distribution_params"
    first, second = given[name]
    gaussian = given["distribution"] == "gaussian"
    positive = given["operation"] != "add" or given["distribution"] == "log_uniform"
    expected = "[mean, standard deviation]" if gaussian else "[low, high]"
    wrong = second < 0 if gaussian else first > second
    if wrong or (positive and first <= 0):
        of = {"add": "", "scale": ", factors above 0", "abs": ", masses above 0"}[given["operation"]]
        yield Broken(name, f"{given[name]!r} is out of range", expected + (of or ", above 0" * positive))


@relation(_masses_are_masses)
def randomize_rigid_body_mass(
    env: Env,
    env_ids: torch.Tensor | None,
    mass_distribution_params: Annotated[Sequence[float], Length(2)],
    operation: Operation,
    generator: torch.Generator,
    asset_cfg: SceneEntityCfg = _ROBOT,
    distribution: Distribution = "uniform",
    recompute_inertia: bool = True,
    min_mass: Positive = 1e-6,
) -> None:
    """Change masses (kg) from their defaults; inertias follow in proportion, centres of mass stay."""
    robot = env.scene[asset_cfg.name]
    chosen = all_ids(env, env_ids)
    ids, bodies, sim = chosen.unsqueeze(1), robot.body_ids[asset_cfg.body_ids], env.scene.sim
    default = sim.constant("body_mass")[bodies]
    drawn = draw(
        mass_distribution_params[0], mass_distribution_params[1], (len(ids), len(bodies)), distribution, generator
    ).to(env.scene.sim.dtype)
    mass = operate(default, drawn, operation).clamp(min=min_mass)
    sim.expand("body_mass")[ids, bodies] = mass
    if recompute_inertia:
        inertia = sim.constant("body_inertia")[bodies]
        sim.expand("body_inertia")[ids, bodies] = inertia * (mass / default).unsqueeze(2)
    sim.set_const()
    robot.mark_written(chosen)


def randomize_rigid_body_com_cumulative(
    env: Env,
    env_ids: torch.Tensor | None,
    com_range: Mapping[Literal["x", "y", "z"], Interval],
    generator: torch.Generator,
    asset_cfg: SceneEntityCfg = _ROBOT,
) -> None:
    """Add one offset (m, link axes) per environment to the present centres of mass; repeats add up."""
    ids = all_ids(env, env_ids)
    robot = env.scene[asset_cfg.name]
    bodies = robot.body_ids[asset_cfg.body_ids]
    low, high = bounds(com_range, ("x", "y", "z"), "com_range", env.device)
    offset = rotation.uniform(low, high, len(ids), generator).to(env.scene.sim.dtype)
    ipos = env.scene.sim.expand("body_ipos")
    ipos[ids.unsqueeze(1), bodies] += offset.unsqueeze(1)
    env.scene.sim.set_const()
    robot.data.com_b.copy_(ipos[:, robot.body_ids[0]])
    robot.mark_written(ids)


randomize_rigid_body_com = randomize_rigid_body_com_cumulative


def set_permanent_body_wrench(
    env: Env,
    env_ids: torch.Tensor | None,
    force_range: Interval,
    torque_range: Interval,
    generator: torch.Generator,
    asset_cfg: SceneEntityCfg = _ROBOT,
) -> None:
    """Draw a force (N) and a torque (N·m) that act at the bodies' CoM in link axes until the next reset.

    The same range holds for each axis. Isaac Lab calls it ``apply_external_force_torque``.
    """
    ids = all_ids(env, env_ids)
    robot = env.scene[asset_cfg.name]
    bodies = torch.arange(len(robot.body_names), device=env.device)[asset_cfg.body_ids].tolist()
    pairs = [list(force_range)] * 3 + [list(torque_range)] * 3
    limits = torch.tensor(pairs, dtype=torch.float32, device=env.device)
    drawn = rotation.uniform(limits[:, 0], limits[:, 1], len(ids) * len(bodies), generator)
    robot.set_permanent_wrench(ids, bodies, drawn.view(len(ids), len(bodies), 6))


apply_external_force_torque = set_permanent_body_wrench


class push_by_adding_velocity(TermBase):
    """Add U(range) to the root's CoM velocity, world axes. Isaac Lab calls it ``push_by_setting_velocity``.

    Args:
        env: the environment.
        velocity_range: ``x``, ``y``, ``z`` in m/s; ``roll``, ``pitch``, ``yaw`` in rad/s.
        generator: the term's random stream.
        asset_cfg: the robot.
    """

    adds = True
    settings = ("_low", "_high")

    def __init__(
        self, env: Env, velocity_range: PoseRange, generator: torch.Generator, asset_cfg: SceneEntityCfg = _ROBOT
    ) -> None:
        self._low, self._high = bounds(velocity_range, POSE, "velocity_range", env.device)
        self._generator = generator
        self._robot = env.scene[asset_cfg.name]

    def __call__(self, env: Env, env_ids: torch.Tensor | None) -> None:
        """Push."""
        ids = all_ids(env, env_ids)
        velocity = rotation.uniform(self._low, self._high, len(ids), self._generator)
        data = self._robot.data
        if self.adds:
            velocity += torch.cat((data.root_lin_vel_w[ids], data.root_ang_vel_w[ids]), dim=1)
        self._robot.write_root_com_velocity(ids, velocity[:, :3], velocity[:, 3:])


push_by_setting_velocity = push_by_adding_velocity


class set_root_velocity(push_by_adding_velocity):
    """Set the root's CoM velocity to U(range), world axes, whatever it was."""

    adds = False


class reset_root_state_uniform(TermBase):
    """Place the root at its default, the environment's origin and a uniform offset.

    ``quat = default * euler_xyz(U)``, in body axes; the velocity is of the CoM in world axes.

    Args:
        env: the environment.
        pose_range: ``x``, ``y``, ``z`` in m; ``roll``, ``pitch``, ``yaw`` in rad.
        velocity_range: ``x``, ``y``, ``z`` in m/s; ``roll``, ``pitch``, ``yaw`` in rad/s.
        generator: the term's random stream.
        asset_cfg: the robot.
    """

    settings = ("_low", "_high")

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
        """Place the roots of ``env_ids``."""
        ids = all_ids(env, env_ids)
        robot = self._robot
        u = rotation.uniform(self._low, self._high, len(ids), self._generator)
        position = robot.default_root_pos + env.scene.env_origins[ids] + u[:, 0:3]
        robot.write_root_pose(ids, position, self.orientation(u[:, 3:6]))
        robot.write_root_com_velocity(ids, u[:, 6:9], u[:, 9:12])

    def orientation(self, euler: torch.Tensor) -> torch.Tensor:
        """Return the orientations (n, 4) for drawn angles (n, 3)."""
        turn = rotation.quat_from_euler_xyz(*euler.unbind(dim=1))
        return rotation.quat_mul(self._robot.default_root_quat.expand_as(turn), turn)


class reset_root_state_with_random_orientation(reset_root_state_uniform):
    """As ``reset_root_state_uniform``, with an orientation uniform on SO(3)."""

    def orientation(self, euler: torch.Tensor) -> torch.Tensor:
        """Return random orientations (n, 4)."""
        return rotation.random_quat(len(euler), self._generator)


def reset_joints_by_scale(
    env: Env,
    env_ids: torch.Tensor | None,
    position_range: Interval,
    velocity_range: Interval,
    generator: torch.Generator,
    asset_cfg: SceneEntityCfg = _ROBOT,
) -> None:
    """Set joints to their defaults times U(range), within soft limits; a default of 0 stays 0."""
    _reset_joints(env, env_ids, position_range, velocity_range, generator, asset_cfg, scale=True)


def reset_joints_by_offset(
    env: Env,
    env_ids: torch.Tensor | None,
    position_range: Interval,
    velocity_range: Interval,
    generator: torch.Generator,
    asset_cfg: SceneEntityCfg = _ROBOT,
) -> None:
    """Set joints to their defaults plus U(range) (rad, rad/s), within soft limits."""
    _reset_joints(env, env_ids, position_range, velocity_range, generator, asset_cfg, scale=False)


def _reset_joints(
    env: Env,
    env_ids: torch.Tensor | None,
    position_range: Interval,
    velocity_range: Interval,
    generator: torch.Generator,
    asset_cfg: SceneEntityCfg,
    *,
    scale: bool,
) -> None:
    ids = all_ids(env, env_ids)
    robot = env.scene[asset_cfg.name]
    data, joints = robot.data, asset_cfg.joint_ids
    pos, vel = data.default_joint_pos[ids][:, joints], data.default_joint_vel[ids][:, joints]
    u = torch.rand(2, *pos.shape, generator=generator, device=pos.device)
    low, high = position_range
    drawn_pos = low + (high - low) * u[0]
    low, high = velocity_range
    drawn_vel = low + (high - low) * u[1]
    pos, vel = (pos * drawn_pos, vel * drawn_vel) if scale else (pos + drawn_pos, vel + drawn_vel)
    lowest, highest = data.soft_joint_pos_limits[ids][:, joints].unbind(dim=2)
    fastest = data.soft_joint_vel_limits[ids][:, joints]
    robot.write_joint_state(ids, pos.clamp(lowest, highest), vel.clamp(-fastest, fastest), joints)


def reset_scene_to_default(env: Env, env_ids: torch.Tensor | None, reset_joint_targets: bool = False) -> None:
    """Put the robot back to its default root and joint state; targets only when asked for."""
    ids = all_ids(env, env_ids)
    robot = env.scene.robot
    data = robot.data
    position = robot.default_root_pos + env.scene.env_origins[ids]
    robot.write_root_pose(ids, position, robot.default_root_quat.expand(len(ids), 4))
    still = torch.zeros(len(ids), 3, device=env.device)
    robot.write_root_com_velocity(ids, still, still)
    robot.write_joint_state(ids, data.default_joint_pos[ids], data.default_joint_vel[ids])
    if reset_joint_targets:
        data.joint_pos_target[ids] = data.default_joint_pos[ids]
        data.joint_vel_target[ids] = data.default_joint_vel[ids]
