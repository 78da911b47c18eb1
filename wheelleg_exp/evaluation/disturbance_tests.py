"""Tests with disturbances: pushes, changed worlds, and rough ground, with one number per episode in each column.

The push test finds the hardest push that a standing robot survives, and measures the recovery from a fixed push. The
robustness test changes one property of the simulation at a time, such as friction. In the test ``terrain``, each robot
drives straight on one tile. In the test ``strip``, each robot drives from level ground over a strip of rough ground to
level ground.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace

import torch

from wheelleg_exp.constraints import Node
from wheelleg_exp.env import ManagerBasedRLEnv
from wheelleg_exp.env.realism import with_action_delay, with_sensor_errors
from wheelleg_exp.evaluation.evaluation_env import FRICTION, on_ground
from wheelleg_exp.evaluation.motion_columns import Columns
from wheelleg_exp.evaluation.policy_rollout import Disturb, Policy, Progress, Rollout
from wheelleg_exp.evaluation.protocol_options import KICK_S, PROPERTIES, GetUp, Jump, Push, Robust, Strip, Terrain
from wheelleg_exp.evaluation.trajectories import Trajectories, largest, last_exit, mean, rms
from wheelleg_exp.sim.options import EnvOptions
from wheelleg_exp.sim.terrain.terrain_generator import ORIGIN_WINDOW
from wheelleg_exp.terms.config_sections import ActionRealism, SensorRealism


def pushes(rollout: Rollout, options: Push) -> Callable[[torch.Tensor], Disturb]:
    """Return a function of each robot's change of velocity, m/s, (N,); it returns a callback that pushes the robots.

    A push changes the velocity in a yaw-aligned frame, in one step or evenly over several steps.
    """
    env = rollout.env
    cell = rollout.scenarios.cell_of().to(env.device)
    turn = (cell % options.directions).float() * (2.0 * math.pi / options.directions)
    direction = torch.stack((turn.cos(), turn.sin()), dim=1)
    steps = [max(1, round(pulse / env.step_dt)) for pulse in options.pulses_s]
    pulse = torch.tensor(steps, device=env.device)[cell // options.directions]
    begin = round(options.at_s / env.step_dt)

    def push_by(change: torch.Tensor) -> Disturb:
        each = direction * (change / pulse).unsqueeze(1)

        def push(step: int) -> None:
            if 0 <= step - begin < max(steps):
                add_velocity(env, each * (step - begin < pulse).unsqueeze(1))

        return push

    return push_by


def add_velocity(env: ManagerBasedRLEnv, change: torch.Tensor) -> None:
    """Add ``change`` (N, 2), m/s, to the robots' velocities, along the level axes x (forwards) and y (to the left)."""
    data = env.scene.robot.data
    cos, sin = data.heading_w.cos(), data.heading_w.sin()
    x, y = change.unbind(dim=1)
    velocity = torch.cat((data.root_lin_vel_w, data.root_ang_vel_w), dim=1)
    velocity[:, 0] += cos * x - sin * y
    velocity[:, 1] += sin * x + cos * y
    env.scene.robot.write_root_velocity_to_sim(velocity)
    env.scene.refresh()


PUSH_COLUMNS = ("limit_m_s", "limit_normalised", "recovery_s", "recovered", "tilt_max_rad")


def push_columns(
    rollout: Rollout, policy: Policy, options: Push, seed: int, target: float | None, progress: Progress | None
) -> tuple[Columns, Trajectories]:
    """Return each episode's hardest survived push, and its recovery from a push of ``reference`` m/s, (N,) each.

    ``limit_m_s`` is found by bisection between 0 and ``highest`` m/s in ``iterations`` simulations from the same start;
    0 if the robot falls after every push. ``limit_normalised`` is ``limit_m_s`` / √(g h), where h is the height of the
    base before the push. ``recovery_s`` is the time from the push until tilt and height stay in their tolerance bands;
    NaN if the robot falls, or if they never leave their bands. ``recovered`` is 1 if the robot does not fall and tilt
    and height stay in their bands from ``within_s`` on, else 0.
    """
    push_by, low = pushes(rollout, options), torch.zeros(rollout.scenarios.size, device=rollout.env.device)
    high = torch.full_like(low, float(options.highest))
    rolls = options.iterations + 1
    for iteration in range(options.iterations):
        middle = (low + high) / 2
        made = rollout.roll(policy, seed, _part(progress, iteration, rolls), push_by(middle))
        # The hardest survived push is between ``low`` and ``high``: a fall lowers ``high``, survival raises ``low``.
        low, high = torch.where(made.fell, low, middle), torch.where(made.fell, middle, high)
    reference = torch.full_like(low, float(options.reference))
    made = rollout.roll(policy, seed, _part(progress, options.iterations, rolls), push_by(reference))
    limit = torch.where(low > 0, (low + high) / 2, 0.0).double()
    before = made.counted(0.0, options.at_s)
    height = mean(made.height, before) if target is None else torch.full_like(limit, target)
    columns = {"limit_m_s": limit, "limit_normalised": limit / (rollout.parts.gravity * height).sqrt()}
    return columns | recovery(made, options, height), made


