"""Identify the motors of a robot from a log of chirps: the parameters with which the simulation repeats the log.

The robot's base is fixed in the simulation, and the drives follow the log's targets. For each driven joint, a
least-squares fit (scipy's trust region) finds six parameters: armature, Coulomb friction, viscous friction, gain (a
factor on stiffness and damping), delay of the targets, and effort scale (logged effort / torque of the motor). The
residuals are errors of positions, speeds, and efforts, divided by the noise of their column. All joints are fitted
together, because gravity and the reactions between links tell the torque of a motor from its inertia.

The state at the start of each chirp is measured with noise too. At the end, a Gauss-Newton step treats the errors of
the start states as further unknowns with the deviation of their noise, eliminates them, and gives the 95 % confidence
intervals x ± 1.96 sqrt(s² diag(N⁻¹)): N = JᵀJ - Σ Bᵢ (SᵢᵀSᵢ + P)⁻¹ Bᵢᵀ with Bᵢ = JᵀSᵢ, the Jacobians J of the residuals
r (n,) for the p parameters and Sᵢ for the start state of chirp i, the inverse variances P of the start states, and
s² = rᵀr / (n - p). The intervals assume white noise and a model that can repeat the log.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

import mujoco
import numpy as np
import torch
from scipy import optimize, stats

from wheelleg_exp.anatomy.compiled_robot import at_default
from wheelleg_exp.errors import not_one_of
from wheelleg_exp.managers import SceneManager
from wheelleg_exp.robot_logs.robot_log import TARGETS, LogError, Numbers, RobotLog, columns_of, noise_of
from wheelleg_exp.sim.actuators import DelayedPDActuator
from wheelleg_exp.sim.robot_model import RobotLayout

PARAMETERS = ("armature", "friction", "viscous_friction", "gain", "delay", "effort_scale")
UNITS = dict(zip(PARAMETERS, ("kg·m²", "N·m", "N·m·s/rad", "1", "s", "1"), strict=True))
READINGS = ("joint_pos", "joint_vel", "joint_effort")
_REST_S, _SKIPPED_S, _HEIGHT = 0.3, 0.05, 10.0
_AVERAGED = 6  # rows
_MOST_FITS, _BAD = 4, 1.5  # a fit is bad if its error is larger than 1.5 times the noise
_STEP, _MOST_EVALUATIONS = 1e-3, 25
_GRAVITY = 9.81
# The least first guess of each unknown, because a joint without friction never sticks.
_FIRST = (0.1, 0.5, 0.5, 0.2, 0.5, 0.2)
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
    """The identified parameters, and the prediction error (RMS of errors / noise) on pieces of the log.

    ``fitted`` and ``held_out`` contain the errors with the parameters of the config and with the identified parameters.
    """

    parameters: list[Parameter]
    fitted: tuple[float, float]
    held_out: tuple[float, float]
    pieces: tuple[int, int]
    drives: Mapping[str, Any]
    physics_dt: float
    groups: Mapping[str, list[str]]  # the joints of each actuator group
    delayed: frozenset[str]  # the actuator groups whose delay is ``min_delay`` and ``max_delay``


Weight = tuple[float, float]  # a mass, kg, and its distance from the joint's axis, m
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
    """P simulations of a robot with a fixed base, each with its own motor parameters and its own piece of a log."""

    def __init__(
        self, env: Mapping[str, Any], mjcf: Path, num_envs: int, gravity: Numbers, weights: Mapping[str, Weight]
    ) -> None:
        found = copy.deepcopy(dict(env))
        found["robot"]["init_state"] |= {"pos": [0.0, 0.0, _HEIGHT], "rot": [1.0, 0.0, 0.0, 0.0]}
        found["sim"] |= {"gravity": gravity.tolist()}
        found["scene"] |= {"sensors": {}}
        for group in (group for group in found["robot"]["actuators"].values() if group is not None):
            group.pop("delay", None)
            group |= dict.fromkeys({"min_delay", "max_delay"} & group.keys(), 0)
        self.scene = SceneManager(found, mjcf, num_envs).scene
        for joint, (mass, radius) in weights.items():
            if joint not in (known := self.scene.robot.joint_names):
                raise not_one_of(f"the robot has no joint '{joint}'", joint, known, key="--weight")
            _add_weight(self.scene.spec, self.scene.robot.layout, joint, mass, radius)
        self.scene.play()
        self.robot, self.sim, self.decimation = self.scene.robot, self.scene.sim, int(found["decimation"])
        self.dt = self.scene.physics_dt
        self.names = list(self.robot.joint_names)
        self.driven = sorted(j for group in self.robot.actuators.values() for j in group.joint_ids.tolist())
        self.drives = {key: self._of_joints(key) for key in ("stiffness", "damping", "effort_limit")}

    def _of_joints(self, key: str) -> torch.Tensor:
        values = torch.zeros(len(self.names))
        for group in self.robot.actuators.values():
            values[group.joint_ids] = getattr(group, key)[0]
        return values

    def start_values(self, delays: Mapping[str, float]) -> Numbers:
        """Return the parameters of the config, (driven joints, 6); ``delays`` (s) by actuator group."""
        data, values = self.robot.data, np.ones((len(self.names), len(PARAMETERS)))
        fields = (data.joint_armature, data.joint_friction_coeff, data.joint_viscous_friction_coeff)
        values[:, :3] = torch.stack([field[0] for field in fields], dim=1).numpy()
        values[:, 4] = 0.0
        for name, delay in delays.items():
            values[self.robot.actuators[name].joint_ids.numpy(), 4] = delay
        return values[self.driven]

    def inertias(self) -> tuple[Numbers, Numbers]:
        """Return the inertia of the links that each driven joint moves, kg·m², and whether gravity loads the joint."""
        model, dofs = self.sim.model, self.robot.layout.dof_ids.numpy()[self.driven]
        data, matrix = at_default(model, self.robot), np.zeros((model.nv, model.nv))
        mujoco.mj_fullM(model, data, matrix)
        joints = model.dof_jntid[dofs]
        bodies = model.jnt_bodyid[joints]
        away = np.cross(data.subtree_com[bodies] - data.xanchor[joints], data.xaxis[joints])
        load = model.body_subtreemass[bodies] * np.linalg.norm(away, axis=1) * _GRAVITY
        effort = self.drives["effort_limit"].numpy()[self.driven]
        return (matrix.diagonal() - model.dof_armature)[dofs], load > _LEAST_LOAD * effort

    def play(self, values: Numbers, targets: torch.Tensor, start: torch.Tensor) -> Numbers:
        """Return positions, speeds, and efforts of N simulations after each control step, (T, N, 3, J).

        ``values`` (N, driven joints, 6) are the motor parameters, ``targets`` (T, 3, N, J) the targets of each control
        step, and ``start`` (N, 2, J) the joint positions and speeds before the first step.
        """
        robot, numbers, driven = self.robot, torch.from_numpy(values), self.driven
        robot.write_joint_armature_to_sim(numbers[..., 0], driven)
        robot.write_joint_friction_coefficient_to_sim(numbers[..., 1], None, numbers[..., 2], driven)
        gain = numbers[..., 3].float()
        robot.write_joint_stiffness_to_sim(self.drives["stiffness"][driven] * gain, driven)
        robot.write_joint_damping_to_sim(self.drives["damping"][driven] * gain, driven)
        robot.reset()
        robot.write_joint_state_to_sim(*start.float().unbind(dim=1))
        self.scene.refresh()
        late = numbers[..., 4] / self.dt
        lag, share = late.floor().long(), (late - late.floor()).float()
        rows, columns = torch.arange(len(values))[:, None], torch.tensor(driven)[None]
        held, found = targets.repeat_interleave(self.decimation, dim=0), []
        for step in range(len(held)):
            now, before = ((step - lag - k).clamp(min=0) for k in (0, 1))
            delayed = held[step].clone()
            late_targets = torch.lerp(held[now, :, rows, columns], held[before, :, rows, columns], share[..., None])
            delayed[:, :, driven] = late_targets.movedim(-1, 0)
            if step % self.decimation == 0:
                robot.begin_control_step()
            robot.set_joint_position_target(delayed[0])
            robot.set_joint_velocity_target(delayed[1])
            robot.set_joint_effort_target(delayed[2])
            self.scene.write_data_to_sim()
            self.sim.step()
            self.scene.update()
            if (step + 1) % self.decimation == 0:
                data = robot.data
                qpos, qvel = self.sim.view("qpos"), self.sim.view("qvel")
                joints = qpos[:, robot.layout.qpos_ids], qvel[:, robot.layout.dof_ids], data.applied_torque.double()
                found.append(torch.stack(joints, dim=1))
        return torch.stack(found).numpy()


@dataclass(frozen=True)
class _Pieces:
    """S pieces of a log that start at rest, T rows each: targets, start states, and readings; NaN after their end."""

    targets: torch.Tensor  # (T, 3, S, J)
    start: torch.Tensor  # (S, 2, J)
    logged: Numbers  # (T, S, 3, J), one control step later than the targets

    def of(self, which: slice) -> _Pieces:
        return _Pieces(self.targets[:, :, which], self.start[which], self.logged[:, which])


def identify(
    log: RobotLog,
    env: Mapping[str, Any],
    mjcf: Path,
    weights: Mapping[str, Weight] = MappingProxyType({}),
    progress: Progress = None,
) -> Identified:
    """Identify the motors of the robot in an ``env`` config from a log of chirps.

    Every second half of the log's pieces (the chirps that ``chirps.py`` plays from high to low frequency) is held out.
    ``progress`` is called with a line of text after each evaluation. Raise LogError if the log has no chirps.
    """
    _chirp_starts(log)
    columns = columns_of("projected_gravity", 3, ())
    mean = log.complete_table(columns).mean(axis=0) if log.has(columns) else np.array([0.0, 0.0, -1.0])
    if np.linalg.norm(mean) < 0.5:
        message = "the columns projected_gravity.x, .y, .z are not a direction"
        raise LogError(message, key=str(log.path), expected="a unit vector")
    gravity = _GRAVITY * mean / np.linalg.norm(mean)
    probe = ChirpSimulation(env, mjcf, 1, gravity, weights)
    pieces = _pieces(log, probe)
    half = (pieces.start.shape[0] + 1) // 2
    fitted, held_out = pieces.of(slice(half)), pieces.of(slice(half, None))
    before = probe.start_values(_delays(env, probe.dt))
    free = np.broadcast_to([name != "effort_scale" for name in PARAMETERS], before.shape).copy()
    free[:, 5] = (probe.inertias()[1] != 0) & np.isfinite(pieces.logged[:, :, 2]).any()
    simulation = ChirpSimulation(env, mjcf, (1 + int(free.sum())) * len(fitted.start), gravity, weights)
    noise = _noise(fitted.logged)
    x = _first_fit(simulation, fitted, before, free, noise, progress)
    errors = _errors(simulation, x[None], fitted)[0]
    weights_of_fit = np.maximum(np.sqrt(np.nanmean(errors**2, axis=(0, 1), keepdims=True)), 0.2 * noise)
    fit = _Fit(simulation, fitted, x, free, weights_of_fit, progress)
    solution = fit.solve()
    x, half_width = fit.refined(solution)
    low, high = np.maximum(x - half_width, 0.0), x + half_width
    scores = [_scores(simulation, np.stack((before, x)), part, noise) for part in (fitted, held_out)]
    parameters = [
        Parameter(probe.names[joint], name, *(float(values[row, k]) for values in (before, x, low, high)))
        for row, joint in enumerate(probe.driven)
        for k, name in enumerate(PARAMETERS)
        if free[row, k]
    ]
    drives = {key: dict(zip(probe.names, values.tolist(), strict=True)) for key, values in probe.drives.items()}
    groups = {name: list(group.joint_names) for name, group in probe.robot.actuators.items()}
    delayed = frozenset(name for name, group in probe.robot.actuators.items() if isinstance(group, DelayedPDActuator))
    counts = (half, len(held_out.start))
    return Identified(parameters, scores[0], scores[1], counts, drives, probe.dt, groups, delayed)


def _delays(env: Mapping[str, Any], dt: float) -> dict[str, float]:
    """Return the mean delay of each actuator group in the config, s."""
    found = {}
    for name, group in env["robot"]["actuators"].items():
        if group is not None:
            bounds = group.get("delay") or (group.get("min_delay", 0), group.get("max_delay", 0))
            found[name] = dt * sum(bounds) / 2
    return found


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
    names, step_dt = simulation.names, simulation.dt * simulation.decimation
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
    chosen = torch.from_numpy(targets[np.minimum(rows, len(log) - 1)]).float()
    return _Pieces(chosen.permute(1, 2, 0, 3).contiguous(), torch.from_numpy(start), later.swapaxes(0, 1))


def _noise(logged: Numbers) -> Numbers:
    """Return the noise of each column from third differences, at least a thousandth of its motion, (1, 1, 3, J)."""
    least = 1e-3 * np.nanstd(logged, axis=(0, 1), keepdims=True) + 1e-12
    return np.maximum(noise_of(logged, (0, 1)), least)


def _errors(simulation: ChirpSimulation, values: Numbers, pieces: _Pieces, shifts: Numbers | None = None) -> Numbers:
    """Return logged minus simulated readings with M sets of parameters, (M, T, S, 3, J); NaN without a reading.

    ``shifts`` (M, 2, J) is added to the start positions and speeds.
    """
    count, width, size = len(values), len(pieces.start), simulation.scene.num_envs
    if count * width > size:
        shifts = np.zeros((count, 2, len(simulation.names))) if shifts is None else shifts
        pairs = zip(values, shifts, strict=True)
        return np.concatenate([_errors(simulation, value[None], pieces, shift[None]) for value, shift in pairs])
    spare = np.arange(size) % (count * width)  # Spare simulations repeat the first ones.
    model, piece = np.divmod(spare, width)
    start = pieces.start[piece] + (0.0 if shifts is None else torch.from_numpy(shifts[model]))
    played = simulation.play(values[model], pieces.targets[:, :, piece], start)[:, : count * width]
    played = played.reshape(len(played), count, width, *played.shape[2:]).swapaxes(0, 1)
    scale = np.ones((count, 1, 1, 3, len(simulation.names)))
    scale[:, 0, 0, 2, simulation.driven] = values[..., 5]
    errors = pieces.logged - scale * played
    # The angle of a wheel counts from an arbitrary start, and only its changes matter.
    free = (simulation.drives["stiffness"] == 0).numpy()
    errors[:, :, :, 0, free] -= np.nanmean(errors[:, :, :, 0, free], axis=1, keepdims=True)
    return errors


def _first_fit(
    simulation: ChirpSimulation, pieces: _Pieces, before: Numbers, free: Numbers, noise: Numbers, progress: Progress
) -> Numbers:
    """Return the parameters of the best of a few fits: joints that fit badly start again, with longer delays."""
    start, best, least = before, before, np.inf
    for attempt in range(1, _MOST_FITS + 1):
        fit = _Fit(simulation, pieces, start, free, noise, progress)
        solution = fit.solve()
        if solution.cost < least:
            best, least = fit.values(solution.x), solution.cost
        errors = (_errors(simulation, best[None], pieces)[0] / noise)[..., simulation.driven]
        bad = np.sqrt(np.nanmean(errors**2, axis=(0, 1, 2))) > _BAD
        if not bad.any():
            break
        start = np.where(bad[:, None], before, best)
        start[bad, 4] = best[bad, 4] + (attempt - 0.5) * simulation.dt
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
    links) / K, both frictions / K, K, delay, and effort scale times K, each divided by its typical size.
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
        self.low = np.broadcast_to((1e-3, 0.0, 0.0, 0.1, 0.0, 0.1), start.shape)[self.free]
        self.inertia = simulation.inertias()[0]
        ones, effort = np.ones(len(start)), simulation.drives["effort_limit"].clamp(max=1e3).numpy()[simulation.driven]
        inertia = self.inertia + np.maximum(start[:, 0], 1e-6)
        viscous = 0.1 * np.maximum(simulation.drives["damping"].numpy()[simulation.driven], inertia)
        self.sizes = np.stack((inertia, 0.01 * effort, viscous, ones, ones * simulation.dt, ones), axis=1)

    def values(self, unknowns: Numbers) -> Numbers:
        """Return all parameters (driven joints, 6) of the unknowns of the free parameters."""
        ratios = self.ratios(self.start)
        ratios[self.free] = unknowns
        found, gain = ratios * self.sizes, ratios[:, 3:4]
        found[:, :3] *= gain
        found[:, 0] = np.maximum(found[:, 0] - self.inertia, 1e-9)
        found[:, 5:] = np.where(self.free[:, 5:], found[:, 5:] / gain, self.start[:, 5:])
        return found

    def ratios(self, values: Numbers) -> Numbers:
        """Return the unknowns of all parameters (driven joints, 6); ``values`` does the inverse."""
        found, gain = values.copy(), values[:, 3:4]
        found[:, 0] += self.inertia
        found[:, :3] /= gain
        found[:, 5:] *= gain
        return found / self.sizes

    def solve(self) -> Any:
        """Return scipy's solution."""
        start = np.maximum(self.ratios(self.start), _FIRST)[self.free]
        limits = {"bounds": (self.low, np.inf), "x_scale": "jac", "max_nfev": _MOST_EVALUATIONS, "xtol": 1e-5}
        residuals, jacobian = (lambda x: self._evaluate(x)[0]), (lambda x: self._evaluate(x)[1])
        return optimize.least_squares(residuals, start, jacobian, ftol=1e-6, **limits)

    def _evaluate(self, unknowns: Numbers) -> tuple[Numbers, Numbers]:
        """Return the residuals (n,) and their Jacobian (n, p) by forward differences, in one batch of simulations."""
        if self.known is None or self.known[0] != unknowns.tobytes():
            steps = _STEP * np.maximum(1.0, np.abs(unknowns))
            tried = np.stack([self.values(point) for point in (unknowns, *(unknowns + np.diag(steps)))])
            errors = (_errors(self.simulation, tried, self.pieces) / self.noise).reshape(len(tried), -1)
            errors = errors[:, np.isfinite(self.pieces.logged).ravel()]
            self.known = (unknowns.tobytes(), errors[0], ((errors[1:] - errors[0]) / steps[:, None]).T)
            if self.progress is not None:
                self.progress(f"prediction error {np.sqrt(np.mean(errors[0] ** 2)):.4g} times the noise")
        return self.known[1:]

    def refined(self, solution: Any) -> tuple[Numbers, Numbers]:
        """Return all parameters (driven joints, 6) after a last step, and half the widths of their 95 % intervals."""
        inside, width = np.isfinite(self.pieces.logged), 2 * len(self.simulation.names)
        shifts = 1e-3 * np.eye(width).reshape(width, 2, -1)
        values = np.repeat(self.values(solution.x)[None], width, axis=0)
        moved = (_errors(self.simulation, values, self.pieces, shifts) / self.noise)[:, inside]
        starts = (moved - solution.fun).T / 1e-3
        piece = np.broadcast_to(np.arange(inside.shape[1])[:, None, None], inside.shape)[inside]
        deviation = self.noise[0, 0, :2] / np.sqrt(_AVERAGED)
        normal, slope = solution.jac.T @ solution.jac, solution.jac.T @ solution.fun
        for number in range(inside.shape[1]):
            own, errors = starts[piece == number], solution.fun[piece == number]
            cross = solution.jac[piece == number].T @ own
            weight = np.linalg.inv(own.T @ own + np.diag(1 / deviation.ravel() ** 2))
            normal, slope = normal - cross @ weight @ cross.T, slope - cross @ weight @ own.T @ errors
        covariance = 2 * solution.cost / (len(solution.fun) - len(solution.x)) * np.linalg.pinv(normal)
        x = np.maximum(solution.x - np.linalg.pinv(normal) @ slope, self.low)
        # The change of the parameters with the unknowns carries the covariance from the unknowns to the parameters.
        change = [(self.values(x + d) - self.values(x - d)).ravel() / 2e-6 for d in 1e-6 * np.eye(len(x))]
        variance = np.einsum("pv,pq,qv->v", change, covariance, change).reshape(self.start.shape)
        return self.values(x), float(stats.norm.ppf(0.975)) * np.sqrt(np.maximum(variance, 0.0))
