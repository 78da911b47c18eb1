"""Compare a robot's log with a run's policy and with a simulation, and name the faults that explain the differences.

Every possible fault of ``log_faults`` is a hypothesis. For each hypothesis, the simulation predicts the readings of
windows of 0.1 s, starting from the log's readings as the hypothesis explains them. The spread of a column's errors is
1.48 times the median of their absolute values, which a few pushes do not change. The score of a hypothesis is the sum
of log(spread without the fault / spread with the fault) over all columns. The fault with the highest score is a finding
if its score is high enough; the search is then repeated with the log explained by this fault.

A cause that is not among the hypotheses, such as a payload, also lowers the errors of the hypothesis nearest to it.
Therefore, the excess is compared: the sum of log(spread / spread that the log's noise causes) over all columns. A fault
that leaves more than two thirds of the excess is not a finding; the finding is that no known fault explains the log.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from wheelleg_exp.errors import RunDirectoryError
from wheelleg_exp.jobs.export.bundle.runner import HELD, LATE, OK, Policy, array, projected_gravity
from wheelleg_exp.jobs.export.export_bundle import BUNDLE, export
from wheelleg_exp.jobs.saved_robot import saved_mjcf
from wheelleg_exp.robot_logs.log_faults import Fault, possible_faults
from wheelleg_exp.robot_logs.log_simulation import LogSimulation, Sensing, channels
from wheelleg_exp.robot_logs.robot_log import TARGETS, LogError, Numbers, RobotLog, columns_of, noise_of, read_log
from wheelleg_exp.run.run_config import load_params, on_reference_engine, upgrade_env_params
from wheelleg_exp.run.run_directory import RunDirectory
from wheelleg_exp.sim.rotation import quat_to_matrix

_READINGS = ("joint_pos", "joint_vel", "base_ang_vel", "projected_gravity")
_SMALLEST = dict(zip(_READINGS, (2e-4, 5e-3, 3e-3, 5e-4), strict=True))  # Smaller spreads of errors do not count.
_SMALLEST_SHARE = 0.02  # of a column's motion in 0.1 s
# The largest ordinary noise (standard deviation) is the noise that velocity tasks of mjlab and Isaac Lab train with.
_NOISE = dict(zip(_READINGS, (0.006, 0.9, 0.12, 0.03), strict=True))
_NOISE_RATIO, _NOISE_SHARE = 5.0, 0.25
_LEAST_SCORE, _LEAST_SCORE_OF_OFFSETS, _CERTAIN = 0.8, 0.2, 0.8
_ORDINARY, _LEAST_EXCESS, _LEAST_SHARE, _UNEXPLAINED = 1.3, 0.5, 0.33, 3.0
_FEW, _MANY, _LEAST_WINDOWS, _ROUNDS, _ENVS = 60, 240, 10, 4, 128
_LEAST_RATE, _SIMULATED_RATES = 0.005, 0.25  # shares of the control step
_POLICY_TOLERANCE, _SMALLEST_TARGET = 0.02, 1e-3
_ROUNDING, _SAME_ACTION = 2e-6, 0.05
_HELD_ROWS, _FROZEN_ROWS, _HELD_SHARE, _HELD_JUMP = 3, 30, 0.01, 5.0


@dataclass(frozen=True)
class LogFinding:
    """One difference between the log and the policy or the simulation."""

    kind: str
    columns: tuple[str, ...]
    wrong: str
    evidence: str
    change: str
    value: float | None = None


@dataclass(frozen=True)
class LogReport:
    """The result of a comparison: findings, questions that the log cannot answer, and predicted readings for plots.

    ``time`` (R,), ``logged``, ``simulated`` and ``corrected`` (R, C) contain the rows of all simulated windows; the
    simulation starts from the log's readings, or from the readings as the findings correct them.
    """

    rows: int
    windows: int
    findings: list[LogFinding]
    undecided: list[str]
    columns: list[str]
    time: Numbers
    logged: Numbers
    simulated: Numbers
    corrected: Numbers
    policy_difference: float

    def document(self) -> dict[str, object]:
        """Return the report without the predicted readings, as a JSON document."""
        facts = {"rows": self.rows, "windows": self.windows, "policy_difference": self.policy_difference}
        findings = [{**vars(finding), "columns": list(finding.columns)} for finding in self.findings]
        return {**facts, "findings": findings, "cannot_tell": self.undecided}


def compare_with_run(path: Path, run: RunDirectory) -> LogReport:
    """Compare a log with a run: with the policy of its bundle or else of its last checkpoint, and with its robot."""
    log, params = read_log(path), on_reference_engine(upgrade_env_params(load_params(run.path)[0]))
    with tempfile.TemporaryDirectory(prefix="wheelleg-log-") as temporary:
        folder = run.exported / BUNDLE
        if not (folder / "policy.json").is_file():
            folder = export(run, None, Path(temporary) / BUNDLE, ()).folder
        return compare_log(log, folder, params, saved_mjcf(run))


def compare_log(log: RobotLog, bundle: Path, params: Mapping[str, object], mjcf: Path) -> LogReport:
    """Compare a log with the policy in the folder ``bundle``, and with the robot of the ``env`` config ``params``."""
    try:
        policy = Policy(bundle)
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise RunDirectoryError(f"the bundle cannot be read: {error}", key=str(bundle)) from error
    log, findings = with_imu(log, policy.spec["imus"], policy.spec["step_dt"])
    names = policy.spec["joint_names"]
    columns = channels(names)
    logged = log.table(columns)
    findings = [*clock_findings(log, policy.spec["step_dt"]), *findings]
    findings += [*held_findings(log, columns), *noise_findings(log, columns)]
    unchecked = [] if log.is_checked else ["whether the file is damaged, because it contains no checksums"]
    if any(finding.kind in ("time", "stale") for finding in findings):
        # A simulation from readings of the wrong time would blame the wrong column.
        difference, _ = replay_difference(log, policy, logged)
        empty = np.empty((0, len(columns)))
        undecided = [*unchecked, "whether the readings fit the simulation, before the findings are repaired"]
        return LogReport(len(log), 0, findings, undecided, columns, empty[:, 0], empty, empty, empty, difference)
    simulation = LogSimulation(params, mjcf, _ENVS, log.step_dt)
    search = _Search(log, simulation, columns)
    groups = [list(group.joint_names) for group in simulation.robot.actuators.values()]
    # A noisy column would make a wrong scale, offset, or gain look better, because noise is not predictable.
    noisy = {finding.columns[0].split(".")[1] for finding in findings if finding.kind == "noise"}
    possible = [
        fault
        for fault in possible_faults(names, policy.spec["rolling_joints"], groups)
        if not (fault.is_fitted and noisy.intersection(column.split(".")[1] for column in fault.columns))
    ]
    found = search.faults(possible)
    true = search.accepted.true_values(logged, np.arange(len(log)))[0]
    difference, worst = replay_difference(log, policy, logged)
    corrected = replay_difference(log, policy, true)[0] if found else difference
    repaired = difference > _POLICY_TOLERANCE >= corrected
    note = "; the policy's targets for the corrected readings are the sent targets" if repaired else ""
    findings += [replace(finding, evidence=finding.evidence + note) for finding in found] + search.unexplained
    is_read_wrong = any(finding.kind not in ("gain", "rate", "model") for finding in findings)
    if not difference <= _POLICY_TOLERANCE and not repaired and is_read_wrong:
        # Histories and integrals of the policy amplify the errors that remain in corrected readings.
        search.undecided.append("whether the sent targets are the policy's output, before the findings are repaired")
    elif not difference <= _POLICY_TOLERANCE and not repaired:
        wrong = "the sent targets are not the policy's output for the logged readings"
        evidence = f"{worst}: the difference is {100 * difference:.3g} % of the column's variation (RMS)"
        change = "send the targets of this run's exported policy, call reset at each start, and log what the policy got"
        findings.append(LogFinding("policy", (worst,), wrong, evidence, change, difference))
    search.undecided += unchecked
    return search.report(findings, difference)


def with_imu(
    log: RobotLog, imus: Mapping[str, Mapping[str, Sequence[float]]], step_dt: float
) -> tuple[RobotLog, list[LogFinding]]:
    """Return the log with ``base_ang_vel`` and ``projected_gravity``: from ``base_quat`` or an IMU if missing."""
    columns, findings = dict(log.columns), []
    for name, imu in imus.items():
        turn = quat_to_matrix(torch.tensor(imu["quat"], dtype=torch.float64)).numpy()
        for reading, theirs in (("base_ang_vel", "ang_vel"), ("projected_gravity", "projected_gravity")):
            source, target = columns_of(f"{name}.{theirs}", 3, ()), columns_of(reading, 3, ())
            if log.has(source) and not log.has(target):
                columns |= dict(zip(target, (log.table(source) @ turn.T).T, strict=True))
    quaternion, gravity = columns_of("base_quat", 4, ()), columns_of("projected_gravity", 3, ())
    if log.has(quaternion) and gravity[0] not in columns:
        quats, gyro = log.table(quaternion), log.table(columns_of("base_ang_vel", 3, ()))
        orders = [np.array([projected_gravity(quat) for quat in np.roll(quats, shift, axis=1)]) for shift in (0, 1)]
        # The gyroscope turns gravity by -omega x gravity; over six rows, this motion exceeds the noise.
        moved = [np.diff(g, axis=0) + np.cross(gyro, g)[1:] * step_dt for g in orders]
        errors = [
            float(np.median(np.linalg.norm(np.diff(np.cumsum(np.nan_to_num(m), axis=0)[::6], axis=0), axis=1)))
            for m in moved
        ]
        upright = [float(-np.nanmedian(g[:, 2])) for g in orders]
        exchanged = upright[1] > 0.5 and (upright[0] < 0.5 or errors[1] < 0.7 * errors[0])
        columns |= dict(zip(gravity, orders[exchanged].T.astype(np.float64), strict=True))
        if exchanged:
            evidence = f"the gravity of (x, y, z, w) points down by {upright[1]:.3f}, "
            evidence += f"that of (w, x, y, z) by {upright[0]:.3f}"
            wrong, change = "the quaternion base_quat is in the order (x, y, z, w)", "reorder base_quat to (w, x, y, z)"
            findings.append(LogFinding("order", tuple(quaternion), wrong, evidence, change))
    return replace(log, columns=columns), findings


def clock_findings(log: RobotLog, step_dt: float) -> Iterator[LogFinding]:
    """Yield a finding if the time between rows is not the control step."""
    step, back = log.step_dt, np.flatnonzero(np.diff(log.time) <= 0)
    for row in back[:1] + 1:
        evidence = f"the time {log.time[row]:.6g} of row {row} is not later than the row before"
        yield LogFinding("time", ("time",), "the log's rows are not in order", evidence, "sort the rows", float(row))
    if abs(step - step_dt) > _SIMULATED_RATES * step_dt:
        wrong = "the log's rows are not control steps"
        evidence = f"the time between rows is {step:.4g}, and the control step is {step_dt:.4g} s"
        yield LogFinding("time", ("time",), wrong, evidence, "log each step, in s", step)
    elif abs(step - step_dt) > _LEAST_RATE * step_dt:
        wrong = f"the robot's control loop runs at {1 / step:.4g} Hz, but the policy needs {1 / step_dt:.4g} Hz"
        evidence = f"the mean time between rows is {step:.5g} s, {step / step_dt:.4g} times the control step"
        change = f"call the policy every {step_dt:.5g} s, or correct the clock of the log"
        yield LogFinding("rate", ("time",), wrong, evidence, change, step_dt / step)


def held_findings(log: RobotLog, columns: Sequence[str]) -> Iterator[LogFinding]:
    """Yield a finding for each sensor that repeats its values although it moves by much more than its resolution."""
    for reading in dict.fromkeys(column.split(".")[0] for column in columns):
        parts = [column for column in columns if column.startswith(f"{reading}.")]
        sensors = [(part,) for part in parts] if reading.startswith("joint_") else [tuple(parts)]
        for sensor in sensors:
            values = log.table(sensor)  # A missing reading is not an old value.
            change = np.abs(np.diff(values[np.isfinite(values).all(axis=1)], axis=0)).max(axis=1)
            moves = np.flatnonzero(change > 0)
            ends = np.concatenate(([-1], moves, [len(change)]))
            held = np.diff(ends) - 1  # how many rows repeat the row before, between two changes of the value
            # A last value that never changes is old if it stays for much longer than every value before.
            frozen = held[-1] >= _FROZEN_ROWS and held[-1] > _HELD_JUMP * held[:-1].max(initial=0)
            jumps = np.append(change[moves], np.inf if frozen else 0.0)
            resolution = float(change[moves].min(initial=np.inf))
            stale = held[(held >= _HELD_ROWS - 1) & (jumps > _HELD_JUMP * resolution)].sum()
            if stale > _HELD_SHARE * len(change):
                wrong = f"{' '.join(sensor)} {'repeats' if len(sensor) == 1 else 'repeat'} old values"
                evidence = f"{stale} of {len(log)} rows repeat the row before, {held.max()} in succession"
                change_ = "read the sensor in each control step, and treat old values as missing"
                yield LogFinding("stale", sensor, wrong, evidence, change_, float(stale / len(change)))


def noise_findings(log: RobotLog, columns: Sequence[str]) -> Iterator[LogFinding]:
    """Yield a finding for each column with more noise than ordinary sensors, or than the other columns of its kind."""
    noise = dict(zip(columns, noise_of(log.table(columns)), strict=True))
    for column, level in noise.items():
        reading = column.split(".")[0]
        alike = float(np.median([noise[other] for other in columns if other.split(".")[0] == reading]))
        scale = np.pi * 10 if np.abs(log.columns[column]).max() > 100 else 1.0  # Degrees and rpm have larger numbers.
        exceeds = level > _NOISE_RATIO * alike and level > _NOISE_SHARE * _NOISE[reading]
        if level > 1.5 * _NOISE[reading] * scale or exceeds:
            evidence = f"its noise is {level:.3g} (standard deviation); similar columns have {alike:.3g}"
            change = "check the sensor, its wiring and its filter, or train with this noise"
            yield LogFinding("noise", (column,), f"{column} is noisy", evidence, change, float(level))


def replay_difference(log: RobotLog, policy: Policy, true: Numbers) -> tuple[float, str]:
    """Return the largest difference of the policy's targets from the sent targets, and its column.

    A column's difference is the RMS of its errors divided by its standard deviation. ``true`` (T, C) replaces the log's
    readings of joints and IMU. The policy observes the last action that was sent, because it amplifies rounding errors
    of its own. Rows with a held reading or a missed step only continue the policy's memory.
    """
    spec, channel_ids = policy.spec, {name: i for i, name in enumerate(channels(policy.spec["joint_names"]))}
    tables = {}
    for name, known in spec["readings"].items():
        names = columns_of(name, known["width"], spec["joint_names"])
        is_channel = all(column in channel_ids for column in names)
        tables[name] = true[:, [channel_ids[column] for column in names]] if is_channel else log.table(names)
        rule = spec["safety"]["readings"][name]
        if rule["check"] == "command":
            tables[name] = np.clip(tables[name], array(rule["low"], -np.inf), array(rule["high"], np.inf))
    columns = [f"target_{kind}.{name}" for kind in TARGETS for name in spec["joint_names"]]
    known = [i for i, column in enumerate(columns) if column in log.columns]
    if not known:
        raise LogError("the log has no column of sent targets", key=str(log.path), expected=columns[0])
    sent = np.stack([log.targets(kind, spec["joint_names"]) for kind in TARGETS], axis=1)
    resets = log.columns.get("reset", log.starts(spec["step_dt"])) > 0
    status, rows, found = log.columns.get("status", np.zeros(len(log))), list[int](), list[np.ndarray]()
    last: dict[str, Numbers] = {}
    for row in np.flatnonzero(np.isin(status, (OK, HELD, LATE))):
        if resets[row] or not last:
            policy.reset()
        elif policy.steps:
            policy.action = _sent_action(policy, sent[row - 1])
        # A missing reading keeps its last good value, as in ``Policy.update``.
        last = {n: np.where(np.isfinite(x[row]), x[row], last.get(n, x[row])) for n, x in tables.items()}
        try:
            targets = policy.step(last)
        except ValueError as error:
            raise LogError(f"the policy rejects row {row}: {error}", key=str(log.path)) from error
        if status[row] == OK:
            rows.append(int(row))
            found.append(np.concatenate([targets[kind] for kind in TARGETS])[known])
    if not rows:
        raise LogError("the policy ran in no row of the log", key=str(log.path), expected="rows with status 0")
    logged = log.table([columns[i] for i in known])[rows]
    errors = np.sqrt(np.mean((np.stack(found) - logged) ** 2, axis=0))
    shares = errors / np.maximum(logged.std(axis=0), _SMALLEST_TARGET)
    worst = int(np.argmax(np.nan_to_num(shares, nan=np.inf)))
    return float(shares[worst]), columns[known[worst]]


def _sent_action(policy: Policy, sent: Numbers) -> np.ndarray:
    """Return the last action (A,) that the targets ``sent`` (3, J) show.

    Return the policy's own where it differs only by rounding, or much: targets do not show a clipped action.
    """
    action: np.ndarray = policy.action.copy()
    for term in policy.spec["actions"]:
        if term["function"] == "affine" and all(term["scale"]):
            own, values = action[term["start"] : term["stop"]], sent[TARGETS.index(term["drives"]), term["joint_ids"]]
            raw = (values - np.array(term["offset"])) / np.array(term["scale"])
            share = np.abs(raw - own) / (1 + np.abs(own))
            own[:] = np.where((share > _ROUNDING) & (share < _SAME_ACTION), raw, own)
    return action


class _Search:
    """The search for the faults that explain a log; ``accepted`` is the sensing model of the faults found so far."""

    def __init__(self, log: RobotLog, simulation: LogSimulation, columns: list[str]) -> None:
        self.log, self.simulation, self.columns = log, simulation, columns
        self.accepted = Sensing.identity(1, len(columns), len(simulation.robot.joint_names))
        self.starts = simulation.windows(log, _MANY)
        if len(self.starts) < _LEAST_WINDOWS:
            message = f"the log has only {len(self.starts)} gapless pieces of 0.1 s"
            expected = f"at least {_LEAST_WINDOWS}, rows one control step apart"
            raise LogError(message, key=str(log.path), expected=expected)
        logged = log.table(columns)
        motion = (logged[self.starts + simulation.length] - logged[self.starts]).std(axis=0)
        floors = np.array([_SMALLEST[column.split(".")[0]] for column in columns])
        self.floors = np.maximum(floors, _SMALLEST_SHARE * motion)
        self.ordinary = np.maximum(self.noise_spreads(simulation.windows(log, _FEW)), self.floors)
        self.undecided: list[str] = []
        self.unexplained: list[LogFinding] = []

    def faults(self, possible: Sequence[Fault]) -> list[LogFinding]:
        """Return the findings that explain the log, one after another; update ``accepted`` and ``undecided``."""
        findings: list[LogFinding] = []
        few = self.simulation.windows(self.log, _FEW)
        for _ in range(_ROUNDS):
            scores, _ = self.scores(possible, few)
            order = np.argsort(-(scores + 0.3 * np.array([not fault.is_fitted for fault in possible])))
            best = self.fitted([possible[i] for i in order[:12]])
            score, spreads = self.scores([best], self.starts)
            least = _LEAST_SCORE_OF_OFFSETS if best.kind == "offset" else _LEAST_SCORE
            known = any((finding.kind, finding.columns) == (best.kind, best.columns) for finding in findings)
            excess = np.log(np.maximum(spreads / (_ORDINARY * self.ordinary), 1.0)).sum(axis=1)
            explains = excess[0] < _LEAST_EXCESS or excess[1] < (1 - _LEAST_SHARE) * excess[0]
            if known or score[0] < least or abs(best.value - best.neutral) < best.least or not explains:
                if not (findings and explains):
                    self.unexplained = list(self.deviations(spreads[0] / self.ordinary))
                break
            findings.append(self.finding(best, spreads))
            self.accepted = best.sensing.after(self.accepted)
        doubtful = [f for f, s in zip(possible, scores, strict=True) if abs(s) < _CERTAIN and not f.is_fitted]
        self.undecided = list(dict.fromkeys(f"whether {fault.wrong}" for fault in doubtful))
        return findings

    def fitted(self, candidates: Sequence[Fault]) -> Fault:
        """Return the candidate with the highest score in all windows, with its value fitted to the log."""
        for spread in (0.0, 0.6, 0.15):
            tried = [one for c in candidates for one in (c.nearby(spread) if spread and c.is_fitted else [c])]
            scores, _ = self.scores(tried, self.starts)
            best = tried[int(np.argmax(scores))]
            if not best.is_fitted:
                break
            candidates = [best]
        return best

    def scores(self, faults: Sequence[Fault], starts: np.ndarray) -> tuple[Numbers, Numbers]:
        """Return the scores of F faults, (F,), and the spreads of errors without and with each fault, (1 + F, C)."""
        models = [self.accepted, *(fault.sensing.after(self.accepted) for fault in faults)]
        parts = {key: np.concatenate([getattr(model, key) for model in models]) for key in vars(self.accepted)}
        errors = self.simulation.errors(self.log, Sensing(**parts), starts)
        spreads = 1.4826 * np.median(np.abs(errors), axis=(1, 2))
        spreads = np.maximum(np.nan_to_num(spreads, nan=1e9), self.floors)
        return np.log(spreads[0] / spreads[1:]).sum(axis=1), spreads

    def noise_spreads(self, starts: np.ndarray) -> Numbers:
        """Return the spreads of the errors that the log's noise causes, (C,): of readings, and of start states."""
        noise, width = noise_of(self.log.table(self.columns)), len(self.columns)
        moved = replace(Sensing.identity(width, width, self.accepted.gain.shape[1]), offset=np.diag(noise))
        change = self.simulation.errors(self.log, moved, starts)
        change -= self.simulation.errors(self.log, self.accepted, starts)
        change += np.diag(noise)[:, None, None]  # The offset moves the start state and the reading.
        spreads: Numbers = np.sqrt(noise**2 + np.median((change**2).sum(axis=0), axis=(0, 1)))
        return spreads

    def deviations(self, ratios: Numbers) -> Iterator[LogFinding]:
        """Yield a finding if a column's errors are much larger than the errors that the log's noise causes, (C,)."""
        column, ratio = self.columns[int(np.argmax(ratios))], float(ratios.max())
        if ratio > _UNEXPLAINED:
            wrong = "the robot moves unlike the simulation, and no known fault of readings or drives explains it"
            evidence = f"the simulation's error of {column} is {ratio:.3g} times the error that the log's noise causes"
            change = "compare masses, centre of mass, joint friction, wheel radius, and ground with the simulation's; "
            change += "wheelleg identify measures the motors"
            yield LogFinding("model", (column,), wrong, evidence, change, ratio)

    def finding(self, fault: Fault, spreads: Numbers) -> LogFinding:
        """Return a finding with its evidence: the column whose prediction improves most."""
        column = int(np.argmax(spreads[0] / spreads[1]))
        evidence = f"the simulation's error of {self.columns[column]} is {spreads[0, column]:.3g}"
        evidence += f" with the log as it is, and {spreads[1, column]:.3g} without the fault"
        texts = [text.format(value=fault.value) for text in (fault.wrong, fault.change)]
        return LogFinding(fault.kind, fault.columns, texts[0], evidence, texts[1], fault.value or None)

    def report(self, findings: list[LogFinding], difference: float) -> LogReport:
        none = Sensing.identity(1, len(self.columns), self.accepted.gain.shape[1])
        rows = (self.starts[:, None] + np.arange(1, self.simulation.length + 1)).ravel()
        logged = self.log.table(self.columns)[rows]
        shown = [
            logged - self.simulation.errors(self.log, model, self.starts)[0].reshape(logged.shape)
            for model in (none, self.accepted)
        ]
        facts = (len(self.log), len(self.starts), findings, self.undecided, self.columns)
        return LogReport(*facts, self.log.time[rows], logged, shown[0], shown[1], difference)
