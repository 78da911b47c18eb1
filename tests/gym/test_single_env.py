"""``gymnasium.make``: Gymnasium's own checker, spaces, seeds, and an environment that never resets itself."""

import subprocess
import sys
import warnings

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from patience import PATIENCE_S

from wheelleg_exp.errors import ConfigError
from wheelleg_exp.gym import ENV_ID, register

ONE_THREAD = ["env.sim.nthread=1"]
# The checker warns about unbounded spaces, and raw actions and observations have no bounds.
ABOUT_BOUNDS = ("A Box action space", "A Box observation space", "For Box action spaces")


def make(**options):
    options["overrides"] = [*ONE_THREAD, *options.get("overrides", [])]
    return gymnasium.make(ENV_ID, **options)


@pytest.fixture(scope="module")
def env(_cache):
    made = make()
    yield made
    made.close()


def actions(count, seed=0):
    return np.random.default_rng(seed).uniform(-0.3, 0.3, (count, 6)).astype(np.float32)


def rollout(env, seed, count=25):
    observations, _ = env.reset(seed=seed)
    found = [observations["policy"].copy()]
    for action in actions(count):
        observations, reward, *_ = env.step(action)
        found += [observations["critic"].copy(), np.array(reward)]
    return found


def same(first, second):
    return all(np.array_equal(a, b) for a, b in zip(first, second, strict=True))


def test_gymnasiums_checker_finds_nothing_but_missing_bounds(env):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        check_env(env.unwrapped)
    said = [str(w.message) for w in caught]
    assert [text for text in said if not any(known in text for known in ABOUT_BOUNDS)] == []


def test_spaces_are_float32_vectors_by_group_and_observations_are_copies_inside_them(env):
    assert {group: box.shape for group, box in env.observation_space.items()} == {"policy": (135,), "critic": (180,)}
    boxes = [*env.observation_space.values(), env.action_space]
    assert ({box.dtype for box in boxes}, env.action_space.shape) == ({np.dtype(np.float32)}, (6,))
    first, info = env.reset(seed=0)
    assert info == {}
    assert env.observation_space.contains(first)
    before = {group: value.copy() for group, value in first.items()}
    second, reward, terminated, truncated, _ = env.step(np.zeros(6, np.float32))
    assert env.observation_space.contains(second)
    assert [type(x) for x in (reward, terminated, truncated)] == [float, bool, bool]
    assert all(np.array_equal(first[group], before[group]) for group in before)


def test_the_same_seed_gives_the_same_episode_again_and_elsewhere(env):
    first = rollout(env, 5)
    assert same(first, rollout(env, 5))
    assert same(first, rollout(make(), 5))
    assert not same(first, rollout(env, 6))


def test_a_reset_without_a_seed_continues_the_random_streams(env):
    env.reset(seed=1)
    one, two = (env.reset()[0]["policy"] for _ in range(2))
    assert not np.array_equal(one, two)
    env.reset(seed=1)
    assert np.array_equal(env.reset()[0]["policy"], one)


def test_it_never_resets_by_itself():
    env = make(overrides=["env.episode_length_s=0.1"])  # 6 steps
    env.reset(seed=0)
    ended = [env.step(np.zeros(6, np.float32))[2:4] for _ in range(10)]
    assert (ended, env.unwrapped.env.episode_length_buf.tolist()) == ([(False, k >= 5) for k in range(10)], [10])
    env.reset()
    assert env.unwrapped.env.episode_length_buf.tolist() == [0]


def test_stock_and_user_tasks_and_overrides_are_composed_and_an_unknown_task_is_refused(tmp_path):
    env = make(task="stand", overrides=["env.episode_length_s=0.5", "env.observations.policy.history_length=2"])
    assert (env.unwrapped.env.max_episode_length, env.observation_space["policy"].shape) == (30, (54,))
    (tmp_path / "task").mkdir()
    text = "# @package _global_\ndefaults: [stand, _self_]\ntask: {name: mine}\nenv: {episode_length_s: 0.2}\n"
    (tmp_path / "task" / "mine.yaml").write_text(text)
    assert make(task="mine", config_dirs=[tmp_path]).unwrapped.env.max_episode_length == 12
    with pytest.raises(ConfigError) as caught:
        gymnasium.make(ENV_ID, task="stnd")
    assert (caught.value.key, caught.value.nearest) == ("task", "stand")


