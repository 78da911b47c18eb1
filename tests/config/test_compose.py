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

from wheelleg_exp.config.tree_lookup import at

FOO = {"_target_": "shelf_terms.alive", "weight": 2}
POLICY, CRITIC = "env.observations.policy.terms", "env.observations.critic.terms"


@pytest.mark.parametrize(
    ("override", "path", "names"),
    [
        (None, POLICY, ["speed", "joints"]),
        (None, CRITIC, ["joints", "speed"]),
        (None, "env.commands", []),
        (None, "env.curriculum", []),
        ("env.rewards.alive.weight=4", "env.rewards", ["alive", "height"]),
        (f"observation@{POLICY}=[joints]", POLICY, ["joints"]),
        (f"observation@{POLICY}=[joints]", CRITIC, ["joints", "speed"]),
        ("+reward@env.rewards=smooth", "env.rewards", ["alive", "height", "smooth"]),
        ("event@env.events=[]", "env.events", []),
        ("~env.events.push", "env.events", []),
        ("+env.recorders=null", "env.recorders", []),
        ("env.rewards.height=null", "env.rewards", ["alive"]),
        (f"{POLICY}.speed=null", POLICY, ["joints"]),
    ],
)
def test_an_override_gives_a_section_these_terms_in_order(composed, override, path, names):
    config = composed(*filter(None, [override]))
    assert list(at(config.config, path)) == names
    is_null_term = str(override).endswith("=null") and not str(override).startswith("+")
    assert config.removed_terms == ((override.removesuffix("=null"),) if is_null_term else ())


@pytest.mark.parametrize(
    ("override", "path", "value"),
    [
        ("env.rewards.alive.weight=4", "env.rewards.alive.weight", 4),
        # The task's comment has priority over the comment in the term's file.
        (None, "env.rewards.height.weight", -50.0),
        (None, "env.recorders", None),
        ("+env.rewards.foo={_target_: shelf_terms.alive, weight: 2}", "env.rewards.foo", FOO),
        ("++env.rewards.height={weight: 3}", "env.rewards.height.weight", 3),
        ("++env.rewards.height={weight: 3}", "env.rewards.height.target_height", 0.07),
        ("robot=physical", "env.robot", {"asset": "real.usda"}),
    ],
)
def test_an_override_gives_a_key_this_value(composed, override, path, value):
    assert at(composed(*filter(None, [override])).config, path) == value


def test_a_null_term_stays_in_the_raw_config(composed):
    assert composed("env.rewards.height=null").raw.env.rewards.height is None


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
    overrides = ["task=walk", "env.rewards.height.weight=-3", "~env.events.push"]
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
