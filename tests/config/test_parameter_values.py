from pathlib import Path
from typing import Any

import pytest

from wheelleg_exp.build import prepare_asset
from wheelleg_exp.cli.main import main
from wheelleg_exp.config import schema
from wheelleg_exp.config.checking.find_mistakes import check, check_tree
from wheelleg_exp.config.composing.compose import apply_overrides, compose
from wheelleg_exp.config.explaining.catalog import library
from wheelleg_exp.env import ManagerBasedRLEnv
from wheelleg_exp.errors import ConfigError
from wheelleg_exp.rl.options import read_agent, require_agent
from wheelleg_exp.run.manifest import Manifest
from wheelleg_exp.run.run_config import write_params
from wheelleg_exp.run.run_directory import RunDirectory
from wheelleg_exp.terms.config_values import fits
from wheelleg_exp.terms.term_binding import resolve_target, signature_parameters
from wheelleg_exp.terms.term_errors import type_hints

pytestmark = pytest.mark.slow

T, S = "env.observations.policy.terms.", "env.scene.sensors.contact_forces."
NOISE = "{_target_: wheelleg_exp.mdp.noise."
MODIFIER = "{_target_: wheelleg_exp.mdp.modifiers."
TERM = "_target_: wheelleg_exp.mdp."

# The expected value that the error for each override names, and the reported key if it differs from the override's key.
WRONG: dict[str, str | tuple[str, str]] = {
    # the environment
    "env.num_envs=0": "a whole number, at least 1",
    "env.episode_length_s=0": "more than 0",
    "env.episode_length_s=inf": "a finite number",
    "seed=9223372036854775808": f"at most {2**63 - 1}",
    "env.sim.dt=0": "more than 0",
    "env.sim.gravity=[0,0]": "3 finite numbers",
    "env.sim.iterations=0": "at least 1",
    "env.sim.nthread=-2": "at least 0",
    "env.scene.terrain.static_friction=-0.1": "at least 0",
    "env.scene.terrain.restitution=1.5": "at most 1",
    f"{S}history_length=-1": "at least 0",
    f"{S}body_names=[]": "not empty",
    "+env.scene.sensors.other={name: x}": "a mapping with a _target_",
    # the robot
    "env.robot.init_state.rot=[0,0,0,0]": "not all zero",
    "env.robot.init_state.pos=[0,0,inf]": "finite",
    "env.robot.actuators.legs.stiffness=-3": "at least 0",
    "env.robot.actuators.legs.effort_limit=0": "more than 0",
    # commands and actions
    "env.commands.base_velocity.resampling_time_range=[0,0]": "more than 0",
    "env.commands.base_velocity.rel_standing_envs=2": "at most 1",
    "env.commands.base_velocity.ranges.lin_vel_x=[1,-1]": "[low, high]",
    "+env.commands.base_velocity.ranges.lin_vel_w=[0,1]": "one of lin_vel_x",
    "env.actions.leg_pos.scale=inf": "a finite number",
    "env.actions.wheel_vel.joint_names=[]": "not empty",
    # observations
    f"+{T}base_ang_vel.history_length=-1": "at least 0",
    f"{T}base_ang_vel.scale=nan": "a finite number",
    f"+{T}base_ang_vel.clip=[2,1]": "[low, high]",
    f"+{T}base_ang_vel.noise={NOISE}GaussianNoise, std: -1}}": ("at least 0", f"{T}base_ang_vel.noise.std"),
    f"+{T}joint_pos_rel.noise={NOISE}UniformNoise, n_min: 1, n_max: 0}}": (
        "at least 1", f"{T}joint_pos_rel.noise.n_max"),
    f"+{T}joint_vel_rel.noise={NOISE}ConstantNoise, bias: nan}}": ("a finite number", f"{T}joint_vel_rel.noise.bias"),
    f"+{T}last_action.noise=0.1": "a mapping with a _target_",
    f"+{T}joint_vel_rel.modifiers=[{MODIFIER}Integrator, dt: 0}}]": (
        "more than 0", f"{T}joint_vel_rel.modifiers[0].dt"),
    f"+{T}joint_pos_rel.modifiers=[{MODIFIER}DigitalFilter, A: [], B: []}}]": (
        "not empty", f"{T}joint_pos_rel.modifiers[0].B"),
    f"+{T}velocity_commands.modifiers=[{MODIFIER}Clip, bounds: [1]}}]": (
        "[low, high]", f"{T}velocity_commands.modifiers[0].bounds"),
    # events
    "env.events.push_robot.interval_range_s=[-1,1]": "at least 0",
    "+env.events.push_robot.velocity_range.rol=[0,1]": "did you mean 'roll'",
    "+env.events.reset_base.min_step_count_between_reset=-1": "at least 0",
    "env.events.reset_base.pose_range.roll=[0,inf]": "finite",
    "env.events.physics_material.num_buckets=0": "at least 1",
    "env.events.physics_material.static_friction_range=[-1,1]": "at least 0",
    # rewards, terminations, curriculum
    "env.rewards.alive.weight=inf": "a finite number",
    "env.rewards.track_ang_vel_z.std=0": "more than 0",
    "env.rewards.leg_joint_deviation.asset_cfg.joint_names=[]": "not empty",
    f"+env.terminations.tilted={{{TERM}terminations.bad_orientation, limit_angle: 4}}": (
        "at most 3.14159", "env.terminations.tilted.limit_angle"),
    f"+env.rewards.effort={{{TERM}rewards.joint_torques_l2, weight: -1, asset_cfg: {{name: robot}}}}": (
        "_target_: wheelleg_exp.managers.term_interface.SceneEntityCfg", "env.rewards.effort.asset_cfg"),
    "env.curriculum.lin_vel_z_weight.num_steps=-5": "at least 0",
    # the agent
    "agent.algorithm.gamma=5": "at most 1",
    "agent.algorithm.clip_param=0": "more than 0",
    "agent.algorithm.value_loss_coef=nan": "a finite number",
    "agent.algorithm.num_mini_batches=0": "at least 1",
    "agent.algorithm.schedule=fxied": "did you mean 'fixed'",
    "agent.actor.hidden_dims=[]": "not empty",
    "agent.critic.hidden_dims=[64,0]": "at least 1",
    "agent.actor.distribution_cfg.init_std=0": "more than 0",
    "+agent.actor.distribution_cfg.std_range=[1,1]": "low below high",
    "agent.save_interval=0": "at least 1",
    "agent.num_steps_per_env=0": "at least 1",
    "+agent.clip_actions=-1": "more than 0",
    # the recording and the run directory
    "recording.interval=0": "at least 1",
    "recording.enabled=perhaps": "true or false",
    "+run.max_patch_mb=nan": "a finite number",
}  # fmt: skip
# These values contradict other settings, so each command line has only two of the overrides.
TOGETHER = {
    "+env.events.add_base_mass.distribution=log_uniform": (
        "env.events.add_base_mass.mass_distribution_params", "[low, high], above 0"),
    "agent.algorithm.num_mini_batches=20000": ("agent.algorithm.num_mini_batches", "at most 12288"),
    "+agent.actor.distribution_cfg.init_sdt=1": ("agent.actor.distribution_cfg.init_sdt", "did you mean 'init_std'"),
    "env.events.add_base_mass.operation=scale": (
        "env.events.add_base_mass.mass_distribution_params", "[low, high], above 0"),
    "+env.events.add_base_mass.distribution=gaussian env.events.add_base_mass.mass_distribution_params=[1,-1]": (
        "env.events.add_base_mass.mass_distribution_params", "[mean, standard deviation]"),
    "env.commands.base_velocity.heading_command=true": ("env.commands.base_velocity.ranges.heading", "[low, high]"),
}  # fmt: skip


