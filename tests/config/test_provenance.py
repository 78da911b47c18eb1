import pytest
from omegaconf import OmegaConf
from small_tree import replayed


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
