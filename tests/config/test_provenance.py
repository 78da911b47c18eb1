import pytest
from omegaconf import OmegaConf
from small_tree import replayed

from wheelleg_exp.config.tree_lookup import leaves
from wheelleg_exp.terms.key_syntax import dotted

RECIPES = {
    "nothing": [],
    "child task": ["task=walk"],
    "leaf": ["env.rewards.height.weight=-30"],
    "leaf twice": ["env.rewards.height.weight=-30", "env.rewards.height.weight=-20"],
    "append": ["+reward@env.rewards=smooth"],
    "replace a list": ["reward@env.rewards=[height]"],
    "empty a list": ["event@env.events=[]"],
    "delete a term": ["~env.events.push"],
    "delete a leaf": ["~env.events.push.mode"],
    "delete and add": ["~env.rewards.alive", "+env.rewards.alive={_target_: shelf_terms.alive, weight: 9}"],
    "null": ["env.rewards.height=null"],
    "null and back": ["env.rewards.height=null", "env.rewards.height={weight: 1}"],
    "new term": ["+env.rewards.foo={_target_: shelf_terms.alive, weight: 2}"],
    "empty mapping": ["+env.rewards.foo={}", "++env.rewards.height={}"],
    "merge": ["++env.rewards.height={weight: 3, extra: {a: 1}}"],
    "list": ["env.robot.order=[c]"],
    "element of a list": ["env.robot.order.1=z"],
    "interpolation": ["env.decimation=${seed}"],
    "swap": ["robot=physical"],
    "merge beside a key with dots": ["++env.robot.joint_pos={knee: 0.3}"],
}


@pytest.mark.parametrize("name", RECIPES)
def test_the_replay_equals_the_composition(name, composed):
    config = composed(*RECIPES[name])
    assert replayed(config.provenance) == OmegaConf.to_container(config.raw, resolve=False)


def test_the_source_of_a_users_term_is_the_users_file(composed, user):
    config = composed("task=hop", config_dirs=[user])
    assert replayed(config.provenance) == OmegaConf.to_container(config.raw, resolve=False)
    assert config.provenance["env.rewards.bounce.weight"].file == user / "reward" / "bounce.yaml"


def test_a_null_hides_every_leaf_of_the_term(composed):
    source = composed("task=walk").provenance["env.rewards.alive"]
    assert source.where == "configs/task/walk.yaml:12"
    assert [s.path for s in source.shadowed] == ["env.rewards.alive._target_", "env.rewards.alive.weight"]


@pytest.mark.parametrize(
    ("path", "where"),
    [
        ("env.rewards.height", "reward/height.yaml:3"),  # The line is that of the mapping's first leaf.
        ("env.rewards.height.nothing", "reward/height.yaml:3"),
        ("env.robot.order[1]", "robot/article.yaml:6"),
        ("env.robot.joint_pos[.*_hip]", "robot/article.yaml:4"),
    ],
)
def test_the_place_of_a_key(composed, path, where):
    assert composed().provenance.where(path) == f"configs/{where}"


def test_anchors_and_merge_keys_have_the_lines_of_the_values_that_they_copy(composed, edit):
    edit("reward/alive.yaml", "base: &base\n  weight: 2.0\nalive:\n  <<: *base\n  _target_: shelf_terms.alive\n")
    config = composed()
    assert config.provenance["env.rewards.alive.weight"].line == 2
    assert replayed(config.provenance) == OmegaConf.to_container(config.raw, resolve=False)


def test_leaves_of_a_tree_are_its_scalars_lists_and_empty_mappings():
    tree = {"a": {"b": 1, "c": [1, {"d": 2}], "e": {}}, "f.g": None}
    found = {"a.b": 1, "a.c": [1, {"d": 2}], "a.e": {}, "[f.g]": None}
    assert {dotted(keys): value for keys, value in leaves(tree)} == found
