"""The bundle of a deployer: it does what the simulation recorded, runs on its own, and refuses what it cannot do."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
import pytest
import torch
import yaml
from patience import PATIENCE_S
from robot_logs.made import programs

from jobs.small import ITERATIONS, TINY, succeed, wheelleg
from wheelleg_exp.env import ManagerBasedRLEnv
from wheelleg_exp.errors import ConfigError, RunDirectoryError, SimulationFailure
from wheelleg_exp.jobs.export import bundle_check
from wheelleg_exp.jobs.export import export_bundle as job
from wheelleg_exp.jobs.export.bundle import runner
from wheelleg_exp.jobs.export.c_header import in_comment
from wheelleg_exp.jobs.export.export_bundle import as_configured, export
from wheelleg_exp.jobs.saved_robot import saved_mjcf
from wheelleg_exp.rl.checkpoint import FORMAT_VERSION
from wheelleg_exp.run.run_config import load_params
from wheelleg_exp.run.run_directory import RunDirectory

pytestmark = pytest.mark.train

ALONE = """
import sys

class Nothing:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in ("torch", "wheelleg_exp", "rsl_rl", "onnx", "tensordict"):
            raise ImportError(f"{name} is not installed here")

sys.meta_path.insert(0, Nothing())
sys.path[:] = [p for p in sys.path if p] + [sys.argv[1]]
sys.argv[:] = sys.argv[2:]
import runpy
runpy.run_path(sys.argv[0], run_name="__main__")
"""


@pytest.fixture(scope="module")
def bundle(trained, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("exported") / "bundle"
    succeed("export", trained.run.path, "-o", folder)
    return folder


def alone(folder: Path, script: str, *words: str) -> subprocess.CompletedProcess:
    """Run a file of a bundle in a process that cannot import this package or torch."""
    command = [sys.executable, "-c", ALONE, folder, folder / script, *words]
    return subprocess.run(command, cwd="/", env={}, capture_output=True, text=True, timeout=PATIENCE_S)


def spec_of(folder: Path) -> dict:
    return json.loads((folder / "policy.json").read_text())


def checked(folder: Path) -> dict:
    return dict(np.load(folder / "check.npz"))


def joined(targets: dict) -> np.ndarray:
    return np.stack([targets[name] for name in ("position", "velocity", "effort")])


def as_saved(env: ManagerBasedRLEnv) -> dict[str, Any]:
    return {"format_version": FORMAT_VERSION, "env": env.state_dict()}


def exported(run: RunDirectory, output: Path | None = None, checkpoint: Path | None = None):
    return export(run, checkpoint, output, ["wheelleg", "export"])


def test_the_runner_repeats_observations_actions_and_targets_of_recorded_episodes(bundle):
    recorded = checked(bundle)
    assert recorded["reset"].nonzero()[0].tolist()[:2] == [0, 18]  # episodes of 0.3 s
    worst = runner.check(bundle)
    assert max(worst[name] for name in ("observations", "actions", "targets")) <= 1e-6
    assert worst["actions_float32"] <= 1e-5
    assert np.abs(recorded["actions"]).max() > 1e-3


def test_the_networks_of_the_bundle_agree_and_the_run_has_the_same(bundle, trained):
    recorded, run = checked(bundle), trained.run
    for model in (bundle / "policy.onnx", run.exported / "policy.onnx"):
        (actions,) = onnxruntime.InferenceSession(model).run(None, {"obs": recorded["observations"]})
        np.testing.assert_allclose(actions, recorded["actions"], atol=1e-5)
    script = torch.jit.load(bundle / "policy.pt")
    with torch.no_grad():
        actions = script(torch.from_numpy(recorded["observations"]))
    np.testing.assert_allclose(actions.numpy(), recorded["actions"], atol=1e-5)


def test_a_runner_of_another_policy_is_reported(bundle, tmp_path):
    for name in ("policy.npz", "check.npz"):
        (tmp_path / name).write_bytes((bundle / name).read_bytes())
    for key, value in (("scale", 0.151), ("offset", 0.96)):
        spec = spec_of(bundle)
        spec["actions"][0][key][0] = value
        (tmp_path / "policy.json").write_text(json.dumps(spec))
        worst = runner.check(tmp_path)
        assert worst["targets"] > 1e-6
        assert worst["actions"] <= 1e-6


def test_an_export_whose_runner_differs_writes_nothing(trained, tmp_path, monkeypatch):
    monkeypatch.setattr(bundle_check, "TOLERANCE", -1.0)
    with pytest.raises(SimulationFailure, match="is not the trained policy"):
        exported(trained.run, tmp_path / "made" / "bundle")
    assert list((tmp_path / "made").iterdir()) == []


@pytest.mark.skipif(shutil.which("cc") is None, reason="there is no C compiler")
def test_a_header_that_differs_stops_the_export(trained, tmp_path, monkeypatch):
    made = job.c_header
    monkeypatch.setattr(job, "c_header", lambda *a: made(*a).replace("v[0] *= 0.25f", "v[0] *= 0.26f"))
    with pytest.raises(SimulationFailure, match="its c_double differ by"):
        exported(trained.run, tmp_path / "bundle")


def test_the_bundle_runs_without_torch_and_without_this_package(bundle):
    for words, count in (([], 4), (["--onnx"], 4)):
        said = alone(bundle, "runner.py", *words)
        assert (said.returncode, said.stdout.count("largest difference")) == (0, count), said.stderr
    said = alone(bundle, "simulate.py", "--seconds", "0.2", "--command", "0", "0", "0")
    assert said.returncode == 0, said.stdout + said.stderr
    assert "simulated 0.20 s at 60 Hz" in said.stdout
    assert "note:" not in said.stdout
    said = alone(bundle, "simulate.py", "--seconds", "0.2", "--command", "2", "0", "0.1")
    assert said.stdout.count("note:") == 2, "of a robot that learns to stand"
    assert "note: base_velocity is outside of its range: lin_vel_x 2, trained 0 to 0" in said.stdout
    said = alone(bundle, "simulate.py", "--seconds", "3")
    assert (said.returncode, "it fell after" in said.stdout) == (1, True)
    mistakes = {"--command 1 2": "{'base_velocity': 3}", "--command nan 0 0": "finite numbers"}
    seconds = dict.fromkeys([f"--seconds {value}" for value in ("nan", "inf", "0")], "a number of at least 0.01667")
    for words, message in (mistakes | seconds).items():
        said = alone(bundle, "simulate.py", *words.split())
        assert (said.returncode, message in said.stderr) == (2, True)
    for script in ("runner.py", "simulate.py", "chirps.py"):
        said = alone(bundle, script, "--foo")
        assert (said.returncode, "usage:" in said.stderr) == (2, True), script


def test_a_history_begins_with_the_first_readings_and_is_oldest_first(bundle):
    policy = runner.Policy(bundle)
    readings = {"base_ang_vel": [1, 2, 3], "base_quat": [1, 0, 0, 0], "commands.base_velocity": [0, 0, 0]}
    readings |= {"joint_pos": policy.spec["default_joint_pos"], "joint_vel": np.zeros(6)}
    policy.step(readings)
    np.testing.assert_allclose(policy.observation[:15], [0.25, 0.5, 0.75] * 5)
    np.testing.assert_allclose(policy.observation[15:30], [0, 0, -1] * 5)
    np.testing.assert_array_equal(policy.observation[95:125], 0)
    first = policy.action
    policy.step(readings | {"base_ang_vel": [4, 0, 0]})
    np.testing.assert_allclose(policy.observation[9:15], [0.25, 0.5, 0.75, 1, 0, 0])
    np.testing.assert_allclose(policy.observation[119:125], first)
    np.testing.assert_array_equal(policy.observation[113:119], 0)
    policy.reset()
    policy.step(readings)
    np.testing.assert_allclose(policy.action, first)


def test_targets_follow_from_actions_by_hand(bundle):
    policy = runner.Policy(bundle)
    policy.action = np.array([0.1, -0.2, 0.3, -0.4, 1.0, -20.0], np.float32)
    policy.processed = [policy.process(term, np.zeros(6)) for term in policy.spec["actions"]]
    targets = policy.targets(np.zeros(6))
    # Actions are in the order l01, l02, r01, r02, and the robot's joints in the order l01, r01, l02, r02, l03, r03.
    expected = [0.9599 + 0.015, 0.9599 + 0.045, -1.885 - 0.03, -1.885 - 0.06, 0, 0]
    np.testing.assert_allclose(targets["position"], expected, atol=1e-6)
    np.testing.assert_allclose(targets["velocity"], [0, 0, 0, 0, 5, -45], atol=1e-6)
    np.testing.assert_array_equal(targets["effort"], 0)


def test_gravity_follows_from_the_orientation():
    half = np.sqrt(0.5)
    rolled, nose_down, turned = [half, half, 0, 0], [half, 0, half, 0], [half, 0, 0, half]
    found = [runner.projected_gravity(quaternion) for quaternion in ([1, 0, 0, 0], rolled, nose_down, turned)]
    np.testing.assert_allclose(found, [[0, 0, -1], [0, -1, 0], [1, 0, 0], [0, 0, -1]], atol=1e-7)


def test_the_specification_holds_what_a_deployer_needs(bundle):
    spec = spec_of(bundle)
    assert (spec["step_dt"], spec["decimation"]) == (pytest.approx(1 / 60), 2)
    assert (spec["joint_names"], spec["stiffness"]) == (["l01", "r01", "l02", "r02", "l03", "r03"], [3, 3, 3, 3, 0, 0])
    assert (spec["damping"], spec["effort_limit"]) == (pytest.approx([0.3] * 4 + [1.0] * 2), [2, 2, 2, 2, 9, 9])
    assert spec["commands"] == {"base_velocity": {"lin_vel_x": [0, 0], "lin_vel_y": [0, 0], "ang_vel_z": [0, 0]}}
    assert [a["joint_names"] for a in spec["actions"]] == [["l01", "l02", "r01", "r02"], ["l03", "r03"]]
    assert spec["observation_width"] == 135
    assert (spec["armature"], spec["inertia"][2]) == (pytest.approx([0.05] * 6), pytest.approx(0.05 / 375, rel=0.01))
    assert spec["friction"] == spec["viscous_friction"] == [0.0] * 6
    assert spec["drive_rate"] == pytest.approx([120.0] * 6)  # kd / (2 I) is 10 Hz for wheels: each physics step
    metadata = {entry.key: entry.value for entry in onnx.load(bundle / "policy.onnx").metadata_props}
    assert (json.loads(metadata["policy.json"]), metadata["joint_names"]) == (spec, "l01,r01,l02,r02,l03,r03")
    assert metadata["observation_names"].startswith("base_ang_vel,projected_gravity,velocity_commands")
    text = (bundle / "README.md").read_text()
    assert [name for name in (*spec["readings"], *spec["joint_names"]) if f"`{name}`" not in text] == []
    assert [path.name for path in bundle.iterdir() if path.is_file() and path.name not in text] == ["README.md"]


def test_a_bundle_below_its_run_belongs_to_the_run_and_the_command_prints_its_path(run):
    document = json.loads(wheelleg("export", run.path, "--json").out)
    assert (document["folder"], document["lacks"]) == (str(run.exported / "bundle"), [])
    assert document["checkpoint"].endswith("model_2.pt")
    assert document["largest_difference"]["actions"] <= 1e-6
    said = succeed("export", run.path, "--checkpoint", "0")
    assert said.out.startswith(f"exported runs/stand/{run.id}/model_0.pt to runs/stand/{run.id}/exported/bundle-2")
    said = wheelleg("export", run.path, "--checkpoint", "7")
    assert (said.status, "no checkpoint of iteration 7" in said.err) == (2, True)
    entries = [entry for entry in run.manifest().data["additions"] if entry["kind"] == "export"]
    assert [entry["results"]["checkpoint"] for entry in entries] == ["model_2.pt", "model_0.pt"]
    assert "exported/bundle/robot/robot.xml" in entries[0]["files"]
    assert wheelleg("verify", run.path).status == 0
    (run.exported / "bundle" / "policy.json").write_text("{}")
    assert wheelleg("verify", run.path).status == 1


def test_the_bundle_and_the_command_show_the_margins_of_the_checkpoint(run):
    assert "Not measured" in (exported(run).folder / "README.md").read_text()
    sha = job.files.sha256(run.latest_checkpoint())
    for kind, delay, checkpoint in (
        ("evaluation", 0.05, sha),
        ("evaluation", 0.9, "0" * 64),
        ("reference", 0.0625, None),
    ):
        results = {"checkpoint_sha256": checkpoint, "metrics": {"robust/margin/delay": delay, "robust/survival": 1.0}}
        run.manifest().add(kind, [], results, command=["wheelleg"])
    made = exported(run)
    assert [(margin.policy, margin.reference) for margin in made.margins] == [(0.05, 0.0625)]
    assert spec_of(made.folder)["margins"] == [made.margins[0]._asdict()]
    assert "| delay of the actions | 0.05 | 0.0625 | s |" in (made.folder / "README.md").read_text()
    assert "largest survived delay of the actions: 0.05 s" in succeed("export", run.path).out


def test_a_bundle_outlives_a_resume_of_its_run_and_what_a_killed_export_left_does_not(run):
    made = exported(run)
    left = run.exported / ".bundle.0123456789ab.tmp"
    left.mkdir()
    (left / "policy.json").write_text("{}")
    succeed("resume", run.path, f"agent.max_iterations={ITERATIONS + 1}")
    assert not left.exists()
    assert (spec_of(made.folder)["run"]["iteration"], wheelleg("verify", run.path).status) == (ITERATIONS - 1, 0)


def test_a_folder_that_exists_is_left_as_it_is(trained, tmp_path):
    (tmp_path / "taken").mkdir()
    with pytest.raises(RunDirectoryError, match="is not overwritten"):
        exported(trained.run, tmp_path / "taken")
    assert list(tmp_path.glob(".*")) == []


def edited(run: RunDirectory, part: str, change) -> RunDirectory:
    path = run.params / f"{part}.yaml"
    content = yaml.safe_load(path.read_text())
    change(content)
    path.write_text(yaml.safe_dump(content, sort_keys=False))
    return run


def test_what_needs_the_simulation_is_refused_by_name(run):
    def look_at_the_world(env):
        node = {"_target_": "wheelleg_exp.mdp.observations.root_lin_vel_w"}
        env["observations"]["policy"]["terms"]["base_ang_vel"] = node

    with pytest.raises(ConfigError, match="root_lin_vel_w") as told:
        exported(edited(run, "env", look_at_the_world))
    assert told.value.key == "env.observations.policy.terms.base_ang_vel"
    assert "base_ang_vel" in told.value.expected
    assert not (run.exported / "bundle").exists()
    assert list(run.exported.glob(".*")) == []


UNKNOWN = {"class_name": "RNNModel", "distribution_cfg": {"class_name": "BetaDistribution"}, "activation": "gelu"}


@pytest.mark.parametrize(("key", "value"), UNKNOWN.items())
def test_a_network_that_the_runner_does_not_know_is_refused_by_name(run, key, value):
    with pytest.raises(ConfigError, match=r"a runner does not know") as told:
        exported(edited(run, "agent", lambda agent: agent["actor"].update({key: value})))
    assert told.value.key.startswith(f"agent.actor.{key}")


TERMS = "env.observations.policy.terms"
SENSED = "sensors/imu_ang_vel,sensors/imu_projected_gravity,sensors/imu_orientation"
MODIFIERS = "wheelleg_exp.mdp.modifiers"
FILTER = f"{{_target_: {MODIFIERS}.DigitalFilter, A: [-0.5], B: [0.3, 0.2]}}"
VARIANTS = {
    "missed_command": ["task=walk"],
    "height": ["task=height"],
    "no_history": [
        *("env.observations.policy.history_length=0", "action@env.actions=[leg_pos_delayed,wheel_vel]"),
        *("agent.actor.obs_normalization=true", "+agent.clip_actions=0.05", f"+{TERMS}.joint_vel_rel.clip=[-0.2,0.2]"),
        "env.commands.base_velocity.ranges.lin_vel_x=[-0.3,0.3]",
        f"observation@{TERMS}=[base_ang_vel,base_roll_pitch,velocity_commands,joint_pos_rel_late,joint_vel_rel,"
        f"last_action,gait_phase,base_lin_vel,joint_effort,base_height,{SENSED}]",
        *("+sensor@env.scene.sensors=imu", "env.scene.sensors.imu.offset.rot=[0.5,0.5,0.5,0.5]"),
    ],
    "by_time": [
        *("+env.observations.policy.history_order=time", "env.observations.policy.history_length=3"),
        *("env.observations.policy.enable_corruption=true", "action@env.actions=[leg_pos_ema,wheel_rel_pos]"),
        *("env.robot.actuators.wheels.stiffness=1.0", "robot=motor", "agent.actor.activation=tanh"),
        f"+{TERMS}.joint_vel_rel.modifiers=[{FILTER}, {{_target_: {MODIFIERS}.Clip, bounds: [-3.0, 3.0]}}]",
        f"+{TERMS}.base_ang_vel.modifiers=[{{_target_: {MODIFIERS}.Integrator, dt: 0.1}}]",
    ],
}


# LEAPP bundles are exported with the terms of "by_time" in each run of the tests.
FULL = {"by_time": pytest.mark.full}


@pytest.mark.parametrize("variant", [pytest.param(name, marks=FULL.get(name, ())) for name in VARIANTS])
def test_other_layouts_actions_and_networks_are_repeated_as_well(variant, tmp_path):
    words = [*TINY, "agent.max_iterations=1", "recording.enabled=false", f"run.root={tmp_path / 'runs'}"]
    succeed("train", *words, *VARIANTS[variant])
    (path,) = (tmp_path / "runs").glob("*/*")
    made = exported(RunDirectory.open(path, tmp_path))
    worst = runner.check(made.folder)
    assert max(worst[name] for name in ("observations", "actions", "targets")) <= 1e-6
    hold_c_header(made.folder, tmp_path)
    said = alone(made.folder, "simulate.py", "--seconds", "0.1")
    assert said.returncode == 0, said.stdout + said.stderr
    spec, text = spec_of(made.folder), (made.folder / "README.md").read_text()
    if variant == "no_history":
        assert np.abs(checked(made.folder)["actions"]).max() == np.float32(0.05)
        assert spec["actions"][0]["trained_with"] == {"delay_steps": [0, 2]}
        assert "action `leg_pos_delayed`: 0 to 2 physics steps of 8.333 ms late" in text
        assert "observation `joint_pos_rel_late`: 0 to 2 physics steps" in text
    elif variant == "missed_command":
        (term,) = (t for t in spec["observations"][0]["terms"] if t["name"] == "travel_error")
        assert (term["joint_names"], term["wheel_radius"]) == (["l03", "r03"], pytest.approx(0.02, rel=0.05))
        assert (term["needs"], term["signs"]) == (["joint_vel", "base_ang_vel", "commands.base_velocity"], [1.0, 1.0])
    elif variant == "height":
        (term,) = (t for t in spec["observations"][0]["terms"] if t["name"] == "height_error")
        assert [link["columns"] for link in term["links"]] == [[2, 3], [0, 1]]  # l02 and r02, then l01 and r01
        assert spec["joint_names"][:4] == ["l01", "r01", "l02", "r02"]
        errors = checked(made.folder)["observations"][:, -10:].reshape(-1, 5, 2)
        assert np.abs(errors).max(axis=(0, 1)).min() > 0.1
    else:
        assert spec["actions"][0]["alpha"] == pytest.approx([0.3] * 4)


def test_commands_have_the_ranges_that_a_curriculum_has_left_them(trained):
    params, _ = load_params(trained.run)
    env, fresh = (ManagerBasedRLEnv(as_configured(params), saved_mjcf(trained.run), 0) for _ in range(2))
    env.command_manager.get_term("base_velocity").ranges["lin_vel_x"] = [-0.5, 0.6]
    still = {"lin_vel_x": [0.0, 0.0], "lin_vel_y": [0.0, 0.0], "ang_vel_z": [0.0, 0.0]}
    assert job._ranges(fresh, as_saved(fresh)) == {"base_velocity": still}
    assert job._ranges(fresh, as_saved(env)) == {"base_velocity": still | {"lin_vel_x": [-0.5, 0.6]}}


def test_an_observation_that_a_curriculum_has_changed_is_refused(trained):
    params, _ = load_params(trained.run)
    env = ManagerBasedRLEnv(as_configured(params), saved_mjcf(trained.run), 0)
    job._require_unchanged(as_saved(env))
    env.observation_manager.terms("policy")["base_ang_vel"].term.fields["scale"] = 3.0
    with pytest.raises(ConfigError, match="the training changed its settings") as told:
        job._require_unchanged(as_saved(env))
    assert told.value.key == "env.observations.policy.terms.base_ang_vel"


def run_c_header(folder: Path, place: Path, rows: np.ndarray, *flags: str) -> np.ndarray:
    """Return status, observation, action, and targets of the C header, one row for each row of start and readings."""
    if not (place / "main").exists():
        shutil.copy(Path(__file__).with_name("policy_steps.c"), place / "main.c")
        command = ["cc", "-std=c99", *flags, f"-I{folder}", place / "main.c", "-o", place / "main", "-lm"]
        subprocess.run(command, check=True, timeout=PATIENCE_S)
    said = subprocess.run([place / "main"], input=rows.tobytes(), capture_output=True, check=True, timeout=PATIENCE_S)
    return np.frombuffer(said.stdout, np.float32).reshape(len(rows), -1)


def hold_c_header(folder: Path, place: Path) -> None:
    """Compare the C header's answers to recorded readings with the record, if there is a compiler."""
    recorded = checked(folder)
    if shutil.which("cc") is None:
        return
    names = [name for name in recorded if name.startswith("reading:")]
    assert [name.removeprefix("reading:") for name in names] == list(spec_of(folder)["readings"])
    rows = np.concatenate([recorded["reset"][:, None], *(recorded[name] for name in names)], axis=1, dtype=np.float32)
    found = run_c_header(folder, place, rows, "-pedantic", "-Wall", "-Wextra", "-Werror", "-O1")
    targets = recorded["targets"].reshape(len(rows), -1)
    wanted = np.concatenate([np.zeros((len(rows), 1)), recorded["observations"], recorded["actions"], targets], axis=1)
    assert (np.abs(found - wanted) / np.maximum(1.0, np.abs(wanted))).max() <= 1e-6


