"""Identify the motors of a robot from a log of chirps, and write a robot profile with them.

The base is fixed, and the drives follow the log's targets. For each driven joint, a least-squares fit (scipy's trust
region) finds seven parameters: armature, Coulomb friction, viscous friction, gain (a factor on stiffness and damping),
delay of the targets, effort scale (logged effort / torque of the motor), and latency of the feedback. The residuals are
errors of positions, speeds, and efforts, divided by the noise of their column. All joints are fitted together, because
gravity and reactions between links separate a motor's torque from its inertia.

One physics step (semi-implicit Euler) is one period h of the drives, with explicit torques: with a training's longer,
implicit step, gains and frictions would be wrong. A joint that moves continuously under torques that are constant for h
equals this joint with damping kd - kp L and positions q - L q' for the latency L = h/2.

The start state of each chirp is measured with noise. A last Gauss-Newton step eliminates its errors as further
unknowns: from the residuals r (n,) and their Jacobian J for the p parameters, it removes S (SᵀS + P)⁻¹ Sᵀ r and
S (SᵀS + P)⁻¹ Sᵀ J, with the Jacobian S for the start states and their inverse variances P. The result is r* and J*.
The 95 % confidence intervals come from the larger of two variances: that of white noise, s² N⁻¹ with N = JᵀJ* and
s² = rᵀr / (n - p), and N⁻¹ (Σ g gᵀ) N⁻¹ with the sums g of J* r* over each 0.25 s of a chirp. If the joint's error /
noise is above 1, the half width is multiplied by it, because the error of a model is systematic.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from pkgutil import resolve_name
from types import MappingProxyType
from typing import cast

import mujoco
import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from scipy import optimize, stats

from wheelleg_exp.anatomy.compiled_robot import at_default
from wheelleg_exp.constraints import Node
from wheelleg_exp.errors import EXIT_FINDING, not_one_of
from wheelleg_exp.managers import SceneManager
from wheelleg_exp.robot_logs.robot_log import TARGETS, LogError, Numbers, RobotLog, columns_of, noise_of
from wheelleg_exp.sim.actuators import DelayedPDActuator
from wheelleg_exp.sim.batch_engine import BatchEngine
from wheelleg_exp.sim.options import EnvOptions, read_env
from wheelleg_exp.sim.robot_model import RobotLayout

PARAMETERS = ("armature", "friction", "viscous_friction", "gain", "delay", "effort_scale", "latency")
UNITS = dict(zip(PARAMETERS, ("kg·m²", "N·m", "N·m·s/rad", "1", "s", "1", "s"), strict=True))
DRIVE_RATE = 1000.0  # Hz
READINGS = ("joint_pos", "joint_vel", "joint_effort")
_REST_S, _SKIPPED_S, _BLOCK_S, _HEIGHT = 0.3, 0.05, 0.25, 10.0
_CHUNK = 32  # control steps per call of MuJoCo, which bounds the memory
_AVERAGED = 6  # rows
_MOST_ERROR = 5.0  # times the noise of a joint's readings
_MOST_FITS, _BAD = 4, 3.0  # a fit is bad if its error is larger than 3 times the noise
_STEP, _MOST_EVALUATIONS = 1e-3, 25
_GRAVITY = 9.81
# The least first guess of each unknown, because a joint without friction never sticks.
_FIRST = (0.1, 0.5, 0.5, 0.2, 0.5, 0.2, -1.0)
_PD = {"joint_names_expr", "stiffness", "damping", "effort_limit", "velocity_limit", *PARAMETERS[:3]}
_TARGET = {"_target_": "wheelleg_exp.sim.actuators.ImplicitActuator"}
_LEAST_LOAD = 0.005  # least torque of gravity, as a share of the effort limit, from which an effort scale is found


@dataclass(frozen=True)
class Parameter:
    """One parameter of a joint: its value in the config of the robot, the identified value, and the interval."""

    joint: str
    name: str
    before: float
    value: float
    low: float
    high: float


@dataclass(frozen=True)
class Identified:
    """Identified motor parameters, and prediction errors (RMS / noise) of the config's and the identified ones."""

    parameters: list[Parameter]
    fitted: tuple[float, float]
    held_out: tuple[float, float]
    pieces: tuple[int, int]
    drives: Mapping[str, Mapping[str, float]]
    physics_dt: float  # of the config, s
    drive_rate: float  # of the simulation, Hz
    groups: Mapping[str, list[str]]  # the joints of each actuator group
    delayed: frozenset[str]  # the actuator groups whose delay is ``min_delay`` and ``max_delay``


