"""A log of a simulated robot has no findings; ten seeded faults are found and named."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from jobs.small import refused, wheelleg

from wheelleg_exp.robot_logs import log_comparison
from wheelleg_exp.robot_logs.log_comparison import clock_findings, compare_log, held_findings, noise_of, with_imu
from wheelleg_exp.robot_logs.robot_log import RobotLog

from .made import Columns, drive
from .test_robot_log import write_csv

JOINTS = ("l01", "r01", "l02", "r02", "l03", "r03")


@pytest.fixture
def few_windows(monkeypatch):
    """Rank faults and estimate noise in 8 of the 38 windows, which finds the same faults in a third of the time."""
    monkeypatch.setattr(log_comparison, "_FEW", 8)


def log_of(columns: Columns) -> RobotLog:
    return RobotLog(Path("log.csv"), columns)


def exchanged(log: Columns) -> Columns:
    names = {"joint_vel.l02": "joint_vel.l03", "joint_vel.l03": "joint_vel.l02"}
    return {name: log[names.get(name, name)] for name in log}


def changed(change: Callable, *columns: str) -> Callable[[Columns], Columns]:
    return lambda log: log | {name: change(log[name]) for name in columns}


def turned(log: Columns) -> Columns:
    found = dict(log)
    for reading in ("base_ang_vel", "projected_gravity"):
        found |= {f"{reading}.x": log[f"{reading}.y"], f"{reading}.y": -log[f"{reading}.x"]}
    return found


def stale(values: np.ndarray) -> np.ndarray:
    """Hold 5 of every 12 values between the rows 60 and 240."""
    rows = np.arange(len(values))
    return values[np.where((rows >= 60) & (rows < 240) & (rows % 12 < 5), rows - rows % 12, rows)]


SPEEDS, GYROSCOPE = [f"joint_vel.{j}" for j in JOINTS], [f"base_ang_vel.{a}" for a in "xyz"]
LATE = [*(f"joint_pos.{j}" for j in JOINTS), *SPEEDS]
NOISE = 0.5 * np.random.default_rng(0).standard_normal(300)
FAULTS = {
    "order": (exchanged, {"joint_vel.l02", "joint_vel.l03"}, None),
    "sign": (changed(np.negative, "joint_vel.r03"), {"joint_vel.r03"}, None),
    "scale": (changed(lambda v: 1.3 * v, "joint_vel.l03"), {"joint_vel.l03"}, 1.3),
    "delay": (changed(lambda v: np.concatenate((v[:1], v[:1], v[:-2])), *LATE), set(LATE), 2),
    "frame": (turned, {*GYROSCOPE, *(f"projected_gravity.{a}" for a in "xyz")}, None),
    "unit": (changed(lambda v: 30 / np.pi * v, *SPEEDS), set(SPEEDS), 9.549),
    "offset": (changed(lambda v: v + 0.05, "joint_pos.l02"), {"joint_pos.l02"}, 0.05),
    "stale": (changed(stale, *GYROSCOPE), set(GYROSCOPE), None),
    "noise": (changed(lambda v: v + NOISE, "joint_vel.r01"), {"joint_vel.r01"}, 0.5),
}


def rounded(log: Columns) -> Columns:
    return {name: np.round(column, 6) for name, column in log.items()}


def a_held_row(log: Columns) -> Columns:
    found = {name: column.copy() for name, column in log.items()}
    for name in SPEEDS:
        found[name][150] = np.nan
    return found | {"status": np.where(np.arange(len(log["time"])) == 150, 2.0, 0.0)}


@pytest.mark.slow
@pytest.mark.usefixtures("few_windows")
@pytest.mark.parametrize("change", [pytest.param(rounded, marks=pytest.mark.full), a_held_row])
def test_a_rounded_log_and_a_missing_reading_are_not_findings(stand, clean, change):
    assert compare_log(log_of(change(clean)), *stand).findings == []


RARE = {"order", "noise"}


@pytest.mark.slow
@pytest.mark.usefixtures("few_windows")
@pytest.mark.parametrize("kind", [pytest.param(k, marks=pytest.mark.full if k in RARE else ()) for k in FAULTS])
def test_a_seeded_fault_is_the_only_finding(stand, clean, kind):
    fault, columns, value = FAULTS[kind]
    report = compare_log(log_of(fault(clean)), *stand)
    (finding,) = report.findings
    assert (finding.kind, set(finding.columns)) == (kind, columns)
    assert value is None or finding.value == pytest.approx(value, rel=0.15)


@pytest.mark.slow
@pytest.mark.usefixtures("few_windows")
def test_drives_with_wrong_gains_are_found(stand):
    (finding,) = compare_log(log_of(drive(stand[0], 5.0, gain=0.75)), *stand).findings
    assert (finding.kind, finding.value) == ("gain", pytest.approx(0.75, rel=0.1))


@pytest.mark.slow
@pytest.mark.parametrize("noise", [*(pytest.param(noise, marks=pytest.mark.full) for noise in (0.0, 1.0)), 3.0])
def test_a_log_without_faults_has_no_findings(stand, noise):
    report = compare_log(log_of(drive(stand[0], 5.0, noise=noise, seed=7)), *stand)
    assert (report.findings, report.policy_difference < 1e-6) == ([], True)


def tilted(log: Columns) -> Columns:
    """Turn the IMU by 3 degrees about y."""
    cosine, sine, found = np.cos(np.pi / 60), np.sin(np.pi / 60), dict(log)
    for reading in ("base_ang_vel", "projected_gravity"):
        x, z = (log[f"{reading}.{axis}"] for axis in "xz")
        found |= {f"{reading}.x": cosine * x - sine * z, f"{reading}.z": sine * x + cosine * z}
    return found


def heavier(model) -> None:
    body = model.body("base_link").id
    model.body_mass[body] *= 1.4
    model.body_inertia[body] *= 1.4


def rubbing(model) -> None:
    """Add 3 % of the drives' largest torque as friction."""
    for name, torque in zip(JOINTS, (0.06, 0.06, 0.06, 0.06, 0.27, 0.27), strict=True):
        model.dof_frictionloss[model.joint(name).dofadr] += torque