@pytest.mark.skipif(shutil.which("cc") is None, reason="there is no C compiler")
def test_the_header_in_c_does_the_same(bundle, tmp_path):
    hold_c_header(bundle, tmp_path)


@pytest.mark.parametrize("profile", ["article", "explicit", "motor"])
def test_the_simulation_of_a_bundle_moves_as_the_training_does(profile, trained, tmp_path):
    (simulate,) = programs("simulate")
    params, agent = load_params(trained.run)
    laws = {"explicit": "IdealPDActuator", "motor": "DCMotor"}
    for group in params["robot"]["actuators"].values():
        if profile in laws:
            group["_target_"] = f"wheelleg_exp.sim.actuators.{laws[profile]}"
        if profile == "motor":
            group["saturation_effort"] = 3.0
    imu = {"_target_": "wheelleg_exp.sim.sensors.Imu", "body_name": "l.*shank_link"}
    params["scene"]["sensors"]["imu"] = imu | {"offset": {"pos": [0.1, 0.0, 0.0], "rot": [0.6, 0.0, 0.8, 0.0]}}
    for quantity in ("ang_vel", "projected_gravity", "orientation"):
        node = {"_target_": f"wheelleg_exp.mdp.observations.imu_{quantity}"}
        params["observations"]["policy"]["terms"][quantity] = node
    env = ManagerBasedRLEnv(as_configured(params), saved_mjcf(trained.run), 0)
    env.autoreset = "disabled"
    job._write_robot(tmp_path / "robot", saved_mjcf(trained.run), params, env)
    spec = job.bundle_specification.specification(env, agent, {})
    robot = simulate.Robot(spec, tmp_path / "robot" / "scene.xml")
    for action in 2.0 * torch.randn(12, 1, 6, generator=torch.Generator().manual_seed(0)):
        env.step(action)
        found = env.scene.robot.targets
        parts = {"position": found.pos, "velocity": found.vel, "effort": found.effort}
        targets = {name: values[0].numpy() for name, values in parts.items()}
        for _ in range(spec["decimation"]):
            robot.drive(targets)
            simulate.mujoco.mj_step(robot.model, robot.data)
    assert spec["command_accelerations"] == {}
    spec["command_accelerations"] = {"c": [0.6, None, 3.0]}
    for step in range(1, 4):
        found = robot.approached("c", [0.025, 0.2, -9.0])
        np.testing.assert_allclose(found, [min(0.025, 0.01 * step), 0.2, -0.05 * step], rtol=1e-6)
    np.testing.assert_equal(robot.approached("other", [1.0, 2.0]), [1.0, 2.0])
    readings, data = robot.readings({}), env.scene.robot.data
    np.testing.assert_allclose(readings["joint_pos"], data.joint_pos[0], atol=2e-4)
    np.testing.assert_allclose(readings["joint_vel"], data.joint_vel[0], atol=2e-2)
    np.testing.assert_allclose(readings["base_ang_vel"], data.root_ang_vel_b[0], atol=2e-2)
    np.testing.assert_allclose(readings["base_lin_vel"], data.root_lin_vel_b[0], atol=2e-3)
    gravity = runner.projected_gravity(readings["base_quat"])
    np.testing.assert_allclose(gravity, data.projected_gravity_b[0], atol=2e-4)
    np.testing.assert_allclose(readings["joint_effort"], data.applied_torque[0], atol=5e-3)
    imu = env.scene["imu"].data
    np.testing.assert_allclose(readings["imu.ang_vel"], imu.ang_vel_b[0], atol=3e-2)
    np.testing.assert_allclose(readings["imu.projected_gravity"], imu.projected_gravity_b[0], atol=5e-4)
    np.testing.assert_allclose(readings["imu.quat"], imu.quat_w[0], atol=5e-4)
    assert np.abs(data.joint_vel[0]).max() > 1.0


