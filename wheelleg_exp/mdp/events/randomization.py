"""Event terms that randomise the model: materials, masses, joints, gravity; and the draws behind them."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Annotated, Any, Literal, get_args

import torch

from wheelleg_exp import constraints
from wheelleg_exp.constraints import Broken, Interval, Length, NonNegativeInterval, Positive, relation
from wheelleg_exp.errors import ConfigError
from wheelleg_exp.managers import Env, SceneEntityCfg, TermBase, bounds
from wheelleg_exp.sim import rotation
from wheelleg_exp.sim.terrain import combined_friction

Operation = Literal["add", "scale", "abs"]
Distribution = Literal["uniform", "log_uniform", "gaussian"]
Pose = Literal["x", "y", "z", "roll", "pitch", "yaw"]
PoseRange = Mapping[Pose, Interval]
POSE = get_args(Pose)
Pair = Annotated[Sequence[float], Length(2)]  # A pair is [low, high], or [mean, standard deviation] of a Gaussian.
Number = float | torch.Tensor


def draw(
    low: Number, high: Number, shape: Sequence[int], distribution: Distribution, generator: torch.Generator
) -> torch.Tensor:
    """Draw values of ``shape``: uniform or log-uniform on [low, high], or Gaussian with mean low and std high."""
    if distribution == "gaussian":
        return low + high * torch.randn(shape, generator=generator, device=generator.device)
    u = torch.rand(shape, generator=generator, device=generator.device)
    return low * (high / low) ** u if distribution == "log_uniform" else low + (high - low) * u


def operate(default: torch.Tensor, drawn: torch.Tensor, operation: Operation) -> torch.Tensor:
    """Combine default and drawn values: the sum (``add``), the product (``scale``), or the drawn values (``abs``)."""
    if operation == "add":
        return default + drawn
    return default * drawn if operation == "scale" else drawn


def all_ids(env: Env, env_ids: torch.Tensor | None) -> torch.Tensor:
    """Return ``env_ids``, or the indices of all environments if ``env_ids`` is None."""
    return torch.arange(env.num_envs, device=env.device) if env_ids is None else env_ids


def pair_error(pair: Sequence[float], operation: str, distribution: str, least: str = "") -> str | None:
    """Return None if ``pair`` is valid for a distribution, else its valid form, such as ``[low, high], above 0``.

    ``least`` is the lower limit of scale factors: ``above 0``, ``at least 0``, or an empty string for no limit.
    """
    first, second = pair
    gaussian = distribution == "gaussian"
    least = "above 0" if distribution == "log_uniform" else least if operation == "scale" else ""
    fits = second >= 0 if gaussian else first <= second
    fits = fits and not (least == "above 0" and first <= 0) and not (least == "at least 0" and first < 0)
    form = "[mean, standard deviation]" if gaussian else "[low, high]"
    return None if fits else form + (least and f", {least}")


def ranges(**limits: str) -> Callable[..., Iterator[Broken]]:
    """Return a rule about the ranges of an event; ``limits`` maps parameters to ``least`` of ``pair_error``."""

    def rule(operation: Operation, distribution: Distribution, **given: Any) -> Iterator[Broken]:
        for name, least in limits.items():
            pair = given[name]
            if pair and (expected := pair_error(pair, operation, distribution, least)):
                yield Broken(name, f"{pair!r} is out of range", expected)

    return rule


_ROBOT = SceneEntityCfg("robot")


class randomize_rigid_body_material(TermBase):
    """Give each collision shape of the robot in each environment one of ``num_buckets`` random materials.

    PhysX combines the friction coefficients of two shapes, but MuJoCo takes the larger one. Therefore, the robot's
    shapes get the combined one (``env.robot.friction_combine_mode``) and a higher priority than the ground. MuJoCo has
    a single coefficient, which ``env.robot.friction_source`` selects. Restitution has no effect.

    Args:
        static_friction_range: [low, high].
        dynamic_friction_range: [low, high].
        restitution_range: [low, high].
        num_buckets: number of different materials.
        make_consistent: whether dynamic friction is limited to static friction.
        asset_cfg: the bodies whose shapes are written.
    """

    def __init__(
        self,
        env: Env,
        static_friction_range: NonNegativeInterval,
        dynamic_friction_range: NonNegativeInterval,
        restitution_range: Annotated[Sequence[constraints.Share], constraints.Ordered()],
        num_buckets: constraints.Count,
        generator: torch.Generator,
        make_consistent: bool = False,
        asset_cfg: SceneEntityCfg = _ROBOT,
    ) -> None:
        pairs = (static_friction_range, dynamic_friction_range, restitution_range)
        ranges = torch.tensor(pairs, dtype=torch.float32, device=env.device)
        self._generator = generator
        buckets = rotation.uniform(ranges[:, 0], ranges[:, 1], num_buckets, generator)
        self.buckets = self.buffer("buckets", buckets)
        if make_consistent:
            self.buckets[:, 1] = torch.minimum(self.buckets[:, 0], self.buckets[:, 1])
        robot = env.scene[asset_cfg.name]
        self._geom_ids = robot.shape_ids(asset_cfg.body_ids)
        source = robot.options.friction_source
        self._column = 0 if source == "static" else 1
        self._ground, self._mode = env.scene.terrain.friction(source), robot.options.friction_combine_mode
        materials = torch.zeros(env.num_envs, len(self._geom_ids), 3, device=env.device)
        self.materials = self.buffer("materials", materials)

    def __call__(self, env: Env, env_ids: torch.Tensor | None) -> None:
        ids = all_ids(env, env_ids)
        shape = (len(ids), len(self._geom_ids))
        chosen = torch.randint(len(self.buckets), shape, generator=self._generator, device=ids.device)
        self.materials[ids] = self.buckets[chosen]
        effective = combined_friction(self.materials[ids, :, self._column], self._ground, self._mode)
        env.scene.sim.expand("geom_friction")[ids.unsqueeze(1), self._geom_ids, 0] = effective.to(env.scene.sim.dtype)


def _masses_are_masses(
    mass_distribution_params: Pair, operation: Operation, distribution: Distribution
) -> Iterator[Broken]:
    operation = "scale" if operation == "abs" else operation
    if expected := pair_error(mass_distribution_params, operation, distribution, "above 0"):
        yield Broken("mass_distribution_params", f"{mass_distribution_params!r} is out of range", expected)


@relation(_masses_are_masses)
def randomize_rigid_body_mass(
    env: Env,
    env_ids: torch.Tensor | None,
    mass_distribution_params: Pair,
    operation: Operation,
    generator: torch.Generator,
    asset_cfg: SceneEntityCfg = _ROBOT,
    distribution: Distribution = "uniform",
    recompute_inertia: bool = True,
    min_mass: Positive = 1e-6,
) -> None:
    """Change body masses, kg, relative to the defaults, and scale inertias with them; centres of mass stay in place."""
    robot = env.scene[asset_cfg.name]
    chosen = all_ids(env, env_ids)
    ids, bodies, sim = chosen.unsqueeze(1), robot.body_ids[asset_cfg.body_ids], env.scene.sim
    default = sim.constant("body_mass")[bodies]
    first, second = mass_distribution_params
    drawn = draw(first, second, (len(ids), len(bodies)), distribution, generator).to(sim.dtype)
    mass = operate(default, drawn, operation).clamp(min=min_mass)
    sim.expand("body_mass")[ids, bodies] = mass
    if recompute_inertia:
        inertia = sim.constant("body_inertia")[bodies]
        factor = torch.where(default > 0, mass / default, 1.0)  # a link without mass has no inertia either
        sim.expand("body_inertia")[ids, bodies] = inertia * factor.unsqueeze(2)
    sim.set_const()
    robot.mark_written(chosen)


@relation(ranges(inertia_distribution_params="above 0"))
def randomize_rigid_body_inertia(
    env: Env,
    env_ids: torch.Tensor | None,
    inertia_distribution_params: Pair,
    operation: Operation,
    generator: torch.Generator,
    asset_cfg: SceneEntityCfg = _ROBOT,
    distribution: Distribution = "uniform",
    min_inertia: Positive = 1e-9,
) -> None:
    """Change each principal moment of inertia (kg·m^2) relative to the moment's default value, but not the masses.

    Each moment is at least ``min_inertia`` and at most the sum of the other two. ``randomize_rigid_body_mass`` scales
    moments too, from the same model values: on one body, the later term overwrites the earlier one.
    """
    robot, sim = env.scene[asset_cfg.name], env.scene.sim
    ids, bodies = all_ids(env, env_ids), robot.body_ids[asset_cfg.body_ids]
    default = sim.constant("body_inertia")[bodies]
    first, second = inertia_distribution_params
    drawn = draw(first, second, (len(ids), *default.shape), distribution, generator)
    moments = operate(default, drawn.to(sim.dtype), operation).clamp(min=min_inertia)
    others = moments.sum(dim=2, keepdim=True) - moments
    sim.expand("body_inertia")[ids.unsqueeze(1), bodies] = torch.minimum(moments, others)
    sim.set_const()
    robot.mark_written(ids)


def randomize_rigid_body_com_cumulative(
    env: Env,
    env_ids: torch.Tensor | None,
    com_range: Mapping[Literal["x", "y", "z"], Interval],
    generator: torch.Generator,
    asset_cfg: SceneEntityCfg = _ROBOT,
) -> None:
    """Shift the bodies' centres of mass by a random offset per environment, m, in link axes. Repeated events add up."""
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