def recovery(made: Trajectories, options: Push | Jump | GetUp, height: torch.Tensor) -> Columns:
    """Return ``recovery_s``, ``recovered``, and the largest tilt, given the target height of the base, m, (N,)."""
    after = made.counted(options.at_s)
    tilt = torch.acos((made.roll.cos() * made.pitch.cos()).clamp(-1.0, 1.0))
    outside = (tilt >= options.recovered_tilt) | ((made.height - height).abs() >= options.recovered_height)
    time = last_exit(outside, after, made.dt)
    latest = min(options.within_s, options.after_s - options.recovered_s)
    return {
        "recovery_s": torch.where(made.fell | ~(outside & after).any(dim=0), torch.nan, time),
        "recovered": (~made.fell & (time <= latest)).double(),
        "tilt_max_rad": largest(tilt, after),
    }


def _part(progress: Progress | None, part: int, parts: int) -> Progress | None:
    """Return a callback that converts the progress of one rollout to the progress of the whole test."""
    return None if progress is None else lambda done, of: progress(part * of + done, parts * of)


@dataclass(frozen=True)
class World:
    """A variant of the simulation in the robustness test, with its own options of the environment.

    ``kick`` (m/s) and ``platform``, the peak acceleration of a swinging floor (m/s²), are applied by ``disturbances``.
    """

    sweep: str
    value: float
    env: EnvOptions = field(repr=False)
    kick: float = 0.0
    platform: float = 0.0


def worlds(env: EnvOptions, options: Robust) -> Iterator[World]:
    """Yield the unchanged simulation (``nominal``), each change of one property, and ``combined``, several changes."""
    yield World("nominal", 0.0, env)
    for name in PROPERTIES:
        for value in getattr(options, name):
            yield world(env, options, name, value)
    if options.combined:
        both = env
        for name, value in options.combined.items():
            both = changed(both, options, name, value)
        yield World("combined", 1.0, both, *(options.combined.get(name, 0.0) for name in ("kick", "platform")))


def jump_worlds(env: EnvOptions, own: EnvOptions, options: Jump) -> list[World]:
    """Return the unchanged simulation, one with the task's errors (``own``), and one for each delay of the actions."""
    late = [World("delay", s, with_action_delay(env, ActionRealism(delay_s=(s, s)))) for s in options.delay_s]
    return [World("nominal", 0.0, env), *([World("errors", 0.0, own)] if options.errors else []), *late]


def world(env: EnvOptions, options: Robust, name: str, value: float) -> World:
    """Return the simulation in which the property ``name``, such as ``friction``, has the given value."""
    kick, platform = (value if name == moving else 0.0 for moving in ("kick", "platform"))
    return World(name.removesuffix("_s"), value, changed(env, options, name, value), kick, platform)


