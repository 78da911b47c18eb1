"""Composing: the forms of overrides that people use, Hydra's globals, and what a composed config holds."""

from __future__ import annotations

import subprocess
import sys

import pytest
import yaml
from hydra import compose as hydra_compose
from hydra import initialize_config_dir, version
from hydra.core.global_hydra import GlobalHydra
from omegaconf import OmegaConf
from omegaconf.errors import ReadonlyConfigError

from wheelleg_exp.config.composing.compose import compose


def test_the_order_of_a_list_is_the_order_of_the_terms(composed):
    observations = composed().config["env"]["observations"]
    assert list(observations["policy"]["terms"]) == ["speed", "joints"]
    assert list(observations["critic"]["terms"]) == ["joints", "speed"]


def test_an_override_of_a_leaf_keeps_its_place(composed):
    rewards = composed("env.rewards.alive.weight=4").config["env"]["rewards"]
    assert list(rewards) == ["alive", "height"]
    assert rewards["alive"]["weight"] == 4


def test_the_body_of_a_task_wins_over_the_file_of_a_term(composed):
    assert composed().config["env"]["rewards"]["height"]["weight"] == -50.0


def test_a_list_on_the_command_line_replaces_the_list_of_the_task(composed):
    terms = composed("observation@env.observations.policy.terms=[joints]").config
    assert list(terms["env"]["observations"]["policy"]["terms"]) == ["joints"]
    assert list(terms["env"]["observations"]["critic"]["terms"]) == ["joints", "speed"]


def test_a_term_can_be_appended(composed):
    assert list(composed("+reward@env.rewards=smooth").config["env"]["rewards"]) == [
        "alive",
        "height",
        "smooth",
    ]


def test_a_term_can_be_deleted(composed):
    config = composed("~env.events.push")
    assert config.config["env"]["events"] == {}
    assert config.removed_terms == ()


def test_a_term_set_to_null_is_removed_and_still_known(composed):
    config = composed("env.rewards.height=null")
    assert list(config.config["env"]["rewards"]) == ["alive"]
    assert config.removed_terms == ("env.rewards.height",)
    assert config.raw.env.rewards.height is None


def test_a_null_observation_term_is_removed_from_its_group_alone(composed):
    config = composed("env.observations.policy.terms.speed=null")
    assert list(config.config["env"]["observations"]["policy"]["terms"]) == ["joints"]
    assert config.removed_terms == ("env.observations.policy.terms.speed",)


def test_an_emptied_list_leaves_an_empty_section(composed):
    assert composed("event@env.events=[]").config["env"]["events"] == {}


def test_composing_adds_no_section_that_an_environment_is_built_without(composed):
    assert "recorders" not in composed().config["env"]
    assert composed("+env.recorders=null").config["env"]["recorders"] == {}


def test_a_section_that_no_file_mounts_is_empty(composed):
    env = composed().config["env"]
    assert env["commands"] == {}
    assert env["curriculum"] == {}


def test_a_term_can_be_written_on_the_command_line(composed):
    config = composed("+env.rewards.foo={_target_: shelf_terms.alive, weight: 2}")
    assert config.config["env"]["rewards"]["foo"] == {"_target_": "shelf_terms.alive", "weight": 2}


def test_a_mapping_is_merged_into_a_term(composed):
    config = composed("++env.rewards.height={weight: 3}")
    assert config.config["env"]["rewards"]["height"]["weight"] == 3
    assert config.config["env"]["rewards"]["height"]["target_height"] == 0.07


def test_a_robot_can_be_swapped_by_its_name(composed):
    assert composed("robot=physical").config["env"]["robot"] == {"asset": "real.usda"}


def test_interpolations_are_resolved_in_the_plain_config_and_kept_in_the_raw_one(composed):
    config = composed("task=walk", "seed=3")
    assert config.config["env"]["num_envs"] == 3
    assert OmegaConf.to_container(config.raw, resolve=False)["env"]["num_envs"] == "${seed}"


def test_another_primary_config_builds_on_the_first(composed):
    assert composed(primary="play").config["seed"] == 7


def test_a_task_of_the_user_extends_a_stock_task(composed, user):
    config = composed("task=hop", config_dirs=[user])
    assert list(config.config["env"]["rewards"]) == ["alive", "bounce"]
    assert config.config["task"]["name"] == "hop"
    assert config.asset_roots == (user.parent / "assets", user.parent)


def test_the_files_that_were_read_are_known(composed, user, stock):
    files = composed("task=hop", config_dirs=[user]).files
    assert user / "reward" / "bounce.yaml" in files
    assert stock / "task" / "stand.yaml" in files
    assert stock / "reward" / "height.yaml" not in files


def test_the_raw_config_cannot_be_changed(composed):
    with pytest.raises(ReadonlyConfigError):
        composed().raw.seed = 3


def test_composing_gives_what_hydra_gives(composed, stock):
    overrides = [
        "task=walk",
        "env.rewards.height.weight=-3",
        "~env.events.push",
        "+reward@env.rewards=smooth",
    ][:3]
    with initialize_config_dir(str(stock), version_base="1.3"):
        expected = hydra_compose("train", overrides)
    assert OmegaConf.to_container(composed(*overrides).raw) == OmegaConf.to_container(expected)


def test_composing_again_and_again_changes_nothing(composed):
    first = composed("task=walk").config
    composed("env.rewards.height.weight=1")
    assert composed("task=walk").config == first


def test_composing_leaves_hydras_globals_as_they_were(composed, stock):
    with initialize_config_dir(str(stock), version_base="1.2"):
        inside = GlobalHydra.instance().hydra
        composed()
        with pytest.raises(Exception, match="stnd"):
            composed("task=stnd")
        assert GlobalHydra.instance().hydra is inside
        assert str(version.getbase()) == "1.2"
        assert hydra_compose("train").seed == 1


def test_composing_works_without_any_hydra_around(composed):
    GlobalHydra.instance().clear()
    composed()
    assert not GlobalHydra.instance().is_initialized()


def test_hydras_three_files_say_what_was_composed(composed):
    texts = composed("task=walk", "seed=5").hydra_files()
    assert sorted(texts) == ["config.yaml", "hydra.yaml", "overrides.yaml"]
    assert yaml.safe_load(texts["overrides.yaml"]) == ["task=walk", "seed=5"]
    assert yaml.safe_load(texts["config.yaml"])["env"]["num_envs"] == "${seed}"
    assert yaml.safe_load(texts["hydra.yaml"])["hydra"]["overrides"]["task"] == ["task=walk", "seed=5"]
    assert yaml.safe_load(texts["hydra.yaml"])["hydra"]["runtime"]["choices"]["task"] == "walk"


def test_a_path_with_blanks_and_quotes_can_be_a_config_folder(composed, user):
    odd = user.parent / "it's a folder, really"
    user.rename(odd)
    assert composed("task=hop", config_dirs=[odd]).config["task"]["name"] == "hop"


def test_neither_torch_nor_mujoco_is_imported_to_compose():
    code = (
        "import sys; import wheelleg_exp.cli.main, wheelleg_exp.cli.configs.compose, wheelleg_exp.cli.list;"
        "import wheelleg_exp.config.composing.compose, wheelleg_exp.config.checking.find_mistakes;"
        "import wheelleg_exp.config.explaining.catalog;"
        "print(sorted({'torch', 'mujoco', 'rsl_rl', 'rerun', 'pxr'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_overrides_may_come_as_any_sequence(stock):
    assert compose(("seed=2",)).overrides == ["seed=2"]