@relation(ranges(stiffness_distribution_params="above 0", damping_distribution_params="at least 0"))
def randomize_actuator_gains(
    env: Env,
    env_ids: torch.Tensor | None,
    generator: torch.Generator,
    stiffness_distribution_params: Pair | None = None,
    damping_distribution_params: Pair | None = None,
    operation: Operation = "abs",
    distribution: Distribution = "uniform",
    asset_cfg: SceneEntityCfg = _ROBOT,
) -> None:
    """Change stiffness (N·m/rad) and damping (N·m·s/rad) of each joint's actuator relative to the config's values.

    Negative gains become 0. Actuators with a neural network have no gains: they remain NaN.
    """
    robot, ids = env.scene[asset_cfg.name], all_ids(env, env_ids)
    data, joints = robot.data, asset_cfg.joint_ids
    for params, default, write in (
        (stiffness_distribution_params, data.default_joint_stiffness, robot.write_joint_stiffness_to_sim),
        (damping_distribution_params, data.default_joint_damping, robot.write_joint_damping_to_sim),
    ):
        if params is not None:
            before = default[ids][:, joints]
            drawn = draw(params[0], params[1], before.shape, distribution, generator)
            write(operate(before, drawn, operation).clamp(min=0.0), joints, ids)


@relation(
    ranges(
        friction_distribution_params="at least 0",
        armature_distribution_params="at least 0",
        lower_limit_distribution_params="",
        upper_limit_distribution_params="",
    )
)
class randomize_joint_parameters(TermBase):
    """Change friction, armature and position limits of each joint relative to the model's values.

    As in Isaac Lab, friction loss (N·m) and viscous friction (N·m·s/rad) get separate draws from one range. Negative
    friction and armature become 0. Soft limits change with the position limits, and clamp default positions.

    Args:
        friction_distribution_params: for friction loss and viscous friction; null keeps both.
        armature_distribution_params: kg·m^2; null keeps the armature.
        lower_limit_distribution_params: rad; null keeps the limit.
        upper_limit_distribution_params: rad; null keeps the limit.
        operation: how the draw changes the model's value.
        distribution: ``gaussian`` uses [mean, standard deviation], all others [low, high].
    """

    def __init__(
        self,
        env: Env,
        generator: torch.Generator,
        friction_distribution_params: Pair | None = None,
        armature_distribution_params: Pair | None = None,
        lower_limit_distribution_params: Pair | None = None,
        upper_limit_distribution_params: Pair | None = None,
        operation: Operation = "abs",
        distribution: Distribution = "uniform",
        asset_cfg: SceneEntityCfg = _ROBOT,
    ) -> None:
        self._robot, self._joints = env.scene[asset_cfg.name], asset_cfg
        self._friction, self._armature = friction_distribution_params, armature_distribution_params
        self._limits = (lower_limit_distribution_params, upper_limit_distribution_params)
        self._operation, self._distribution, self._generator = operation, distribution, generator
        if any(self._limits) and distribution != "gaussian":
            lower, upper = self._robot.data.default_joint_pos_limits[0, self._joints.joint_ids].unbind(dim=1)
            highest = torch.maximum(*self._ends(lower, self._limits[0]))
            lowest = torch.minimum(*self._ends(upper, self._limits[1]))
            if (highest > lowest).any():
                first = int((highest > lowest).nonzero()[0])
                low, high = f"{highest[first]:g} rad", f"{lowest[first]:g} rad"
                message = f"a lower limit of up to {low} could exceed an upper limit of {high}"
                raise ConfigError(message, expected="ranges of limits that do not overlap")

    def _ends(self, default: torch.Tensor, params: Pair | None) -> tuple[torch.Tensor, torch.Tensor]:
        if params is None:
            return default, default
        low, high = (operate(default, torch.full_like(default, end), self._operation) for end in params)
        return low, high

    def __call__(self, env: Env, env_ids: torch.Tensor | None) -> None:
        ids, joints, robot = all_ids(env, env_ids), self._joints.joint_ids, self._robot
        data = robot.data
        if self._friction is not None:
            friction = self._drawn(data.default_joint_friction_coeff[ids][:, joints], self._friction).clamp(min=0.0)
            viscous = self._drawn(data.default_joint_viscous_friction_coeff[ids][:, joints], self._friction)
            robot.write_joint_friction_coefficient_to_sim(friction, None, viscous.clamp(min=0.0), joints, ids)
        if self._armature is not None:
            armature = self._drawn(data.default_joint_armature[ids][:, joints], self._armature)
            robot.write_joint_armature_to_sim(armature.clamp(min=0.0), joints, ids)
        if any(self._limits):
            defaults = data.default_joint_pos_limits[ids][:, joints].unbind(dim=2)
            pairs = zip(defaults, self._limits, strict=True)
            lower, upper = (d if params is None else self._drawn(d, params) for d, params in pairs)
            limits = torch.stack((lower, torch.maximum(lower, upper)), dim=2)
            robot.write_joint_position_limit_to_sim(limits, joints, ids, warn_limit_violation=False)

    def _drawn(self, default: torch.Tensor, params: Pair) -> torch.Tensor:
        drawn = draw(params[0], params[1], default.shape, self._distribution, self._generator)
        return operate(default, drawn, self._operation)