def _place(override: str) -> tuple[str, str]:
    wanted = WRONG[override]
    return (override.split("=")[0].lstrip("+"), wanted) if isinstance(wanted, str) else (wanted[1], wanted[0])


# Regular expressions cannot be keys on the command line, so these mistakes are in a file.
FILE = """\
# @package _global_
# stand, with wrong values by joint.
defaults: [stand, _self_]
task: {name: wrong}
env:
  robot:
    init_state:
      joint_pos: {".*01$": .nan}
    actuators:
      legs: {damping: {".*01$": -1.0, ".*02$": 1.0}}
  actions:
    leg_pos: {clip: {".*": [1.0, -1.0]}}
"""
IN_FILE = {
    "env.robot.init_state.joint_pos[.*01$]": (8, "a finite number"),
    "env.robot.actuators.legs.damping[.*01$]": (10, "at least 0"),
    "env.actions.leg_pos.clip[.*]": (12, "[low, high]"),
}


@pytest.fixture(scope="module")
def told() -> dict[str, str]:
    found: dict[str, str] = {}
    for batch in _batches():
        for error in check(compose(["task=stand", *batch])):
            found[str(error.where)] = found.get(str(error.where), "") + str(error)
    return found


def _batches() -> list[list[str]]:
    batches: list[dict[str, str]] = []
    for override in WRONG:
        key = override.split("=")[0]
        free = next((batch for batch in batches if key not in batch), None)
        if free is None:
            batches.append(free := {})
        free[key] = override
    return [list(batch.values()) for batch in batches]


@pytest.mark.parametrize("override", WRONG)
def test_a_wrong_value_is_reported_with_its_key_its_place_and_the_expected_value(override, told):
    key, expected = _place(override)
    message = told.get(f"override {override}", "")
    assert (message.startswith(f"{key}: "), expected in message) == (True, True), message


