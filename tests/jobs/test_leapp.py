"""LEAPP bundles: leapp loads them, and gives the targets of the runner in NumPy."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import onnx
import pytest
import torch
import yaml
from patience import thinned

from jobs.small import TINY, refused, succeed
from wheelleg_exp.errors import SimulationFailure
from wheelleg_exp.jobs.export import bundle_check, leapp_bundle
from wheelleg_exp.jobs.export.bundle import runner
from wheelleg_exp.jobs.export.export_bundle import export
from wheelleg_exp.run.run_directory import RunDirectory

leapp = pytest.importorskip("leapp", reason="leapp is not installed: pip install 'wheelleg_exp[leapp]'")
pytestmark = pytest.mark.train

TERMS, MODIFIERS = "env.observations.policy.terms", "wheelleg_exp.mdp.modifiers"
FILTER = f"{{_target_: {MODIFIERS}.DigitalFilter, A: [-0.5, 0.1], B: [0.3, 0.2]}}"
SMOOTH = f"{{_target_: {MODIFIERS}.DigitalFilter, A: [], B: [0.5, 0.5]}}"
OBSERVED = "base_roll_pitch,velocity_commands,joint_pos_rel,joint_vel_rel,last_action,gait_phase,base_height"
SENSED = "sensors/imu_ang_vel,sensors/imu_projected_gravity,sensors/imu_orientation"
OBSERVATIONS = "wheelleg_exp.mdp.observations"
LEGS = "{_target_: wheelleg_exp.managers.SceneEntityCfg, name: robot, joint_names: [l01, r02]}"
VARIANTS = {
    "other_observations": [
        *("robot=physical", "env.observations.policy.history_length=0", "action@env.actions=[leg_stance,wheel_drive]"),
        *(f"observation@{TERMS}=[{OBSERVED},{SENSED}]", "agent.actor.obs_normalization=true"),
        *(f"+{TERMS}.{name}._target_={OBSERVATIONS}.{name}" for name in ("current_time_s", "joint_pos_sin_cos")),
        *("+sensor@env.scene.sensors=imu", "env.scene.sensors.imu.offset.rot=[0.5,0.5,0.5,0.5]"),
        "+agent.clip_actions=0.5",
    ],
    "walk": ["task=walk"],
    "moving_average": [
        *("+env.observations.policy.history_order=time", "action@env.actions=[leg_pos_ema,wheel_rel_pos]"),
        *("env.robot.actuators.wheels.stiffness=1.0", "env.actions.leg_pos_ema.scale=20.0", "robot=motor"),
        f"+{TERMS}.joint_vel_rel.modifiers=[{FILTER}, {SMOOTH}, {{_target_: {MODIFIERS}.Scale, multiplier: 0.5}}]",
        f"+{TERMS}.base_ang_vel.modifiers=[{{_target_: {MODIFIERS}.Integrator, dt: 0.1}}]",
        *("env.actions.leg_pos_ema.clip={l01: [-0.5, 0.5]}", "agent.actor.activation=tanh"),
        f"+{TERMS}.bent={{_target_: {OBSERVATIONS}.joint_pos_limit_normalized, asset_cfg: {LEGS}}}",
        f"+{TERMS}.remaining_time_s._target_={OBSERVATIONS}.remaining_time_s",
    ],
    "height": ["task=height"],
}


def rows(spec: dict, steps: int) -> list[tuple[dict, dict]]:
    """Return random readings for the runner, and the same values for LEAPP, whose quaternions are (x, y, z, w)."""
    rng, found = np.random.default_rng(0), []
    for _ in range(steps):
        readings = {name: rng.normal(size=r["width"]).astype(np.float32) for name, r in spec["readings"].items()}
        for name in [name for name in readings if name.endswith(("quat", "projected_gravity"))]:
            sensor = name.removesuffix("projected_gravity").removesuffix("quat") or "base_"
            quat = readings.setdefault(f"{sensor}quat", rng.normal(size=4).astype(np.float32))
            readings[f"{sensor}projected_gravity".removeprefix("base_")] = runner.projected_gravity(quat)
        ports = {
            f"policy/{name.replace('.', '_')}": np.roll(x, -1 * name.endswith("quat")) for name, x in readings.items()
        }
        found.append((readings, ports))
    return found


def hold_leapp(run: RunDirectory, folder: Path) -> dict:
    """Compare a LEAPP bundle with the runner for two episodes of random readings; return LEAPP's description."""
    export(run, None, folder / "bundle", ["wheelleg"])
    made = export(run, None, folder / "leapp", ["wheelleg"], "leapp")
    policy, manager = runner.Policy(folder / "bundle"), leapp.InferenceManager(str(made.folder / "policy.yaml"))
    for step, (readings, ports) in enumerate(rows(policy.spec, 110)):
        if step in (0, 55):
            policy.reset()
            manager.reset()
        targets = policy.step(readings)
        found = manager({name: torch.from_numpy(ports[name])[None] for name in manager.inputs})
        for kind, wanted in targets.items():
            value = found.get(f"policy/target_{kind}", torch.zeros(1, len(wanted)))[0].numpy()
            assert runner.largest_difference(value, wanted) <= 1e-5, (step, kind)
        np.testing.assert_allclose(found["policy/kp"][0], policy.spec["stiffness"], rtol=1e-6)
        np.testing.assert_allclose(found["policy/kd"][0], policy.spec["damping"], rtol=1e-6)
    return yaml.safe_load((made.folder / "policy.yaml").read_text())