class randomize_encoder_bias(TermBase):
    """Draw the bias of each joint's encoder, rad: the reading is position + bias.

    A drive controls the reading, so the true position differs from the target by the bias. Observations (``joint_pos``
    and ``joint_pos_rel`` unless ``measured: false``) and actions relative to the current position use the reading;
    rewards and terminations use the true position.

    Args:
        bias_range: [low, high], rad, drawn for each joint.
    """

    def __init__(
        self, env: Env, bias_range: Interval, generator: torch.Generator, asset_cfg: SceneEntityCfg = _ROBOT
    ) -> None:
        self._robot, self._joints = env.scene[asset_cfg.name], asset_cfg
        self._low, self._high = bias_range
        self._generator = generator
        self._robot.data.has_encoder_bias = True

    def __call__(self, env: Env, env_ids: torch.Tensor | None) -> None:
        ids, joints = all_ids(env, env_ids), self._joints.joint_ids
        shape = self._robot.data.encoder_bias[ids][:, joints].shape
        drawn = draw(self._low, self._high, shape, "uniform", self._generator)
        self._robot.write_encoder_bias(drawn, joints, ids)


class randomize_imu_errors(TermBase):
    """Draw how the IMU is mounted on the root link, and the bias of its gyroscope. Not in Isaac Lab.

    The observations ``base_ang_vel``, ``projected_gravity`` and ``base_roll_pitch``, commands that integrate the yaw
    rate, and sensors ``Imu`` on the root link show these errors; rewards and terminations without a sensor do not.

    Args:
        tilt_range: rotation of the IMU about its axes: ``roll``, ``pitch``, ``yaw``, rad.
        gyro_bias_range: [low, high], rad/s, drawn for each axis.
    """

    def __init__(
        self,
        env: Env,
        tilt_range: Mapping[Literal["roll", "pitch", "yaw"], Interval],
        gyro_bias_range: Interval,
        generator: torch.Generator,
        asset_cfg: SceneEntityCfg = _ROBOT,
    ) -> None:
        self._robot = env.scene[asset_cfg.name]
        self._low, self._high = bounds(tilt_range, ("roll", "pitch", "yaw"), "tilt_range", env.device)
        self._bias, self._generator = gyro_bias_range, generator
        self._robot.data.has_imu_errors = True

    def __call__(self, env: Env, env_ids: torch.Tensor | None) -> None:
        ids = all_ids(env, env_ids)
        angles = rotation.uniform(self._low, self._high, len(ids), self._generator)
        tilt = rotation.quat_to_matrix(rotation.quat_from_euler_xyz(*angles.unbind(dim=1)))
        bias, data = draw(self._bias[0], self._bias[1], (len(ids), 3), "uniform", self._generator), self._robot.data
        data.imu_tilt[ids], data.gyro_bias[ids] = tilt, bias
        data.invalidate()