def test_a_wrong_value_in_a_file_is_reported_with_its_line(tmp_path):
    (tmp_path / "task").mkdir()
    (tmp_path / "task" / "wrong.yaml").write_text(FILE, encoding="utf-8")
    found = {str(error.key): error for error in check(compose(["task=wrong"], config_dirs=[tmp_path]))}
    assert found.keys() == IN_FILE.keys()
    for key, (line, expected) in IN_FILE.items():
        assert str(found[key].where).endswith(f"wrong.yaml:{line}")
        assert expected in str(found[key])


@pytest.mark.parametrize("cases", zip(list(TOGETHER)[::2], list(TOGETHER)[1::2], strict=True))
def test_values_that_contradict_other_settings_are_reported(cases):
    found = {error.key: str(error) for error in check(compose(["task=stand", *" ".join(cases).split()]))}
    assert found.keys() == {TOGETHER[words][0] for words in cases}
    assert [words for words in cases if TOGETHER[words][1] not in found[TOGETHER[words][0]]] == []


def test_train_refuses_all_wrong_values_before_it_writes_anything(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    batch, *_ = _batches()
    assert main(["check", *batch]) == 2
    checked = capsys.readouterr().err
    assert main(["train", *batch]) == 2
    assert capsys.readouterr().err == checked
    assert list(tmp_path.iterdir()) == []


def test_play_refuses_all_wrong_values_before_it_writes_anything(tmp_path, capsys):
    run = _run_without_training(tmp_path)
    files = sorted(tmp_path.rglob("*"))
    words = [word for word in _batches()[0] if word.lstrip("+").startswith(("env.", "agent."))]
    assert main(["play", str(run.path), *words]) == 2
    said = capsys.readouterr().err
    assert [word for word in words if f"  {_place(word)[0]}: " not in said] == []
    assert sorted(tmp_path.rglob("*")) == files


def _run_without_training(folder: Path) -> RunDirectory:
    config = compose(["task=stand"]).config
    run = RunDirectory.create(folder, "stand", 0)
    write_params(run.path, {"env": config["env"], "agent": config["agent"]})
    (run.path / "model_0.pt").touch()
    Manifest.begin(run.path, task="stand", seed=0, command=["wheelleg"], threads={})
    return run


@pytest.fixture(scope="module")
def stand() -> tuple[dict[str, Any], Path]:
    config = compose(["task=stand", "env.num_envs=2"]).config
    return config, prepare_asset(config).output


@pytest.mark.parametrize("override", [word for word in WRONG if word.lstrip("+").startswith("env.")])
def test_building_the_environment_refuses_a_wrong_value_with_the_same_message(override, stand):
    config, mjcf = stand
    tree = apply_overrides(config, [override])
    checked = {str(error.key): str(error) for error in check_tree(tree, schema.Experiment)}
    with pytest.raises(ConfigError) as caught:
        ManagerBasedRLEnv(tree["env"], mjcf, 0)
    assert str(caught.value) == checked[_place(override)[0]]


@pytest.mark.parametrize("override", [word for word in WRONG if word.lstrip("+").startswith("agent.")])
def test_building_the_agent_refuses_a_wrong_value_with_the_same_message(override, stand):
    tree = apply_overrides(stand[0], [override])
    checked = [str(error) for error in check_tree(tree, schema.Experiment)]
    with pytest.raises(ConfigError) as caught:
        require_agent(read_agent(tree["agent"]), 2)
    assert [str(caught.value)] == checked


def _targets() -> list[str]:
    parts = ["noise.ConstantNoise", "noise.UniformNoise", "noise.GaussianNoise", "noise.NoiseModelWithAdditiveBias"]
    parts += [f"modifiers.{name}" for name in ("Scale", "Bias", "Clip", "DigitalFilter", "Integrator")]
    sim = ["actuators.ImplicitActuator", "actuators.IdealPDActuator", "contact.ContactSensor"]
    found = [f"wheelleg_exp.mdp.{name}" for name in parts] + [f"wheelleg_exp.sim.{name}" for name in sim]
    return [*(term.target for term in library()), *found, "wheelleg_exp.managers.SceneEntityCfg"]


@pytest.mark.parametrize("target", _targets())
def test_every_parameter_has_an_annotation_that_its_default_fits(target):
    function = resolve_target(target, "test")
    hints, parameters = type_hints(function), signature_parameters(function)
    assert list(parameters) == [name for name in parameters if hints.get(name, Any) is not Any]
    given = {n: p.default for n, p in parameters.items() if p.default is not p.empty}
    assert [name for name, value in given.items() if not fits(value, hints[name])] == []
