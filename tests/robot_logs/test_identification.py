"""Motor parameters of independently simulated robots are found from chirps, or the log is refused."""

import json
from pathlib import Path

import mujoco
import numpy as np
import pytest
import yaml
from jobs.small import refused, succeed, wheelleg

from wheelleg_exp.config.composing.compose import compose
from wheelleg_exp.robot_logs import motor_identification

from .made import bundle_of, programs
from .test_robot_log import write_csv

NAMES = ("leg", "wheel")
TRUE = {"armature": (8e-4, 5e-5), "friction": (0.01, 1e-3), "viscous_friction": (2e-3, 1e-4)}
TRUE |= {"gain": (1.0, 0.9), "delay": (0.0, 0.005), "effort_scale": (1.1, 1.0)}
SPEC = {
    "step_dt": 1 / 60,
    "joint_names": NAMES,
    "default_joint_pos": [0.4, 0.0],
    "joint_pos_limits": [[-2.0, 2.0], [None, None]],
    "actuators": [{"joint_ids": [0, 1]}],
    "stiffness": [3.0, 0.0],
    "damping": [0.05, 0.01],
    "effort_limit": [1.0, 0.1],
    "velocity_limit": [30.0, 45.0],
    "armature": [5e-4, 1e-4],
    "inertia": [1.2e-3, 2.3e-5],
}
ROBOT = """# @package env.robot
profile: one_leg
asset: one_leg.urdf
base: floating
init_state: {pos: [0, 0, 1], rot: [1, 0, 0, 0], joint_pos: {leg: 0.4, wheel: 0.0}, joint_vel: {".*": 0.0}}
joint_order: null
soft_joint_pos_limit_factor: 1.0
friction_source: static
actuators:
  legs: &drive {_target_: wheelleg_exp.sim.actuators.ImplicitActuator, joint_names_expr: [leg], stiffness: 3.0,
    damping: 0.05, effort_limit: 1.0, velocity_limit: 30.0, armature: 5.0e-4}
  wheels: {<<: *drive, joint_names_expr: [wheel], stiffness: 0.0, damping: 0.01, effort_limit: 0.1, armature: 1.0e-4}
"""
URDF = """<robot name="one_leg">
<link name="base"><inertial><mass value="1"/><inertia ixx=".01" iyy=".01" izz=".01" ixy="0" ixz="0" iyz="0"/></inertial>
</link>
<link name="shank"><inertial><origin xyz=".03 0 -.04"/><mass value=".06"/>
<inertia ixx="3e-5" iyy="3e-5" izz="3e-5" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="leg" type="revolute"><parent link="base"/><child link="shank"/><origin xyz="0 .05 0"/><axis xyz="0 1 0"/>
<limit lower="-2" upper="2" effort="1" velocity="30"/></joint>
<link name="rim"><inertial><mass value=".04"/><inertia ixx="8e-6" iyy="1.2e-5" izz="8e-6" ixy="0" ixz="0" iyz="0"/>
</inertial></link>
<joint name="wheel" type="continuous"><parent link="shank"/><child link="rim"/><origin xyz="0 .02 -.1"/>
<axis xyz="0 1 0"/></joint></robot>"""
# The same robot, with a weight of 50 g that hangs 15 mm below the axle while the leg is at 0.4 rad.
MJCF = """<mujoco><compiler angle="radian"/><option timestep="{step}"/><worldbody>
<body pos="0 .05 0"><joint name="leg" axis="0 1 0" armature="8e-4" frictionloss=".01" damping=".002"/>
<inertial pos=".03 0 -.04" mass=".06" diaginertia="3e-5 3e-5 3e-5"/>
<body pos="0 .02 -.1"><joint name="wheel" axis="0 1 0" armature="5e-5" frictionloss=".001" damping="1e-4"/>
<inertial pos="0 0 0" mass=".04" diaginertia="8e-6 1.2e-5 8e-6"/>
<body pos="{x} 0 {z}"><inertial pos="0 0 0" mass=".05" diaginertia="1e-9 1e-9 1e-9"/></body>
</body></body></worldbody></mujoco>"""


def chirp_log(path: Path, steps: int = 1, soft: float = 0.0, seconds: float = 2.5) -> Path:
    """Write the log of drives that compute torques at 1200 Hz, with ``steps`` physics steps per torque.

    With ``soft`` (N·m/rad), a spring connects the motor of the leg and the encoder in it to the leg.
    """
    (chirps,) = programs("chirps")
    chirps.SECONDS, chirps.REST = seconds, 0.6
    text = MJCF.format(step=1 / 1200 / steps, x=0.015 * np.sin(0.4), z=-0.015 * np.cos(0.4))
    model = mujoco.MjModel.from_xml_string(text)
    data, played = mujoco.MjData(model), chirps.Chirps(SPEC)
    model.dof_armature[0] *= not soft
    mujoco.mj_setConst(model, data)
    data.qpos[0] = motor = 0.4
    stiffness, damping, limit, gain, scale = map(np.array, ([3, 0], [0.05, 0.01], [1, 0.1], TRUE["gain"], [1.1, 1]))
    torque, speed, rows, sent = np.zeros(2), 0.0, [], [played.targets(step) for step in range(played.steps)]
    for step in range(played.steps):
        for tick in range(20):
            q, v = data.qpos.copy(), data.qvel.copy()
            if soft:
                q[0], v[0] = motor, speed
            if tick == 0:
                readings = {"joint_pos": q, "joint_vel": v, "joint_effort": torque * scale}
                rows.append(played.row(step / 60, {name: x.round(6) for name, x in readings.items()}, step))
            late = sent[max(step - 1, 0)] if tick < 6 else sent[step]  # The target of the wheel arrives 5 ms late.
            position, speeds = sent[step]["position"], np.array([0.0, late["velocity"][1]])
            torque = np.clip(gain * (stiffness * (position - q) + damping * (speeds - v)), -limit, limit)
            for _ in range(steps):
                data.qfrc_applied[:] = torque
                if soft:
                    spring = soft * (motor - data.qpos[0]) + 2e-3 * (speed - data.qvel[0])
                    speed += (torque[0] - spring) / 8e-4 * model.opt.timestep
                    motor += speed * model.opt.timestep
                    data.qfrc_applied[0] = spring
                mujoco.mj_step(model, data)
    return write_csv(path, {name: np.array([row[name] for row in rows]) for name in rows[0]})