def changed(env: EnvOptions, options: Robust, name: str, value: float) -> EnvOptions:
    """Return the options with a changed property; kicks and platforms do not change them (see ``disturbances``)."""
    pair, zero = [value, value], [0.0, 0.0]
    if name == "friction":
        env = on_ground(env, {**env.scene.terrain, "static_friction": value, "dynamic_friction": value})
        env = replace(env, robot=replace(env.robot, friction_combine_mode="average"))
        ranges = {"static_friction_range": pair, "dynamic_friction_range": pair, "restitution_range": zero}
        return _with_event(env, "rigid_body_material", ranges | {"num_buckets": 1})
    if name == "impratio":
        return replace(env, sim=replace(env.sim, impratio=value))
    if name == "mass":
        return _with_event(env, "rigid_body_mass", {"mass_distribution_params": pair, "operation": "scale"})
    if name == "payload":
        added = {"mass_distribution_params": pair, "operation": "add"}
        return _with_event(env, "rigid_body_mass", added, body_ids=[0])
    if name == "com":
        shift = {"x": pair, "y": zero, "z": zero}
        return _with_event(env, "rigid_body_com", {"com_range": shift}, body_ids=[0])
    if name == "gains":
        gains = {"stiffness_distribution_params": pair, "damping_distribution_params": pair, "operation": "scale"}
        return _with_event(env, "actuator_gains", gains)
    if name in ("imu_tilt", "gyro_bias"):
        tilt = {"roll": zero, "pitch": pair if name == "imu_tilt" else zero, "yaw": zero}
        bias = pair if name == "gyro_bias" else zero
        return _with_event(env, "imu_errors", {"tilt_range": tilt, "gyro_bias_range": bias})
    if name == "encoder_offset":
        return _with_event(env, "encoder_bias", {"bias_range": [-value, value]})
    if name == "slope":
        return _with_event(env, "floor_slope", {"slope_range": pair})
    if name == "delay_s":
        return with_action_delay(env, ActionRealism(delay_s=(value, value)))
    sizes, sensors = options.noise_std, dict[str, SensorRealism]()
    if name == "noise":
        sensors = {function: _noisy("GaussianNoise", std=value * std) for function, std in sizes.items()}
    if name == "lost_readings":
        sensors = dict.fromkeys(sizes, _noisy("SensorErrors", lost=value))
    if name == "reading_delay_s":
        sensors = dict.fromkeys(sizes, SensorRealism(delay_s=(value, value)))
    return with_sensor_errors(env, sensors, list(env.observations)) if sensors else env


def _noisy(model: str, **parameters: float) -> SensorRealism:
    return SensorRealism(noise={"_target_": f"wheelleg_exp.mdp.noise.{model}", **parameters})


def _with_event(env: EnvOptions, what: str, parameters: Mapping[str, object], **bodies: object) -> EnvOptions:
    """Add an event that randomises ``what`` once, after all other events; ``bodies`` selects some of the bodies."""
    asset = {"_target_": "wheelleg_exp.managers.SceneEntityCfg", "name": "robot", **bodies}
    target = f"wheelleg_exp.mdp.events.randomize_{what}"
    node = {"_target_": target, "mode": "startup", "asset_cfg": asset, **parameters}
    return replace(env, events={**env.events, f"evaluation_randomize_{what}": node})


def margin(survival: Callable[[float], float], highest: float, options: Robust, step: float = 0.0) -> float:
    """Return the largest change that a policy survives, found by bisection between 0 and ``highest``.

    ``survival`` returns the share of episodes that survive a change, of which ``margin_survival`` must survive. With
    ``step``, only multiples of ``step`` are tried.
    """

    def rounded(value: float) -> float:
        return step * math.floor(value / step + 1e-6) if step else value

    low, high = 0.0, rounded(highest)
    if survival(high) >= options.margin_survival:
        return high
    for _ in range(options.margin_iterations):
        middle = rounded((low + high) / 2)
        if middle == low:
            break
        low, high = (middle, high) if survival(middle) >= options.margin_survival else (low, middle)
    return low


def gain_ramp(rollout: Rollout, seconds: float) -> Disturb:
    """Return a callback that raises the gains of all drives evenly from 0 in the first ``seconds`` of an episode."""
    robot, dt = rollout.env.scene.robot, rollout.env.step_dt
    whole: list[tuple[torch.Tensor, torch.Tensor]] = []  # gains after the reset, which can change them

    def raise_gains(step: int) -> None:
        if step == 0:
            whole[:] = [(drive.stiffness.clone(), drive.damping.clone()) for drive in robot.actuators.values()]
        if step * dt <= seconds + dt:
            share = min(1.0, step * dt / seconds)
            for drive, (stiffness, damping) in zip(robot.actuators.values(), whole, strict=True):
                robot.write_joint_stiffness_to_sim(share * stiffness, drive.joint_ids)
                robot.write_joint_damping_to_sim(share * damping, drive.joint_ids)

    return raise_gains


PLATFORM_HZ = 1.0  # frequency of a swinging floor