def test_leapp_gives_the_targets_of_the_runner_and_reads_what_the_tensors_are(trained, tmp_path):
    about = hold_leapp(trained.run, tmp_path)
    inputs, outputs = ({p["name"]: p for p in about["models"]["policy"][way]} for way in ("inputs", "outputs"))
    kinds = {kind.value for enum in (leapp.InputKindEnum, leapp.OutputKindEnum) for kind in enum}
    read = about["pipeline"]["inputs"]["policy"]
    given = {name: (inputs[name]["kind"], inputs[name]["element_names"][0]) for name in read}
    assert {kind for kind, _ in given.values()} | {p["kind"] for p in outputs.values() if "kind" in p} <= kinds
    assert given["base_quat"] == ("state/body/rotation", ["x", "y", "z", "w"])
    assert given["joint_vel"] == ("state/joint/velocity", ["l01", "r01", "l02", "r02", "l03", "r03"])
    assert given["commands_base_velocity"][1] == ["lin_vel_x", "lin_vel_y", "ang_vel_z"]
    assert outputs["target_velocity"]["kind"] == "target/joint/velocity"
    configs = about["pipeline"]["configs"]
    assert (configs["frequency"], configs["run"]["checkpoint"]) == (pytest.approx(60), "model_2.pt")
    onnx.checker.check_model(tmp_path / "leapp" / "policy.onnx")
    files = ["policy.onnx", "policy.yaml", "policy_initial_values.safetensors"]
    assert sorted(path.name for path in (tmp_path / "leapp").iterdir()) == files


@pytest.mark.parametrize("variant", thinned(VARIANTS, 2))
def test_leapp_gives_the_targets_of_the_runner_for_other_policies(variant, tmp_path):
    words = [*TINY, "agent.max_iterations=1", "recording.enabled=false", f"run.root={tmp_path / 'runs'}"]
    succeed("train", *words, *VARIANTS[variant])
    (path,) = (tmp_path / "runs").glob("*/*")
    hold_leapp(RunDirectory.open(path, tmp_path), tmp_path)


def test_the_command_writes_a_leapp_bundle_into_the_run_and_names_inputs_that_leapp_has_no_kind_for(run, monkeypatch):
    monkeypatch.delitem(leapp_bundle._KINDS, "joint_vel")
    said = succeed("export", run.path, "--format", "leapp")
    assert "it lacks a LEAPP kind for the input `joint_vel`" in said.out
    assert "give policy.yaml to the ros2_control runtime" in said.out
    (entry,) = (entry for entry in run.manifest().data["additions"] if entry["kind"] == "export")
    assert entry["results"]["folder"] == "exported/leapp"
    assert "exported/leapp/policy.yaml" in entry["files"]


def test_a_leapp_bundle_that_differs_from_the_simulation_is_not_written(run, tmp_path, monkeypatch):
    monkeypatch.setattr(bundle_check, "TOLERANCE_FLOAT32", -1.0)
    with pytest.raises(SimulationFailure, match="its leapp differ by"):
        export(run, None, tmp_path / "made", ["wheelleg"], "leapp")
    assert not (tmp_path / "made").exists()


def test_a_missing_leapp_and_an_unknown_format_are_one_message(run, monkeypatch):
    assert "--format: 'lepp' is not known; expected one of bundle, isaaclab, leapp" in refused(
        "export", run.path, "--format", "lepp"
    )
    monkeypatch.setattr("wheelleg_exp.jobs.export.export_bundle.find_spec", lambda name: None)
    said = refused("export", run.path, "--format", "leapp")
    assert said == "wheelleg: error: --format: leapp is not installed; expected pip install 'wheelleg_exp[leapp]'\n"
