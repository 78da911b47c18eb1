"""A user's file takes the place of a stock one on purpose, and never by accident."""

from __future__ import annotations

import textwrap

import pytest
import small_tree

from wheelleg_exp.config.composing.compose import compose
from wheelleg_exp.config.explaining import catalog
from wheelleg_exp.errors import ConfigError

ALIVE = "alive:\n  _target_: shelf_terms.alive\n  weight: 7.0\n"
MARKED = f"# @replaces reward/alive\n# Worth more.\n{ALIVE}"
pytestmark = pytest.mark.usefixtures("stock")


def folder(tmp_path, name="mine", **files):
    return small_tree.write(tmp_path / name / "configs", files)


def test_a_file_that_says_so_takes_the_stock_ones_place(tmp_path):
    mine = folder(tmp_path, **{"reward/alive.yaml": MARKED})
    composed = compose(config_dirs=[mine])
    assert composed.config["env"]["rewards"]["alive"]["weight"] == 7.0
    assert composed.provenance["env.rewards.alive.weight"].where == "mine/configs/reward/alive.yaml:5"
    assert list(composed.config["env"]["rewards"]) == ["alive", "height"]  # in the same place
    assert compose().config["env"]["rewards"]["alive"]["weight"] == 1.0


def test_a_file_of_the_same_name_that_does_not_is_an_error(tmp_path):
    mine = folder(tmp_path, **{"reward/alive.yaml": ALIVE})
    with pytest.raises(ConfigError, match="never read") as caught:
        compose(config_dirs=[mine])
    assert caught.value.where == "mine/configs/reward/alive.yaml"
    assert "'# @replaces reward/alive'" in str(caught.value)


def test_a_replaced_task_brings_its_own_defaults_list_and_package(tmp_path):
    text = """
        # @package _global_
        # @replaces task/stand
        # Stand, and no more.
        defaults:
          - /robot: physical
          - /agent: ppo
          - /reward@env.rewards: [smooth]
          - _self_
        task: {name: stand}
        env: {num_envs: 3}
    """
    config = compose(config_dirs=[folder(tmp_path, **{"task/stand.yaml": text})]).config
    assert config["env"]["num_envs"] == 3
    assert list(config["env"]["rewards"]) == ["smooth"]
    assert config["env"]["robot"]["asset"] == "real.usda"


def test_a_replaced_file_is_replaced_for_who_builds_on_it_too(tmp_path):
    mine = folder(
        tmp_path, **{"robot/article.yaml": "# @package env.robot\n# @replaces robot/article\nasset: new.usda\n"}
    )
    assert compose(["task=walk"], config_dirs=[mine]).config["env"]["robot"] == {"asset": "new.usda"}


def test_a_primary_config_can_be_replaced(tmp_path):
    stock = small_tree.STOCK["train.yaml"].replace("seed: 1", "seed: 5")
    mine = folder(tmp_path, **{"train.yaml": "# @replaces train\n" + textwrap.dedent(stock).lstrip()})
    assert compose(config_dirs=[mine]).config["seed"] == 5


@pytest.mark.parametrize(
    ("mark", "said"),
    [
        ("# @replaces reward/height", "can only replace a file of its own name"),
        ("# @replaces", "can only replace a file of its own name"),
        ("# @replaces reward/alive at once", "can only replace a file of its own name"),
    ],
)
def test_a_mark_names_the_file_itself(mark, said, tmp_path):
    mine = folder(tmp_path, **{"reward/alive.yaml": f"# Worth more.\n{mark}\n{ALIVE}"})
    with pytest.raises(ConfigError, match=said) as caught:
        compose(config_dirs=[mine])
    assert caught.value.where == "mine/configs/reward/alive.yaml:2"
    assert caught.value.expected == "'# @replaces reward/alive'"


def test_a_mark_without_anything_to_replace_is_an_error(tmp_path):
    """As when the stock file has been renamed since."""
    mine = folder(tmp_path, **{"reward/gone.yaml": MARKED.replace("alive", "gone")})
    with pytest.raises(ConfigError, match="no other 'reward/gone'"):
        compose(["+reward@env.rewards=gone"], config_dirs=[mine])


def test_two_files_do_not_replace_the_same_one(tmp_path):
    folders = [folder(tmp_path, name, **{"reward/alive.yaml": MARKED}) for name in ("mine", "yours")]
    with pytest.raises(ConfigError, match="both replace") as caught:
        compose(config_dirs=folders)
    assert caught.value.where == "yours/configs/reward/alive.yaml:1"


def test_one_that_replaces_does_not_let_another_hide(tmp_path):
    folders = [
        folder(tmp_path, "mine", **{"reward/alive.yaml": MARKED}),
        folder(tmp_path, "yours", **{"reward/alive.yaml": ALIVE}),
    ]
    with pytest.raises(ConfigError, match="never read") as caught:
        compose(config_dirs=folders)
    assert caught.value.where == "yours/configs/reward/alive.yaml"


def test_the_same_folder_twice_hides_nothing(tmp_path):
    mine = folder(tmp_path, **{"reward/alive.yaml": MARKED})
    assert compose(config_dirs=[mine, mine]).config["env"]["rewards"]["alive"]["weight"] == 7.0


def test_a_mark_below_the_head_is_a_comment(tmp_path):
    mine = folder(tmp_path, **{"reward/alive.yaml": f"{ALIVE}# @replaces reward/alive\n"})
    with pytest.raises(ConfigError, match="never read"):
        compose(config_dirs=[mine])


def test_lists_show_the_file_that_is_read(tmp_path):
    mine = folder(tmp_path, **{"reward/alive.yaml": MARKED})
    (alive,) = [entry for entry in catalog.options("reward", [mine]) if entry.name == "alive"]
    assert alive.file == mine / "reward" / "alive.yaml"
    assert alive.help == "Worth more."