@pytest.fixture
def words(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name, text in {"configs/robot/one_leg.yaml": ROBOT, "assets/one_leg.urdf": URDF}.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    options = ["--robot", "one_leg", "--config-dir", "configs", "--weight", "wheel=0.05,0.015", "--output", "mine.yaml"]
    return ["identify", "log.csv", *options, "--drive-rate", "1200", "--json"]


@pytest.mark.parametrize("steps", [pytest.param(1, marks=pytest.mark.full), 8])
def test_six_parameters_of_an_independent_robot_are_found_within_5_percent(steps, words, tmp_path):
    chirp_log(tmp_path / "log.csv", steps)
    found = json.loads(succeed(*words).out)
    of = {(one["joint"], one["name"]): one for one in found["parameters"]}
    for (joint, name), one in of.items():
        true = TRUE[name][NAMES.index(joint)] if name in TRUE else (steps - 1) / steps / 2400
        assert one["value"] == pytest.approx(true, rel=0.05, abs=5e-5 if name in ("delay", "latency") else 0), one
        assert one["low"] <= true <= one["high"], one
    before, after = found["held_out"]
    assert after < 1.5 < before
    (tmp_path / "configs" / "robot" / "mine.yaml").write_text((tmp_path / "mine.yaml").read_text())
    assert yaml.safe_load((tmp_path / "mine.yaml").read_text())["profile"] == "mine"
    drives = compose(["robot=mine"], config_dirs=[tmp_path / "configs"]).config["env"]["robot"]["actuators"]
    assert drives["legs"]["armature"]["leg"] == pytest.approx(8e-4, rel=0.05)
    assert drives["wheels"]["damping"]["wheel"] == pytest.approx(0.009, rel=0.05)
    assert drives["wheels"]["delay"] == [0, 1]


def test_a_log_that_the_model_cannot_repeat_is_refused(words, tmp_path):
    chirp_log(tmp_path / "log.csv", 8, soft=40.0, seconds=1.0)
    said = wheelleg(*words)
    assert said.status == 1, said.out
    assert "cannot repeat the log" in said.err
    assert not (tmp_path / "mine.yaml").exists()


@pytest.mark.full
@pytest.mark.slow
def test_the_simulated_chirps_of_a_bundle_give_the_parameters_of_its_robot(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "bundle").mkdir()
    bundle, _, _ = bundle_of("physical", tmp_path / "bundle")
    chirps, simulate = programs("chirps", "simulate")
    chirps.SECONDS, chirps.REST = 1.0, 0.4
    monkeypatch.setattr(motor_identification, "_MOST_EVALUATIONS", 7)
    spec = json.loads((bundle / "policy.json").read_text())
    chirps.write("log.csv", simulate.HungRobot(spec, bundle / "robot" / "scene.xml").play(chirps.Chirps(spec)))
    found = json.loads(succeed("identify", "log.csv", "--robot", "physical", "--json").out)["parameters"]
    true = {"gain": [1.0] * 6, "armature": [5e-4] * 4 + [1e-4] * 2}
    for one in (one for one in found if one["name"] in true):
        assert one["value"] == pytest.approx(true[one["name"]][spec["joint_names"].index(one["joint"])], rel=0.05), one


def test_wrong_input_is_refused(tmp_path, monkeypatch, clean):
    monkeypatch.chdir(tmp_path)
    log = write_csv(tmp_path / "log.csv", clean)
    assert "no chirps" in refused("identify", log, "--robot", "physical")
    holes = {
        name: np.where(np.arange(len(clean["time"])) == 7, np.nan, clean[name]) for name in ("projected_gravity.z",)
    }
    text = refused("identify", write_csv(tmp_path / "holes.csv", clean | holes), "--robot", "physical")
    assert "no chirps that start at rest; 'projected_gravity.z' has no number in row 7" in text
    assert "holes.csv contains no checksums" in text
    assert "--weight" in refused("identify", log, "--robot", "physical", "--weight", "l03=heavy")
    assert "--drive-rate" in refused("identify", log, "--robot", "physical", "--drive-rate", "0")
    assert "name of a profile" in refused("identify", log, "--robot", "physical", "-o", "x.txt")
    assert "physicl" in refused("identify", log, "--robot", "physicl", "--config-dir", tmp_path)
