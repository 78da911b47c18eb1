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


def test_a_marked_file_replaces_the_stock_file_in_configs_and_lists(tmp_path):
    mine = folder(tmp_path, **{"reward/alive.yaml": MARKED})
    composed = compose(config_dirs=[mine])
    assert composed.config["env"]["rewards"]["alive"]["weight"] == 7.0
    assert composed.provenance["env.rewards.alive.weight"].where == "mine/configs/reward/alive.yaml:5"
    # The replacement does not change the order of the terms.
    assert list(composed.config["env"]["rewards"]) == ["alive", "height"]
    assert compose().config["env"]["rewards"]["alive"]["weight"] == 1.0
    # The same folder twice does not hide the file.
    assert compose(config_dirs=[mine, mine]).config["env"]["rewards"]["alive"]["weight"] == 7.0
    (alive,) = [entry for entry in catalog.options("reward", [mine]) if entry.name == "alive"]
    assert (alive.file, alive.help) == (mine / "reward" / "alive.yaml", "Worth more.")


@pytest.mark.parametrize("text", [ALIVE, f"{ALIVE}# @replaces reward/alive\n"], ids=["no mark", "a mark below"])
def test_a_file_of_the_same_name_without_a_mark_at_its_top_is_an_error(tmp_path, text):
    mine = folder(tmp_path, **{"reward/alive.yaml": text})
    with pytest.raises(ConfigError, match="never read") as caught:
        compose(config_dirs=[mine])
    assert caught.value.where == "mine/configs/reward/alive.yaml"
    assert "'# @replaces reward/alive'" in str(caught.value)


def test_a_replaced_task_has_its_own_defaults_list_and_package(tmp_path):
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
    assert (config["env"]["num_envs"], list(config["env"]["rewards"])) == (3, ["smooth"])
    assert config["env"]["robot"]["asset"] == "real.usda"


def test_a_primary_config_can_be_replaced(tmp_path):
    stock = small_tree.STOCK["train.yaml"].replace("seed: 1", "seed: 5")
    mine = folder(tmp_path, **{"train.yaml": "# @replaces train\n" + textwrap.dedent(stock).lstrip()})
    assert compose(config_dirs=[mine]).config["seed"] == 5


@pytest.mark.parametrize("mark", ["# @replaces reward/height", "# @replaces", "# @replaces reward/alive at once"])
def test_a_mark_names_the_file_itself(mark, tmp_path):
    mine = folder(tmp_path, **{"reward/alive.yaml": f"# Worth more.\n{mark}\n{ALIVE}"})
    with pytest.raises(ConfigError, match="can only replace a file of its own name") as caught:
        compose(config_dirs=[mine])
    error = caught.value
    assert (error.where, error.expected) == ("mine/configs/reward/alive.yaml:2", "'# @replaces reward/alive'")


def test_a_mark_without_anything_to_replace_is_an_error(tmp_path):
    mine = folder(tmp_path, **{"reward/gone.yaml": MARKED.replace("alive", "gone")})
    with pytest.raises(ConfigError, match="no other 'reward/gone'"):
        compose(["+reward@env.rewards=gone"], config_dirs=[mine])


@pytest.mark.parametrize(
    ("text", "said", "where"), [(MARKED, "both replace", "alive.yaml:1"), (ALIVE, "never read", "alive.yaml")]
)
def test_of_two_folders_only_one_file_can_replace_a_stock_file(tmp_path, text, said, where):
    folders = [folder(tmp_path, n, **{"reward/alive.yaml": t}) for n, t in (("mine", MARKED), ("yours", text))]
    with pytest.raises(ConfigError, match=said) as caught:
        compose(config_dirs=folders)
    assert caught.value.where == f"yours/configs/reward/{where}"