Weights = Mapping[str, tuple[float, float]]  # by joint: a mass, kg, and its distance from the joint's axis, m
Progress = Callable[[str], None] | None


def _add_weight(spec: mujoco.MjSpec, layout: RobotLayout, joint: str, mass: float, radius: float) -> None:
    """Add a point mass to the link of a joint: it hangs below the axis while the joint reads 0 in the default pose."""
    model = spec.compile()
    data, index = mujoco.MjData(model), model.joint(joint).id
    for name, value in zip(layout.joint_names, layout.default_joint_pos.tolist(), strict=True):
        data.joint(name).qpos[0] = 0.0 if name == joint else value
    mujoco.mj_forward(model, data)
    axis, body = data.xaxis[index], int(model.jnt_bodyid[index])
    down = model.opt.gravity - axis * (axis @ model.opt.gravity)
    place = model.jnt_pos[index] + radius * data.xmat[body].reshape(3, 3).T @ down / np.linalg.norm(down)
    part = spec.body(model.body(body).name).add_body(name=f"{joint}_weight", pos=place)
    part.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[1e-4, 0, 0], mass=mass, contype=0, conaffinity=0)


class ChirpSimulation:
    """N simulations of a robot with a fixed base, each with its own motor parameters and its own piece of a log.

    Drives are PD controllers. They and the physics run at ``rate``, Hz, rounded to a multiple of the control rate.
    """

    def __init__(
        self, env: EnvOptions, mjcf: Path, num_envs: int, gravity: Numbers, weights: Weights, rate: float
    ) -> None:
        self.step_dt = env.sim.dt * env.decimation
        self.substeps = max(1, round(self.step_dt * rate))
        actuators: dict[str, Node | None] = {}
        for name, node in env.robot.actuators.items():
            if node is not None:
                drive = {key: value for key, value in node.items() if key in _PD}
                actuators[name] = {"effort_limit": 1e9, "velocity_limit": 1e9, **drive, **_TARGET}
        start = replace(env.robot.init_state, pos=[0.0, 0.0, _HEIGHT], rot=[1.0, 0.0, 0.0, 0.0])
        robot = replace(env.robot, init_state=start, actuators=actuators)
        sim = replace(env.sim, gravity=gravity.tolist(), dt=self.step_dt / self.substeps, integrator="euler")
        env = replace(env, robot=robot, sim=sim, scene=replace(env.scene, sensors={}))
        self.scene = SceneManager(env, mjcf, num_envs).scene
        for joint, (mass, radius) in weights.items():
            if joint not in (known := self.scene.robot.joint_names):
                raise not_one_of(f"the robot has no joint '{joint}'", joint, known, key="--weight")
            _add_weight(self.scene.spec, self.scene.robot.layout, joint, mass, radius)
        self.scene.spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT.value
        self.scene.play()
        self.robot, self.sim = self.scene.robot, cast(BatchEngine, self.scene.sim)
        self.names = list(self.robot.joint_names)
        self.driven = self.robot.layout.actuated_ids.tolist()  # in the order of MuJoCo's actuators
        self.drives = {key: np.zeros(len(self.names)) for key in ("stiffness", "damping", "effort_limit")}
        for key, numbers in self.drives.items():
            for group in self.robot.actuators.values():
                numbers[group.joint_ids] = getattr(group, key)[0]
        # ``trees`` (J,): the kinematic tree of each joint; different trees move independently.
        trees = self.sim.model.dof_treeid[self.robot.layout.dof_ids.numpy()]
        self.trees = np.zeros_like(trees) if self.sim.model.neq or self.sim.model.ntendon else trees

    def start_values(self, delays: Mapping[str, float]) -> Numbers:
        """Return the parameters of the config, (driven joints, 7); ``delays`` (s) by actuator group."""
        data, values = self.robot.data, np.ones((len(self.names), len(PARAMETERS)))
        fields = (data.joint_armature, data.joint_friction_coeff, data.joint_viscous_friction_coeff)
        values[:, :3] = torch.stack([field[0] for field in fields], dim=1).numpy()
        values[:, [4, 6]] = 0.0
        for name, delay in delays.items():
            values[self.robot.actuators[name].joint_ids.numpy(), 4] = delay
        return values[self.driven]

    def inertias(self) -> tuple[Numbers, NDArray[np.bool_]]:
        """Return the inertia of the links that each driven joint moves, kg·m², and whether gravity loads the joint."""
        model, dofs = self.sim.model, self.robot.layout.dof_ids.numpy()[self.driven]
        data, matrix = at_default(model, self.robot), np.zeros((model.nv, model.nv))
        mujoco.mj_fullM(model, data, matrix)
        joints = model.dof_jntid[dofs]
        bodies = model.jnt_bodyid[joints]
        away = np.cross(data.subtree_com[bodies] - data.xanchor[joints], data.xaxis[joints])
        load = model.body_subtreemass[bodies] * np.linalg.norm(away, axis=1) * _GRAVITY
        effort = self.drives["effort_limit"][self.driven]
        return (matrix.diagonal() - model.dof_armature)[dofs], load > _LEAST_LOAD * effort

    def play(self, values: Numbers, targets: Numbers, start: Numbers) -> Numbers:
        """Return positions, speeds, and efforts of M <= N simulations after each control step, (T, M, 3, J).

        ``values`` (M, driven joints, 7) are the motor parameters, ``targets`` (T, 3, M, J) the targets of each control
        step, and ``start`` (M, 2, J) the joint positions and speeds before the first step.
        """
        robot, batch, driven = self.robot, self.sim.batch, self.driven
        ids, rows, numbers = torch.arange(len(values)), np.arange(len(values)), torch.from_numpy(values)
        robot.write_joint_armature_to_sim(numbers[..., 0], driven, ids)
        robot.write_joint_friction_coefficient_to_sim(numbers[..., 1], None, numbers[..., 2], driven, ids)
        stiffness, damping = (self.drives[key][driven] * values[..., 3] for key in ("stiffness", "damping"))
        robot.write_joint_stiffness_to_sim(torch.from_numpy(stiffness).float(), driven, ids)
        robot.write_joint_damping_to_sim(torch.from_numpy(damping - stiffness * values[..., 6]).float(), driven, ids)
        batch.reset(rows)
        qpos, qvel = robot.layout.qpos_ids.numpy(), robot.layout.dof_ids.numpy()
        latency = np.zeros((len(rows), len(self.names)))
        latency[:, driven] = values[..., 6]
        batch.qpos[rows[:, None], qpos] = start[:, 0] + latency * start[:, 1]
        batch.qvel[rows[:, None], qvel] = start[:, 1]
        position, velocity, effort = targets[..., driven].swapaxes(0, 1)
        control = stiffness * position + damping * velocity + effort
        # A target that arrives between two physics steps acts on the first of them with the share of its time.
        late = values[:, None, :, 4] * self.substeps / self.step_dt
        lag, places = np.floor(late).astype(int), (rows[:, None, None], np.arange(len(driven)))
        found = np.zeros((len(targets), len(rows), 3, len(self.names)))
        for first in range(0, len(targets), _CHUNK):
            part = found[first : first + _CHUNK]
            steps = np.arange(len(part) * self.substeps)[:, None] + first * self.substeps
            now, before = (control[(np.maximum(steps - lag - k, 0) // self.substeps, *places)] for k in (0, 1))
            record = ("qpos", "qvel", "actuator_force")
            made = batch.rollout(len(steps), now + (late - lag) * (before - now), record=record, ids=rows)
            ends = [made[name][:, self.substeps - 1 :: self.substeps].swapaxes(0, 1) for name in record]
            part[:, :, 0], part[:, :, 1], part[:, :, 2, driven] = ends[0][..., qpos], ends[1][..., qvel], ends[2]
        found[:, :, 0] -= latency * found[:, :, 1]
        return found


@dataclass(frozen=True)
class _Pieces:
    """S pieces of a log that start at rest, T rows each: targets, start states, and readings; NaN after their end."""

    targets: Numbers  # (T, 3, S, J)
    start: Numbers  # (S, 2, J)
    logged: Numbers  # (T, S, 3, J), one control step later than the targets

    def of(self, which: slice) -> _Pieces:
        return _Pieces(self.targets[:, :, which], self.start[which], self.logged[:, which])


def identify(
    log: RobotLog,
    params: Mapping[str, object],
    mjcf: Path,
    weights: Weights = MappingProxyType({}),
    drive_rate: float = DRIVE_RATE,
    progress: Progress = None,
) -> Identified:
    """Identify the motors of the robot in the ``env`` config ``params`` from a log of chirps.

    Every second half of the log's pieces (the chirps that ``chirps.py`` plays from high to low frequency) is held out.
    ``progress`` is called with a line of text after each evaluation. Raise LogError if the log has no chirps, or if the
    best simulation differs from it by more than 5 times the noise.
    """
    _chirp_starts(log)
    env = read_env(params)
    columns = columns_of("projected_gravity", 3, ())
    mean = log.complete_table(columns).mean(axis=0) if log.has(columns) else np.array([0.0, 0.0, -1.0])
    if np.linalg.norm(mean) < 0.5:
        message = "the columns projected_gravity.x, .y, .z are not a direction"
        raise LogError(message, key=str(log.path), expected="a unit vector")
    gravity = _GRAVITY * mean / np.linalg.norm(mean)
    probe = ChirpSimulation(env, mjcf, 1, gravity, weights, drive_rate)
    pieces = _pieces(log, probe)
    half = (pieces.start.shape[0] + 1) // 2
    fitted, held_out = pieces.of(slice(half)), pieces.of(slice(half, None))
    actuators = {name: group for name, group in env.robot.actuators.items() if group is not None}
    bounds = {n: g.get("delay") or (g.get("min_delay", 0), g.get("max_delay", 0)) for n, g in actuators.items()}
    before = probe.start_values({name: env.sim.dt * sum(pair) / 2 for name, pair in bounds.items()})
    free = np.broadcast_to([name != "effort_scale" for name in PARAMETERS], before.shape).copy()
    free[:, 5] = probe.inertias()[1] & np.isfinite(pieces.logged[:, :, 2]).any()
    most = 1 + max(np.bincount(probe.trees[probe.driven], free.sum(axis=1)))
    simulation = ChirpSimulation(env, mjcf, int(most) * len(fitted.start), gravity, weights, drive_rate)
    noise = _noise(fitted.logged)
    # Columns with little noise, such as efforts, have narrow minima, which hide a long delay from the first fit.
    coarse = np.maximum(noise, 0.05 * np.nanstd(fitted.logged, axis=(0, 1), keepdims=True))
    x = _first_fit(simulation, fitted, before, free, coarse, progress)
    own = np.sqrt(np.nanmean(_errors(simulation, x[None], fitted)[0] ** 2, axis=(0, 1), keepdims=True))
    fit = _Fit(simulation, fitted, x, free, np.maximum(own, 0.2 * noise), progress)
    solution = fit.solve(-1.0)
    errors = _errors(simulation, fit.values(solution.x)[None], pieces)[0]
    ratio = np.sqrt(np.nanmean((errors / noise) ** 2, axis=(0, 1, 2)))
    if ratio.max() > _MOST_ERROR:
        name = probe.names[int(ratio.argmax())]
        message = f"the model cannot repeat the log: the error of '{name}' is {ratio.max():.0f} times the noise"
        expected = f"at most {_MOST_ERROR:g} times; check the robot file, --weight, --drive-rate, backlash, elasticity"
        error = LogError(message, key=str(log.path), expected=expected)
        error.exit_code = EXIT_FINDING
        raise error
    faster = (probe.substeps + 1) / probe.step_dt
    x, half_width = fit.refined(solution, ChirpSimulation(env, mjcf, len(fitted.start), gravity, weights, faster))
    half_width *= np.maximum(1.0, ratio[probe.driven, None])
    low, high = x - half_width, x + half_width
    low[:, :6] = np.maximum(low[:, :6], 0.0)
    scores = [_scores(simulation, np.stack((before, x)), part, noise) for part in (fitted, held_out)]
    parameters = [
        Parameter(probe.names[joint], name, *(float(values[row, k]) for values in (before, x, low, high)))
        for row, joint in enumerate(probe.driven)
        for k, name in enumerate(PARAMETERS)
        if free[row, k]
    ]
    drives = {key: dict(zip(probe.names, values.tolist(), strict=True)) for key, values in probe.drives.items()}
    groups = {name: list(group.joint_names) for name, group in probe.robot.actuators.items()}
    classes = {name: resolve_name(actuators[name]["_target_"]) for name in groups}
    delayed = frozenset(name for name, kind in classes.items() if issubclass(kind, DelayedPDActuator))
    counts = (half, len(held_out.start))
    steps = env.sim.dt, probe.substeps / probe.step_dt
    return Identified(parameters, scores[0], scores[1], counts, drives, *steps, groups, delayed)


def _chirp_starts(log: RobotLog) -> np.ndarray:
    """Return the rows before the first moving target of each chirp; raise LogError if the log has less than two."""
    targets = log.table([name for name in log.columns if name.startswith("target_")])
    still = np.append(True, np.abs(np.diff(targets, axis=0)).max(axis=1, initial=0.0) < 1e-9)
    run = np.zeros(len(log), int)
    for row in range(1, len(log)):
        run[row] = run[row - 1] + 1 if still[row] else 0
    starts = np.flatnonzero((run[:-1] >= round(_REST_S / max(log.step_dt, 1e-6))) & ~still[1:])
    if len(starts) < 2:
        empty = [
            f"; '{n}' has no number in row {np.isnan(x).argmax()}" for n, x in log.columns.items() if np.isnan(x).any()
        ]
        message = "the log contains no chirps that start at rest" + "".join(empty[:1])
        raise LogError(message, key=str(log.path), expected="a log of the bundle's chirps.py")
    return starts


def _pieces(log: RobotLog, simulation: ChirpSimulation) -> _Pieces:
    """Cut the log where all targets rest: each piece starts at rest and ends before the next one."""
    names, step_dt = simulation.names, simulation.step_dt
    log.complete_table([f"target_{kind}.{name}" for kind in TARGETS[:2] for name in names])
    targets = np.stack([log.targets(kind, names) for kind in TARGETS], axis=1)
    gaps = np.flatnonzero(log.starts(step_dt)[1:]) + 1
    if len(gaps):
        message = f"row {gaps[0]} does not follow the row before after one control step of {step_dt:.4g} s"
        raise LogError(message, key=str(log.path), expected="one row per control step of the config")
    starts = _chirp_starts(log)
    length = int(np.diff(np.append(starts, len(log) - 1)).max())
    readings = [log.complete_table([f"{reading}.{name}" for name in names]) for reading in READINGS[:2]]
    effort = [f"joint_effort.{name}" for name in names]
    readings.append(log.table(effort) if log.has(effort) else np.full(readings[0].shape, np.nan))
    logged, ends = np.stack(readings, axis=1), np.append(starts[1:], len(log) - 1)
    rows = starts[:, None] + np.arange(length)
    inside = rows < ends[:, None]
    later = np.where(inside[..., None, None], logged[np.minimum(rows + 1, len(log) - 1)], np.nan)
    later[:, : round(_SKIPPED_S / step_dt)] = np.nan
    # The readings before a start give the state at the start with less noise: a slow joint can still move a little.
    start = np.stack([logged[k - _AVERAGED + 1 : k + 1, :2].mean(axis=0) for k in starts])
    start[:, 0] += start[:, 1] * step_dt * (_AVERAGED - 1) / 2
    chosen = targets[np.minimum(rows, len(log) - 1)].transpose(1, 2, 0, 3)
    return _Pieces(chosen, start, later.swapaxes(0, 1))


def _noise(logged: Numbers) -> Numbers:
    """Return the noise of each column from third differences, at least a thousandth of its motion, (1, 1, 3, J)."""
    least = 1e-3 * np.nanstd(logged, axis=(0, 1), keepdims=True) + 1e-12
    return np.asarray(np.maximum(noise_of(logged, (0, 1)), least))


def _errors(simulation: ChirpSimulation, values: Numbers, pieces: _Pieces, shifts: Numbers | None = None) -> Numbers:
    """Return logged minus simulated readings, (M, T, S, 3, J); ``shifts`` (M, 2, J) are added to the start states."""
    count, width, size = len(values), len(pieces.start), simulation.scene.num_envs
    if count * width > size:
        shifts = np.zeros((count, 2, len(simulation.names))) if shifts is None else shifts
        pairs = zip(values, shifts, strict=True)
        return np.concatenate([_errors(simulation, value[None], pieces, shift[None]) for value, shift in pairs])
    model, piece = np.divmod(np.arange(count * width), width)
    start = pieces.start[piece] + (0.0 if shifts is None else shifts[model])
    played = simulation.play(values[model], pieces.targets[:, :, piece], start)
    played = played.reshape(len(played), count, width, *played.shape[2:]).swapaxes(0, 1)
    scale = np.ones((count, 1, 1, 3, len(simulation.names)))
    scale[:, 0, 0, 2, simulation.driven] = values[..., 5]
    errors: Numbers = pieces.logged - scale * played
    # The angle of a wheel counts from an arbitrary start, and only its changes matter.
    free = simulation.drives["stiffness"] == 0
    errors[:, :, :, 0, free] -= np.nanmean(errors[:, :, :, 0, free], axis=1, keepdims=True)
    return np.asarray(errors)


def _first_fit(
    simulation: ChirpSimulation, pieces: _Pieces, before: Numbers, free: Numbers, noise: Numbers, progress: Progress
) -> Numbers:
    """Return the parameters of the best of a few fits: joints that fit badly start again, with longer delays."""
    tried = np.repeat(before[None], 12, axis=0)
    tried[:, :, 4] += np.arange(12)[:, None] * simulation.step_dt / 4
    sizes = np.nanmean((_errors(simulation, tried, pieces) / noise)[..., simulation.driven] ** 2, axis=(1, 2, 3))
    start, best, least = before.copy(), before, np.inf
    start[:, 4] = tried[sizes.argmin(axis=0), np.arange(len(before)), 4]
    for attempt in range(1, _MOST_FITS + 1):
        fit = _Fit(simulation, pieces, start, free, noise, progress)
        solution = fit.solve(_FIRST)
        if solution.cost < least:
            best, least = fit.values(solution.x), solution.cost
        errors = (_errors(simulation, best[None], pieces)[0] / noise)[..., simulation.driven]
        bad = np.sqrt(np.nanmean(errors**2, axis=(0, 1, 2))) > _BAD
        if not bad.any():
            break
        start = np.where(bad[:, None], before, best)
        start[bad, 4] = best[bad, 4] + (attempt - 0.5) * simulation.step_dt / 2
    return best


def _scores(simulation: ChirpSimulation, values: Numbers, pieces: _Pieces, noise: Numbers) -> tuple[float, float]:
    if not len(pieces.start):
        return (float("nan"), float("nan"))
    before, after = np.sqrt(np.nanmean((_errors(simulation, values, pieces) / noise) ** 2, axis=(1, 2, 3, 4)))
    return float(before), float(after)


@dataclass
class _Fit:
    """One least-squares problem.

    The motion of a joint depends mostly on ratios to the gain K. The unknowns are therefore (armature + inertia of the
    links) / K, both frictions / K, K, delay, effort scale times K, and latency, each divided by its typical size.
    """

    simulation: ChirpSimulation
    pieces: _Pieces
    start: Numbers
    free: Numbers
    noise: Numbers
    progress: Progress

    def __post_init__(self) -> None:
        simulation, start = self.simulation, self.start
        self.known: tuple[bytes, Numbers, Numbers] | None = None
        self.low = np.broadcast_to((1e-3, 0.0, 0.0, 0.1, 0.0, 0.1, -1.0), start.shape)[self.free]
        self.high = np.broadcast_to((np.inf,) * 6 + (1.0,), start.shape)[self.free]
        self.inertia = simulation.inertias()[0]
        ones, effort = np.ones(len(start)), simulation.drives["effort_limit"].clip(max=1e3)[simulation.driven]
        inertia = self.inertia + np.maximum(start[:, 0], 1e-6)
        viscous = 0.1 * np.maximum(simulation.drives["damping"][simulation.driven], inertia)
        trees, inside = self.simulation.trees, np.isfinite(self.pieces.logged)
        # Unknowns of joints in different trees change different readings, so that one simulation can move them all.
        own = trees[self.simulation.driven][np.nonzero(self.free)[0]]
        self.turns = np.array([np.sum(own[:k] == tree) for k, tree in enumerate(own)])
        self.coupled = own[:, None] == np.broadcast_to(trees, inside.shape)[inside]
        rest = (1.0, simulation.step_dt / 2, 1.0, simulation.step_dt / simulation.substeps)
        self.sizes = np.stack((inertia, 0.01 * effort, viscous, *np.outer(rest, ones)), axis=1)

    def values(self, unknowns: Numbers) -> Numbers:
        """Return all parameters (driven joints, 7) of the unknowns of the free parameters."""
        ratios = self.ratios(self.start)
        ratios[self.free] = unknowns
        found: Numbers = ratios * self.sizes
        gain = ratios[:, 3:4]
        found[:, :3] *= gain
        found[:, 0] = np.maximum(found[:, 0] - self.inertia, 1e-9)
        found[:, 5] = np.where(self.free[:, 5], found[:, 5] / gain[:, 0], self.start[:, 5])
        return found

    def ratios(self, values: Numbers) -> Numbers:
        """Return the unknowns of all parameters (driven joints, 7); ``values`` does the inverse."""
        found, gain = values.copy(), values[:, 3:4]
        found[:, 0] += self.inertia
        found[:, :3] /= gain
        found[:, 5] *= gain[:, 0]
        return np.asarray(found / self.sizes)

    def solve(self, least: ArrayLike) -> optimize.OptimizeResult:
        """Return scipy's solution from the start values, raised to ``least`` (7,)."""
        start = np.clip(np.maximum(self.ratios(self.start), least)[self.free], self.low, self.high)
        limits = {"bounds": (self.low, self.high), "x_scale": "jac", "max_nfev": _MOST_EVALUATIONS, "xtol": 1e-5}
        residuals, jacobian = (lambda x: self._evaluate(x)[0]), (lambda x: self._evaluate(x)[1])
        return optimize.least_squares(residuals, start, jacobian, ftol=1e-4, **limits)

    def _evaluate(self, unknowns: Numbers) -> tuple[Numbers, Numbers]:
        """Return the residuals (n,) and their Jacobian (n, p) by forward differences, in one batch of simulations."""
        if self.known is None or self.known[0] != unknowns.tobytes():
            steps, turns = _STEP * np.maximum(1.0, np.abs(unknowns)), self.turns
            moves = np.where(turns == np.arange(turns.max() + 1)[:, None], steps, 0.0)
            tried = np.stack([self.values(point) for point in (unknowns, *(unknowns + moves))])
            errors = (_errors(self.simulation, tried, self.pieces) / self.noise)[:, np.isfinite(self.pieces.logged)]
            slopes = (errors[1:] - errors[0])[turns] / steps[:, None]
            self.known = (unknowns.tobytes(), errors[0], np.where(self.coupled, slopes, 0.0).T)
            if self.progress is not None:
                self.progress(f"prediction error {np.sqrt(np.mean(errors[0] ** 2)):.4g} times the noise")
        return self.known[1:]

    def refined(self, solution: optimize.OptimizeResult, faster: ChirpSimulation) -> tuple[Numbers, Numbers]:
        """Return all parameters (driven joints, 7) after a last step, and half the widths of their 95 % intervals."""
        inside, width = np.isfinite(self.pieces.logged), 2 * len(self.simulation.names)
        shifts = 1e-3 * np.eye(width).reshape(width, 2, -1)
        values = np.repeat(self.values(solution.x)[None], width, axis=0)
        moved = (_errors(self.simulation, values, self.pieces, shifts) / self.noise)[:, inside]
        starts = (moved - solution.fun).T / 1e-3
        # The period of the drives is a further unknown, with a deviation of half the assumed period.
        moved = (_errors(faster, values[:1], self.pieces)[0] / self.noise)[inside]
        slopes = np.column_stack((solution.jac, (solution.fun - moved) * faster.substeps))
        low, high = np.append(self.low, -np.inf), np.append(self.high, np.inf)
        time, piece, *_ = np.nonzero(inside)
        deviation = self.noise[0, 0, :2] / np.sqrt(_AVERAGED)
        jacobian, errors, start = slopes.copy(), solution.fun.copy(), np.append(solution.x, 0.0)
        for number in range(inside.shape[1]):
            rows = piece == number
            own = starts[rows]
            back = np.linalg.solve(own.T @ own + np.diag(1 / deviation.ravel() ** 2), own.T)
            jacobian[rows] -= own @ (back @ jacobian[rows])
            errors[rows] -= own @ (back @ errors[rows])
        normal, slope = slopes.T @ jacobian, slopes.T @ errors
        normal[-1, -1] += 1 / 0.5**2
        inverse = np.linalg.pinv(normal)
        step = -inverse @ slope
        at = (start + step <= low) | (start + step >= high)  # the bounds that the step reaches
        step[at] = (np.clip(start + step, low, high) - start)[at]
        step[~at] = -np.linalg.pinv(normal[~at][:, ~at]) @ (slope + normal[:, at] @ step[at])[~at]
        block = piece * inside.shape[0] + time // round(_BLOCK_S / self.simulation.step_dt)
        scores = jacobian * (errors + jacobian @ step)[:, None]
        scores = np.stack([scores[block == number].sum(axis=0) for number in np.unique(block)])
        spare = max(1, len(scores) - len(step))
        white = max(1.0, 2 * solution.cost / (len(errors) - len(step))) * inverse
        grouped = inverse @ scores.T @ scores @ inverse * len(scores) / spare
        x = np.clip(start + step, low, high)[:-1]
        # The change of the parameters with the unknowns carries the covariance from the unknowns to the parameters.
        change = [(self.values(x + d) - self.values(x - d)).ravel() / 2e-6 for d in 1e-6 * np.eye(len(x))]
        both = (np.einsum("pv,pq,qv->v", change, covariance[:-1, :-1], change) for covariance in (white, grouped))
        deviation = np.sqrt(np.maximum(*both).clip(min=0.0)).reshape(self.start.shape)
        return self.values(x), float(stats.t.ppf(0.975, spare)) * deviation


_ROUNDED = 0.05  # A delay this close to a whole number of physics steps is rounded.


def profile_text(found: Identified, base: str, name: str, log: str) -> str:
    """Return the YAML of a profile that inherits from the robot config ``base``; comments are confidence intervals."""
    values = {(p.joint, p.name): p for p in found.parameters}
    printable = re.sub(r"[^\w ./-]", "?", log)
    lines = ["# @package env.robot", f"# Like `{base}`, with motors identified from {printable}."]
    lines += ["# The comments contain 95 % confidence intervals."]
    lines += [f"# The values are those of continuous joints whose drives compute torques at {found.drive_rate:.4g} Hz."]
    lines += ["# A physics step of training adds damping to them: the shorter the step (sim=fine), the less."]
    lines += ["defaults:", f"  - {base}", "  - _self_"]
    lines += [f"profile: {name}", "actuators:"]
    for group, joints in found.groups.items():
        lines.append(f"  {group}:")
        for key in PARAMETERS[:3]:
            lines += _mapping(key, UNITS[key], [(values[joint, key], 1.0) for joint in joints])
        for key, unit in (("stiffness", "N·m/rad"), ("damping", "N·m·s/rad")):
            lines += _mapping(key, unit, [(values[joint, "gain"], found.drives[key][joint]) for joint in joints])
        delays = [values[joint, "delay"] for joint in joints]
        steps = [p.value / found.physics_dt for p in delays]
        text = ", ".join(f"{p.joint} {1e3 * p.value:.3g} ms ({1e3 * p.low:.3g} to {1e3 * p.high:.3g})" for p in delays)
        bounds = [math.floor(min(steps) + _ROUNDED), math.ceil(max(steps) - _ROUNDED)]
        low, high = min(bounds), max(bounds)
        delay = f"min_delay: {low}\n    max_delay: {high}" if group in found.delayed else f"delay: [{low}, {high}]"
        lines.append(f"    {delay}   # physics steps; {text}")
        for p in (values[joint, "effort_scale"] for joint in joints if (joint, "effort_scale") in values):
            interval = f"({p.low:.4g} to {p.high:.4g})"
            lines.append(f"    # The logged effort of {p.joint} is {p.value:.4g} times its torque {interval}.")
    return "\n".join(lines) + "\n"


def _mapping(key: str, unit: str, values: Sequence[tuple[Parameter, float]]) -> list[str]:
    lines = [f"    {key}:   # {unit}"]
    for p, factor in values:
        interval = f"{factor * p.low:.4g} to {factor * p.high:.4g}"
        lines.append(f"      '{re.escape(p.joint)}': {factor * p.value:.5g}   # {interval}")
    return lines