def disturbances(rollout: Rollout, changed: World) -> Disturb | None:
    """Return a callback that kicks the robots and accelerates the floor before each control step.

    A kick changes a robot's speed at the time ``KICK_S``, in turns by ±x. The floor swings along the world's x axis in
    even episodes, along y in odd ones. In the axes of a floor with the acceleration a, gravity is g - a. Sensors of
    gravity show the vertical, as filters do that also use the gyroscope.
    """
    env, start = rollout.env, round(KICK_S / rollout.env.step_dt)
    odd = (torch.arange(env.num_envs, device=env.device) % 2).float()
    change = torch.stack((changed.kick * (1.0 - 2.0 * odd), torch.zeros_like(odd)), dim=1)
    axes = torch.stack((1 - odd, odd, torch.zeros_like(odd)), dim=1)
    down: list[torch.Tensor] = []  # gravity after the reset, which can tilt it

    def disturb(step: int) -> None:
        if changed.kick and step == start:
            add_velocity(env, change)
        if changed.platform:
            gravity = env.scene.sim.expand("opt.gravity")
            if step == 0:
                down[:] = [gravity.clone()]
            swing = changed.platform * math.sin(2.0 * math.pi * PLATFORM_HZ * step * env.step_dt)
            gravity.copy_(down[0] - swing * axes)

    return disturb if changed.kick or changed.platform else None


_BORDER = 2.0  # level ground, m


def tiles(options: Terrain, seed: int) -> Node:
    """Return a terrain config with one column per kind of terrain tile and one row per difficulty level.

    The settings of row i are those of the difficulty ``(i + 1) / levels``, so that a metric can name them.
    """
    terrain = copy.deepcopy(options.scene["terrain"])
    kinds = {name: node for name, node in terrain["sub_terrains"].items() if node is not None}
    for node in kinds.values():
        node["proportion"] = 1.0
    # On a larger tile, a pit's floor keeps its width, so reduce ``origin_window``, a share of the tile's width.
    wider = min(now / own for now, own in zip(options.size, terrain["size"], strict=True))
    return {
        **terrain,
        "size": list(options.size),
        "origin_window": min(1.0, terrain.get("origin_window", ORIGIN_WINDOW) / wider),
        "num_rows": options.levels,
        "num_cols": len(kinds),
        "curriculum": True,
        "difficulty_range": [0.0, 1.0],
        "exact_levels": True,
        "max_init_terrain_level": None,
        "border_width": max(_BORDER, float(terrain.get("border_width", 0.0))),
        "seed": seed,
        "sub_terrains": kinds,
    }