@pytest.mark.slow
@pytest.mark.usefixtures("few_windows")
@pytest.mark.parametrize(
    ("step", "fault", "kinds"),
    [(1.003, dict, []), pytest.param(0.93, dict, ["rate"], marks=pytest.mark.full), (1.1, tilted, ["rate", "offset"])],
)
def test_the_rate_of_the_control_loop_is_named_first(stand, step, fault, kinds):
    report = compare_log(log_of(fault(drive(stand[0], 5.0, step=step))), *stand)
    assert [finding.kind for finding in report.findings] == kinds
    assert not kinds or report.findings[0].value == pytest.approx(1 / step, rel=1e-3)


@pytest.mark.slow
@pytest.mark.usefixtures("few_windows")
@pytest.mark.parametrize(
    ("fault", "kinds"), [pytest.param(dict, ["model"], marks=pytest.mark.full), (tilted, ["offset", "model"])]
)
def test_friction_that_is_not_simulated_is_not_blamed_on_a_sensor(stand, fault, kinds):
    report = compare_log(log_of(fault(drive(stand[0], 5.0, edit=rubbing))), *stand)
    assert [finding.kind for finding in report.findings] == kinds
    assert report.findings[-1].columns[0].startswith("joint_vel")


@pytest.mark.slow
@pytest.mark.usefixtures("few_windows")
def test_a_payload_is_not_blamed_on_the_imu_alone(stand):
    (finding,) = compare_log(log_of(drive(stand[0], 5.0, edit=heavier)), *stand).findings
    assert finding.columns == ("projected_gravity.x",)
    assert "centre of mass" in finding.wrong


def test_the_noise_of_a_slow_motion_is_measured():
    rng, time = np.random.default_rng(0), np.arange(2000) / 60
    values = np.stack([3 * np.sin(time) + s * rng.standard_normal(2000) for s in (0.1, 1.0)], axis=1)
    assert noise_of(values) == pytest.approx([0.1, 1.0], rel=0.1)


def test_a_coarse_encoder_at_rest_is_not_stale(clean):
    coarse = np.round(np.linspace(0.0, 0.05, 300) / 0.01) * 0.01
    assert not list(held_findings(log_of({"time": np.arange(300.0), "joint_pos.a": coarse}), ["joint_pos.a"]))
    frozen = np.where(np.arange(300) > 150, 0.3, np.random.default_rng(0).standard_normal(300))
    assert len(list(held_findings(log_of({"time": np.arange(300.0), "joint_pos.a": frozen}), ["joint_pos.a"]))) == 1


def test_rows_that_are_not_in_order_are_named_first():
    time = np.arange(300) / 60
    time[[50, 200]] = time[[200, 50]]
    first = next(clock_findings(log_of({"time": time}), 1 / 60))
    assert (first.kind, first.value) == ("time", 51)


@pytest.mark.parametrize(("shift", "findings"), [(0, 0), (-1, 1)])
def test_the_order_of_a_quaternion_is_checked(clean, shift, findings):
    gravity = np.stack([clean[f"projected_gravity.{axis}"] for axis in "xyz"], axis=1)
    pitch, roll = np.arcsin(gravity[:, 0]), np.arctan2(-gravity[:, 1], -gravity[:, 2])
    quats = [np.cos(pitch / 2) * np.cos(roll / 2), np.cos(pitch / 2) * np.sin(roll / 2)]
    quats += [np.sin(pitch / 2) * np.cos(roll / 2), -np.sin(pitch / 2) * np.sin(roll / 2)]
    columns = {name: values for name, values in clean.items() if not name.startswith("projected")}
    columns |= {f"base_quat.{p}": v for p, v in zip("wxyz", np.roll(quats, shift, axis=0), strict=True)}
    log, found = with_imu(log_of(columns), {}, 1 / 60)
    assert [finding.kind for finding in found] == ["order"] * findings
    assert log.columns["projected_gravity.x"] == pytest.approx(gravity[:, 0], abs=0.02)


@pytest.mark.train
def test_the_command_compares_plots_and_refuses(clean, trained, tmp_path):
    half = {name: column[:150] for name, column in clean.items()}
    run, log = trained.run, write_csv(tmp_path / "log.csv", half)
    said = wheelleg("inspect", log, "--against", run.path, "--plot", tmp_path / "log.png", "--json")
    document = json.loads(said.out)
    assert said.status == 1, said.err
    assert [finding["kind"] for finding in document["findings"]] == ["policy"]  # The log is of another policy.
    assert (tmp_path / "log.png").stat().st_size > 10_000
    assert "--stats" in refused("inspect", log, "--against", run.path, "--stats")
    lacking = write_csv(tmp_path / "lacking.csv", {k: v for k, v in half.items() if k != "joint_vel.l03"})
    assert "joint_vel.l03" in refused("inspect", lacking, "--against", run.path)