def test_every_policy_of_the_bundle_was_compared(bundle):
    found = spec_of(bundle)["check"]["largest_difference"]
    networks = {"observations", "actions", "targets", "actions_float32", "onnx", "torchscript"}
    assert set(found) == networks | ({"c_double", "c_float"} if shutil.which("cc") else set())
    assert max(found.values()) <= 1e-4
    text = (bundle / "README.md").read_text()
    assert [name for name in found if f"| `{name}` |" not in text] == []


def test_a_header_that_cannot_be_compared_is_not_shipped(trained, tmp_path, monkeypatch):
    monkeypatch.setattr(bundle_check, "_COMPILERS", ("no-such-compiler",))
    made = exported(trained.run, tmp_path / "bundle")
    assert made.notes == ["policy.h, which was not compared: there is no C compiler (no-such-compiler)"]
    assert not (made.folder / "policy.h").exists()
    assert f"Not here: {made.notes[0]}." in (made.folder / "README.md").read_text()
    assert "c_float" not in made.differences


def steady(spec: dict) -> dict[str, np.ndarray]:
    """Return readings of a robot that stands still at its default pose."""
    known = {"projected_gravity": [0, 0, -1], "joint_pos": spec["default_joint_pos"]}
    return {name: np.array(known.get(name, [0.0] * r["width"]), np.float32) for name, r in spec["readings"].items()}