def place_on_tiles(rollout: Rollout, options: Terrain) -> None:
    """Place each robot on the terrain tile of its scenario."""
    env = rollout.env
    ground, cell = env.scene.terrain, rollout.scenarios.cell_of().to(env.device)
    assert ground.terrain_origins is not None
    ground.terrain_types.copy_(cell // options.levels)
    ground.terrain_levels.copy_(cell % options.levels)
    ground.env_origins.copy_(ground.terrain_origins[ground.terrain_levels, ground.terrain_types])


def ways(made: Trajectories, rollout: Rollout, options: Terrain) -> Columns:
    """Return each robot's driven distance, its success, and the kind and level of its terrain tile, (N,) each.

    ``distance_ratio`` is the distance that a robot drives along its first heading before a failure, divided by the
    commanded distance. ``success`` is 1 if the robot did not fall and ``distance_ratio`` is at least
    ``distance_share``, else 0.
    """
    cell = rollout.scenarios.cell_of().to(made.alive.device)
    tile = {"kind": (cell // options.levels).double(), "level": (cell % options.levels).double()}
    return tile | _success(made, options)


def _success(made: Trajectories, options: Terrain | Strip) -> Columns:
    last = (made.alive.sum(dim=0) - 1).clamp(min=0)
    way = (made.pos[last, torch.arange(made.pos.shape[1], device=last.device), :2] - made.pos[0, :, :2]).double()
    heading = made.yaw[0].double()
    driven = way[:, 0] * heading.cos() + way[:, 1] * heading.sin()
    ratio = driven / (options.lin_vel_x * options.horizon_s)
    return {"distance_ratio": ratio, "success": (~made.fell & (ratio >= options.distance_share)).double()}


_STRIP_ROOM = 1.0  # level ground, m


def strip_ground(options: Strip, terrain: Node, seed: int) -> Node:
    """Return a terrain config with one strip of rough ground per column, in level ground of the task's friction."""
    # The outermost points of a rough strip have height 0, so that the strip has no step to the level ground.
    rim = options.horizontal_scale
    noise = {"_target_": "wheelleg_exp.sim.terrain.UniformNoise", "proportion": 1.0, "border_width": rim}
    way = options.lin_vel_x * options.horizon_s
    return {
        "_target_": "wheelleg_exp.sim.terrain.TerrainGenerator",
        **{name: terrain[name] for name in FRICTION},
        "size": [options.length + 2 * rim, options.width],
        "num_rows": 1,
        "num_cols": len(options.amplitudes),
        "border_width": _STRIP_ROOM + max(options.before, way - options.before - options.length),
        "horizontal_scale": options.horizontal_scale,
        "vertical_scale": options.vertical_scale,
        "curriculum": True,
        "difficulty_range": [1.0, 1.0],
        "seed": seed,
        "sub_terrains": {str(i): {**noise, "amplitude_range": [a, a]} for i, a in enumerate(options.amplitudes)},
    }


def place_before_strip(rollout: Rollout, options: Strip) -> None:
    """Place every robot on the level ground before the rough strip of its scenario."""
    env = rollout.env
    terrain, cell = env.scene.terrain, rollout.scenarios.cell_of().to(env.device)
    assert terrain.terrain_origins is not None
    terrain.terrain_types.copy_(cell)
    terrain.terrain_levels.zero_()
    begin = terrain.terrain_origins[0, cell].clone()
    begin[:, 0] -= options.before + options.length / 2
    begin[:, 2] = 0.0
    terrain.env_origins.copy_(begin)


def phases(made: Trajectories, options: Strip, settle_s: float) -> dict[str, torch.Tensor]:
    """Return masks (T, N) of the control steps in which each robot is ``before``, ``on``, and ``behind`` rough ground.

    If a robot rolls back, its control steps still count as on or behind the rough ground. The mask ``before`` selects
    the last ``quiet_s`` seconds before a robot reaches the rough ground.
    """
    x, alive = made.pos[..., 0], made.alive
    come = (alive & (x >= options.before)).cummax(dim=0).values
    gone = (alive & (x > options.before + options.length)).cummax(dim=0).values
    steps = torch.arange(made.steps, device=x.device).unsqueeze(1)
    entry = torch.where(come.any(dim=0), come.int().argmax(dim=0), 0)
    last = steps >= entry - round(options.quiet_s / made.dt)
    before = made.counted(settle_s) & ~come & last & come.any(dim=0)
    return {"before": before, "on": alive & come & ~gone, "behind": alive & gone}


def crossing(made: Trajectories, options: Strip, settle_s: float) -> Columns:
    """Return columns (N,) on how each robot crosses a strip of rough ground; NaN for a robot that does not reach it.

    ``distance_ratio`` and ``success`` are those of ``ways``. ``error_vx_before``, ``_on``, and ``_behind`` are RMS
    errors of the forward speed; ``swing_rad_before``, ``_on``, and ``_behind`` are RMS deviations of the pitch from its
    mean before the strip. ``recovery_s`` is the time from the end of the strip until the pitch is quiet: for
    ``recovered_s`` seconds, its RMS deviation is at most ``max(quiet_floor, quiet_factor * swing_rad_before)``.
    ``recovered`` is 1 if the robot did not fall and ``recovery_s`` is at most ``within_s``, else 0.
    """
    found = phases(made, options, settle_s)
    columns = _success(made, options)
    pitch = made.pitch.double()
    swing = pitch - mean(pitch, found["before"])
    error = made.vel[..., 0] - made.command[..., 0]
    for name, counted in found.items():
        columns[f"error_vx_{name}"] = rms(error, counted)
        columns[f"swing_rad_{name}"] = rms(swing, counted)
    limit = (options.quiet_factor * rms(swing, found["before"])).clamp(min=options.quiet_floor)
    window = max(1, round(options.recovered_s / made.dt))
    # The difference of two cumulative sums of squares is the sum of squares over one sliding window.
    sums = torch.cat((torch.zeros_like(swing[:1]), swing.square().cumsum(dim=0)))
    coming = torch.full_like(swing, torch.nan)
    coming[: made.steps - window + 1] = ((sums[window:] - sums[:-window]) / window).clamp(min=0.0).sqrt()
    known = found["behind"] & ~coming.isnan()
    time = last_exit(coming > limit, known, made.dt)
    long_enough = found["behind"].sum(dim=0) >= round((options.within_s + options.recovered_s) / made.dt)
    time = torch.where(made.fell | limit.isnan() | ~long_enough, torch.nan, time)
    return columns | {"recovery_s": time, "recovered": (time <= options.within_s).double()}