@pytest.mark.parametrize(
    ("override", "key"),
    [
        ("env.rewards.alive.wieght=2", "env.rewards.alive.wieght"),
        ("env.rewards.alive.weight=heavy", "env.rewards.alive.weight"),
        ("env.robot.asset=nowhere.usda", "env.robot.asset"),
        ("env.actions.leg_pos.joint_names=[nothing]", "env.actions.leg_pos.joint_names"),
        ("env.observations.policy.concatenate_terms=false", "env.observations.policy.concatenate_terms"),
    ],
)
def test_a_wrong_override_is_reported_with_its_key(override, key):
    with pytest.raises(ConfigError if "asset" not in key else Exception) as caught:
        gymnasium.make(ENV_ID, overrides=[override])
    assert (caught.value.key, override in str(caught.value.where)) == (key, True)


def test_one_override_and_one_config_folder_can_be_strings(tmp_path):
    (tmp_path / "reward").mkdir()
    (tmp_path / "reward" / "own.yaml").write_text("own: {_target_: wheelleg_exp.mdp.rewards.is_alive, weight: 3.0}\n")
    for folder in (str(tmp_path), tmp_path):
        env = gymnasium.make(ENV_ID, overrides="+reward@env.rewards=own", config_dirs=folder)
        assert env.unwrapped.env.reward_manager.get_term_cfg("own").fields["weight"] == 3.0
    with pytest.raises(ConfigError, match=r"env\.num_envs"):
        gymnasium.make(ENV_ID, overrides="env.num_envs=8")


def test_registering_again_changes_nothing_and_the_id_can_name_the_package():
    before = gymnasium.spec(ENV_ID)
    register()
    assert gymnasium.spec(ENV_ID) is before
    assert gymnasium.make(f"wheelleg_exp:{ENV_ID}", overrides=ONE_THREAD).spec.id == ENV_ID


@pytest.mark.parametrize(
    "code",
    [
        "import gymnasium, wheelleg_exp",
        "import wheelleg_exp, sys; assert 'gymnasium' not in sys.modules; import gymnasium",
        "import wheelleg_exp; from gymnasium import spaces; import gymnasium",
    ],
)
def test_importing_the_package_registers_it_and_imports_little(code):
    code += f", sys; assert '{ENV_ID}' in gymnasium.registry; assert not {{'torch', 'mujoco'}} & sys.modules.keys()"
    subprocess.run([sys.executable, "-c", code], check=True, timeout=PATIENCE_S)


def test_the_source_of_nan_is_named(env):
    env.reset(seed=0)
    *_, terminated, _, info = env.step(np.full(6, np.nan, np.float32))
    assert terminated
    assert info == {"non_finite": ["env.actions"]}
    observations, info = env.reset()
    assert all(np.isfinite(value).all() for value in observations.values())
    assert info["log"]["Episode_Reward/alive"] == 0.0  # the failed step has no reward


def test_a_reset_returns_the_log_of_the_last_episode(env):
    _, info = env.reset(seed=0)
    rewards = [env.step(action)[1] for action in actions(5)]
    _, info = env.reset()
    parts = [value for key, value in info["log"].items() if key.startswith("Episode_Reward/")]
    assert sum(parts) * 5.0 == pytest.approx(sum(rewards), rel=1e-5)  # divided by the longest episode's 5 s
    assert env.reset()[1] == {}


@pytest.mark.parametrize(("bound", "high"), [(2, [2] * 6), ([1, 2, 3, 4, 5, 6], [1, 2, 3, 4, 5, 6])])
def test_actions_can_have_bounds(bound, high):
    space = make(action_bound=bound).action_space
    assert (space.high.tolist(), space.low.tolist(), space.dtype) == (high, [-x for x in high], np.float32)


def test_actions_beyond_the_bound_are_simulated_unchanged(env):
    bounded = make(action_bound=0.1)
    assert same(rollout(bounded, 5), rollout(env, 5))


@pytest.mark.parametrize("bound", [0, -1.0, float("inf"), float("nan"), [1, 2], "wide", "2", True])
def test_an_invalid_bound_is_refused(bound):
    with pytest.raises(ConfigError, match="a number above 0, 6 such numbers, or None") as caught:
        make(action_bound=bound)
    assert caught.value.key == "action_bound"