@relation(ranges(effort_limit_distribution_params="above 0"))
def randomize_effort_limits(
    env: Env,
    env_ids: torch.Tensor | None,
    effort_limit_distribution_params: Pair,
    operation: Operation,
    generator: torch.Generator,
    distribution: Distribution = "uniform",
    asset_cfg: SceneEntityCfg = _ROBOT,
) -> None:
    """Change the largest torque of each joint's actuator, N·m, relative to the config's value. Not in Isaac Lab."""
    robot, ids = env.scene[asset_cfg.name], all_ids(env, env_ids)
    default = robot.layout.effort_limits[asset_cfg.joint_ids].expand(len(ids), -1)
    first, second = effort_limit_distribution_params
    drawn = draw(first, second, default.shape, distribution, generator)
    limits = operate(default, drawn, operation).clamp(min=1e-9)
    robot.write_joint_effort_limit_to_sim(limits, asset_cfg.joint_ids, ids)


class randomize_floor_slope(TermBase):
    """Tilt gravity in the world, which has the same effect as a sloping floor. Not in Isaac Lab.

    Unlike after ``randomize_physics_scene_gravity``, ``projected_gravity`` and sensors ``Imu`` show the tilt.

    Args:
        slope_range: [low, high], angle between the floor and the horizontal, rad; its direction is uniform.
    """

    def __init__(
        self, env: Env, slope_range: NonNegativeInterval, generator: torch.Generator, asset_cfg: SceneEntityCfg = _ROBOT
    ) -> None:
        self._robot, self._range, self._generator = env.scene[asset_cfg.name], slope_range, generator
        self._robot.data.has_imu_errors = True

    def __call__(self, env: Env, env_ids: torch.Tensor | None) -> None:
        ids, sim = all_ids(env, env_ids), env.scene.sim
        slope = draw(self._range[0], self._range[1], (len(ids),), "uniform", self._generator)
        turn = draw(-math.pi, math.pi, (len(ids),), "uniform", self._generator)
        down = torch.stack((slope.sin() * turn.cos(), slope.sin() * turn.sin(), -slope.cos()), dim=1)
        sim.expand("opt.gravity")[ids] = math.hypot(*env.scene.model.opt.gravity) * down.to(sim.dtype)
        self._robot.data.gravity_dir_w[ids] = down
        self._robot.data.invalidate()


