import pytest

from wheelleg_exp.config.checking.find_mistakes import check
from wheelleg_exp.config.config_errors import raise_all
from wheelleg_exp.errors import ConfigError


@pytest.mark.parametrize(
    "overrides",
    [
        [],
        ["task=walk"],
        ["env.rewards.height=null"],
        ["event@env.events=[]"],
        ["env.episode_length_s=5", "env.rewards.height.weight=-50"],  # A float key accepts an integer.
        ["++check.silence.push_size=known"],
        ["task=hop"],  # a task of the user
    ],
)
def test_a_right_config_has_no_mistakes(composed, user, overrides):
    config = composed(*overrides, config_dirs=[user] if overrides == ["task=hop"] else [])
    assert check(config) == []


RND = "++agent.algorithm.rnd_cfg={num_outputs: 1, predictor_hidden_dims: [1], target_hidden_dims: [1]}"


@pytest.mark.parametrize(
    ("override", "key"),
    [
        (RND, "agent.obs_groups.rnd_state"),
        ("++agent.algorithm.symmetry_cfg={data_augmentation_func: 'os:system'}",
         "agent.algorithm.symmetry_cfg.data_augmentation_func"),
        ("env.rewards.alive._target_=os.system", "env.rewards.alive._target_"),
    ],
)  # fmt: skip
def test_one_mistake_is_reported_once_at_its_key(composed, override, key):
    assert [error.key for error in check(composed(override))] == [key]


def deep_class(name):
    rnd = RND.removesuffix("}") + f", weight_schedule: {{class_name: '{name}'}}}}"
    return rnd, "++agent.obs_groups.rnd_state=[policy]"


@pytest.mark.parametrize(
    ("section", "key", "said"),
    [
        ("rnd_cfg={num_output: 1}", "rnd_cfg.num_output", "did you mean 'num_outputs'"),
        ("rnd_cfg={num_outputs: 0}", "rnd_cfg.num_outputs", "at least 1"),
        ("rnd_cfg={num_outputs: 1}", "rnd_cfg.target_hidden_dims", "missing"),
        ("symmetry_cfg={use_mirror_los: true}", "symmetry_cfg.use_mirror_los", "did you mean 'use_mirror_loss'"),
        ("symmetry_cfg={use_mirror_loss: true}", "symmetry_cfg.data_augmentation_func", "missing"),
    ],
)
def test_what_rsl_rl_s_extensions_read_is_checked(composed, section, key, said):
    errors = {error.key: str(error) for error in check(composed(f"++agent.algorithm.{section}"))}
    assert said in errors[f"agent.algorithm.{key}"]


def test_classes_of_rsl_rl_and_of_allowed_packages_are_fine(composed):
    for name in ("PPO", "rsl_rl.algorithms.PPO", "rsl_rl.algorithms:PPO"):
        assert check(composed(f"agent.algorithm.class_name={name}")) == []
    for name in ("rsl_rl.utils.log_writer:LogWriter", "shelf_terms:Effort"):
        assert check(composed(*deep_class(name))) == []


@pytest.mark.parametrize(
    "name", ["rsl_rl.runners.on_policy_runner:os.system", "rsl_rl.utils.utils.importlib.import_module", "deque"]
)
def test_a_class_that_a_module_of_rsl_rl_only_imports_is_a_mistake(composed, name):
    (error,) = check(composed(*deep_class(name)))
    assert error.key == "agent.algorithm.rnd_cfg.weight_schedule.class_name"


def test_a_class_outside_the_allowed_packages_is_not_imported(composed, tmp_path):
    (tmp_path / "stranger.py").write_text("raise SystemExit('imported')\n")
    assert len(check(composed("agent.algorithm.class_name=stranger:X"))) == 1
    assert len(check(composed("env.rewards.alive._target_=stranger.X"))) == 1


def test_targets_in_lists_are_checked_against_the_allow_list(composed):
    errors = check(composed("++env.scene.sensors={a: [{_target_: os.system}]}"))
    assert [error.key for error in errors] == ["env.scene.sensors.a[0]._target_"]
    assert errors[0].where is not None


def test_several_mistakes_have_one_line_each(composed):
    with pytest.raises(ConfigError) as caught:
        raise_all(check(composed("env.num_envs=0", "env.decimation=0")))
    lines = str(caught.value).splitlines()
    assert len(lines) == 3
    assert all(line.startswith("  env.") for line in lines[1:])
