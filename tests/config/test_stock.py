from itertools import zip_longest

import pytest
import yaml
from omegaconf import OmegaConf
from small_tree import replayed

from wheelleg_exp.config import schema
from wheelleg_exp.config.checking.find_mistakes import check
from wheelleg_exp.config.composing.compose import compose
from wheelleg_exp.config.explaining import catalog
from wheelleg_exp.config.schema import Experiment
from wheelleg_exp.errors import ConfigError
from wheelleg_exp.evaluation.protocol_options import Protocol
from wheelleg_exp.jobs.pipeline.pipeline_phases import PipelineRoot
from wheelleg_exp.paths import configs_dir
from wheelleg_exp.terms.config_sections import section_errors

TASKS = sorted(path.stem for path in (configs_dir() / "task").glob("*.yaml"))


@pytest.mark.parametrize("task", TASKS)
def test_a_stock_task_has_no_mistakes_and_its_replay_equals_its_composition(task):
    composed = compose([f"task={task}"])
    assert [str(error) for error in check(composed)] == []
    assert replayed(composed.provenance) == OmegaConf.to_container(composed.raw, resolve=False)
    assert [path for path, source in composed.provenance.items() if source.line is None] == []


@pytest.mark.parametrize("task", TASKS)
def test_a_stock_task_is_one_step_above_a_base_and_sets_its_weights_and_few_silences(task):
    folder = configs_dir() / "task"
    own = yaml.safe_load((folder / f"{task}.yaml").read_text(encoding="utf-8"))
    (parent,) = [entry for entry in own["defaults"] if isinstance(entry, str) and entry != "_self_"]
    assert (folder / f"{parent}.yaml").is_relative_to(folder / "base")
    assert len(own.get("check", {}).get("silence", {})) <= 5
    composed = compose([f"task={task}"])
    weights = [composed.provenance[f"env.rewards.{name}.weight"] for name in composed.config["env"]["rewards"]]
    assert [source.where for source in weights if folder not in source.file.parents] == []


def test_a_base_of_tasks_is_not_listed_and_names_the_key_that_a_task_must_set():
    assert [entry.name for entry in catalog.options("task")] == TASKS
    for base in (configs_dir() / "task" / "base").glob("*.yaml"):
        with pytest.raises(
            ConfigError, match=r"(?s)^(?!.*training).*task\.name: this value is missing \(configs/task/base/level\.yaml"
        ):
            compose([f"task=base/{base.stem}"])


def test_stock_terms_use_the_names_and_sizes_of_the_robot_file_and_by_default_those_of_the_stock_robot(tmp_path):
    (tmp_path / "robot").mkdir()
    file = tmp_path / "robot" / "mine.yaml"
    mine = "wheel_radius: 0.1\njoint_sets: {legs: [hip]}\n"
    for text, radius, legs in (("", 0.02, [".*0[12]$"]), (mine, 0.1, ["hip"])):
        file.write_text(f"# @package env.robot\nprofile: mine\n{text}")
        rewards = compose(["task=jump", "robot=mine"], config_dirs=[tmp_path]).config["env"]["rewards"]
        assert (rewards["jump_clearance"]["rest"], rewards["jump_apex"]["rest"]) == (radius, 0.07)
        assert rewards["leg_joint_deviation"]["asset_cfg"]["joint_names"] == legs


def test_every_option_of_a_group_has_no_mistakes():
    groups = ("robot", "sim", "scene", "agent", "recording", "run")
    for words in zip_longest(*([f"{group}={option.name}" for option in catalog.options(group)] for group in groups)):
        assert check(compose([word for word in words if word])) == [], words


def test_every_stock_term_has_a_target_with_a_docstring():
    assert [entry.name for entry in catalog.terms() if not entry.help] == []


def test_the_dataclass_of_a_section_exists_and_describes_the_stock_section():
    pipeline, protocol = (compose(primary=primary).config for primary in ("pipeline", "evaluate"))
    for options, config in ((Experiment, compose().config), (Protocol, protocol["protocol"]), (PipelineRoot, pipeline)):
        assert section_errors("", config, options) == []
    assert schema.root_of(protocol).__name__ == "EvaluateRoot"


def test_the_articles_task_has_the_articles_numbers():
    """The numbers were typed from the article, not from the config files."""
    from wheelleg_exp.cli.configs.compose import shapes

    composed = compose(["task=article"])
    env, agent = composed.config["env"], composed.config["agent"]
    assert {name: term["weight"] for name, term in env["rewards"].items()} == {
        "alive": 5.0,
        "terminating": -200.0,
        "lin_vel_z": -0.05,
        "ang_vel_xy": -0.02,
        "pitch_orientation": -4.0,
        "base_height": -50.0,
        "leg_joint_deviation": -0.1,
        "leg_joint_symmetry": -0.1,
        "wheel_air": -0.5,
        "track_lin_vel_xy": 0.0,
        "track_ang_vel_z": 0.0,
    }
    assert env["rewards"]["base_height"]["target_height"] == 0.07
    assert {name: group.shape for name, group in shapes(composed).observations.items()} == {
        "policy": (27 * 5,),
        "critic": (36 * 5,),
    }
    assert (env["num_envs"], env["episode_length_s"], env["decimation"], 1 / env["sim"]["dt"]) == (512, 5.0, 2, 120.0)
    drives = {name: (group["stiffness"], group["damping"]) for name, group in env["robot"]["actuators"].items()}
    assert drives == {"legs": (3.0, 0.3), "wheels": (0.0, 1.0)}
    assert (env["actions"]["leg_pos"]["scale"], env["actions"]["wheel_vel"]["scale"]) == (0.15, 5.0)
    command = env["commands"]["base_velocity"]
    assert {tuple(command["ranges"][axis]) for axis in ("lin_vel_x", "lin_vel_y", "ang_vel_z")} == {(0.0, 0.0)}
    assert (command["resampling_time_range"], command["rel_standing_envs"]) == ([2.5, 2.5], 0.4)
    events = env["events"]
    assert events["add_base_mass"]["mass_distribution_params"] == [-0.02, 0.03]
    assert events["push_robot"]["interval_range_s"] == [5.0, 10.0]
    assert events["base_external_force_torque"]["force_range"] == [-0.2, 0.2]
    assert not env["curriculum"]
    assert agent["num_steps_per_env"] == 24
    assert agent["actor"]["hidden_dims"] == agent["critic"]["hidden_dims"] == [512, 256, 128]


def test_a_config_file_is_read_for_each_folder_and_after_each_change(tmp_path):
    file, found = tmp_path / "configs" / "observation" / "base_ang_vel.yaml", []
    file.parent.mkdir(parents=True)
    for scale in (None, 2.0, 3.0, None):
        if scale is not None:
            term = f"base_ang_vel: {{_target_: wheelleg_exp.mdp.observations.base_ang_vel, scale: {scale}}}"
            file.write_text(f"# @replaces observation/base_ang_vel\n{term}\n")
        config = compose(["task=stand"], config_dirs=[tmp_path / "configs"] if scale else []).config["env"]
        found.append({group["terms"]["base_ang_vel"]["scale"] for group in config["observations"].values()})
    assert found == [found[0], {2.0}, {3.0}, found[0]]
    assert found[0].isdisjoint({2.0, 3.0})