Vector = Annotated[Sequence[float], Length(3)]


def _components_fit(
    gravity_distribution_params: tuple[Vector, Vector], operation: Operation, distribution: Distribution
) -> Iterator[Broken]:
    for pair in zip(*gravity_distribution_params, strict=True):
        if expected := pair_error(pair, operation, distribution):
            expected = f"two lists of x, y, z, for each axis {expected}"
            yield Broken("gravity_distribution_params", f"{pair!r} is out of range", expected)
            return


@relation(_components_fit)
def randomize_physics_scene_gravity(
    env: Env,
    env_ids: torch.Tensor | None,
    gravity_distribution_params: tuple[Vector, Vector],
    operation: Operation,
    generator: torch.Generator,
    distribution: Distribution = "uniform",
    per_env: bool = False,
) -> None:
    """Change gravity (m/s^2, world axes) relative to ``env.sim.gravity``. Each axis is drawn separately.

    As in Isaac Lab, one vector applies to all environments, including those that are not reset; with ``per_env``, each
    environment in which the event runs gets its own. ``projected_gravity`` always uses ``env.sim.gravity``.
    """
    sim = env.scene.sim
    default = torch.tensor(env.scene.model.opt.gravity, dtype=torch.float32, device=env.device)
    ids = all_ids(env, env_ids if per_env else None)
    first, second = torch.tensor(gravity_distribution_params, dtype=torch.float32, device=env.device)
    drawn = draw(first, second, (len(ids) if per_env else 1, 3), distribution, generator)
    sim.expand("opt.gravity")[ids] = operate(default, drawn, operation).to(sim.dtype).expand(len(ids), 3)