def by_c(folder: Path, place: Path, rows: list[dict], *flags: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the statuses (T,) and the targets (T, 3, J) of the C header for the readings of one episode."""
    given = np.stack([np.concatenate([[step == 0], *row.values()]) for step, row in enumerate(rows)]).astype(np.float32)
    found = run_c_header(folder, place, given, "-O2", *flags)
    return found[:, 0], found[:, -(3 * len(spec_of(folder)["joint_names"])) :].reshape(len(rows), 3, -1)


BROKEN = [("base_ang_vel", np.nan), ("joint_vel", np.inf), ("joint_pos", -np.inf), ("joint_vel", 3e38)]


def test_readings_that_are_missing_or_not_finite_are_refused_and_change_nothing(bundle):
    policy, clean = runner.Policy(bundle), runner.Policy(bundle)
    with pytest.raises(ValueError, match="'base_ang_vel' must be 3 numbers"):
        policy.step({"joint_pos": np.zeros(6)})
    good = steady(policy.spec)
    for name, value in [*BROKEN, ("base_ang_vel", None)]:
        bad = {k: [*list(v[:-1]), value] if k == name else v for k, v in good.items()}
        with pytest.raises(ValueError, match=r"not finite"), np.errstate(all="ignore"):
            policy.step(bad)
        np.testing.assert_array_equal(joined(policy.step(good)), joined(clean.step(good)))


@pytest.mark.parametrize("flags", [(), ("-ffast-math", "-DPOLICY_REAL=float")])
@pytest.mark.skipif(shutil.which("cc") is None, reason="there is no C compiler")
def test_the_header_rejects_readings_that_are_not_finite(flags, bundle, tmp_path):
    good = steady(spec_of(bundle))
    bad = [good | {name: np.append(good[name][:-1], value)} for name, value in BROKEN]
    statuses, targets = by_c(bundle, tmp_path, [row for one in bad for row in (one, good)], *flags)
    _, clean = by_c(bundle, tmp_path, [good] * len(bad), *flags)
    np.testing.assert_array_equal(statuses, [1, 0] * len(bad))
    np.testing.assert_array_equal(targets[0], 0.0)
    np.testing.assert_array_equal(targets[2::2], targets[1:-1:2])
    np.testing.assert_array_equal(targets[1::2], clean)


def test_the_angle_of_a_wheel_counts_from_the_reset(bundle, tmp_path):
    spec = spec_of(bundle)
    assert spec["rolling_joints"] == ["l03", "r03"]
    rows = [steady(spec) | {"joint_pos": np.array(spec["default_joint_pos"]) + 0.1 * k} for k in range(4)]
    turned = [row | {"joint_pos": row["joint_pos"] + [0, 0, 0, 0, 3.5, -100.0]} for row in rows]
    policy, other = runner.Policy(bundle), runner.Policy(bundle)
    for row, same in zip(rows, turned, strict=True):
        targets = policy.step(row)
        found = other.step(same)
        np.testing.assert_allclose(other.observation, policy.observation, atol=1e-6)
        np.testing.assert_allclose(found["velocity"], targets["velocity"], atol=1e-4)
        np.testing.assert_allclose(found["position"], targets["position"] + [0, 0, 0, 0, 3.5, -100.0], atol=1e-4)
    if shutil.which("cc"):
        (_, plain), (_, moved) = (by_c(bundle, tmp_path, given) for given in (rows, turned))
        np.testing.assert_allclose(moved[:, 1:], plain[:, 1:], atol=1e-3)
        np.testing.assert_allclose(moved[:, 0, 4:] - plain[:, 0, 4:], [[3.5, -100.0]] * 4, atol=1e-4)


def test_position_targets_stay_within_the_limits_of_the_joints(bundle):
    policy = runner.Policy(bundle)
    policy.action = np.array([1e3, -1e3, -1e3, 1e3, 0, 0], np.float32)
    for term in policy.spec["actions"]:
        term["clip"] = None
    limits = np.array(policy.spec["joint_pos_limits"][:4], float)
    position = policy.act(policy.spec["default_joint_pos"])["position"][:4]
    np.testing.assert_allclose(position, [limits[0, 1], limits[1, 0], limits[2, 0], limits[3, 1]], atol=1e-6)


def test_names_of_a_foreign_robot_cannot_leave_a_comment_of_the_header():
    assert "*" not in in_comment('*/ int x = system("id"); /*')
