"""``gymnasium.make_vec``: batched spaces, seeds, logs, and modes of autoreset; test_sync_layout checks the layout."""

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, VectorEnv

from wheelleg_exp.errors import ConfigError
from wheelleg_exp.gym import ENV_ID

N = 4
ONE_THREAD = ["env.sim.nthread=1"]


def make(*overrides, num_envs=N):
    return gymnasium.make_vec(ENV_ID, num_envs=num_envs, overrides=[*ONE_THREAD, *overrides])


@pytest.fixture(scope="module")
def env(_cache):
    return make()


def actions(count):
    return np.random.default_rng(0).uniform(-1.0, 1.0, (count, N, 6)).astype(np.float32)


def test_it_is_a_vector_env_with_batched_float32_spaces(env):
    assert (type(env.unwrapped).__name__, isinstance(env, VectorEnv)) == ("WheellegVectorEnv", True)
    assert env.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
    assert (env.num_envs, *map(env.unwrapped.call, ("render_mode", "render"))) == (N, (None,) * N, (None,) * N)
    assert {g: b.shape for g, b in env.observation_space.items()} == {"policy": (N, 135), "critic": (N, 180)}
    assert {g: b.shape for g, b in env.single_observation_space.items()} == {"policy": (135,), "critic": (180,)}
    assert (env.action_space.shape, env.single_action_space.shape) == ((N, 6), (6,))
    assert env.action_space.dtype == env.observation_space["policy"].dtype == np.float32


def test_the_results_of_a_step_fit_the_spaces_and_are_copies(env):
    observations, infos = env.reset(seed=0)
    assert infos == {}
    assert env.observation_space.contains(observations)
    observations, rewards, terminated, truncated, _ = env.step(np.zeros((N, 6), np.float32))
    assert env.observation_space.contains(observations)
    assert (rewards.shape, rewards.dtype.kind) == ((N,), "f")
    assert (terminated.shape, terminated.dtype, truncated.dtype) == ((N,), np.bool_, np.bool_)
    results = [observations["policy"], rewards, terminated, truncated]
    copies = [result.copy() for result in results]
    for _ in range(40):
        env.step(np.ones((N, 6), np.float32))
    assert same(results, copies)


def test_the_first_observation_contains_nothing_of_the_last_episode(env):
    env.reset(seed=3)
    for action in actions(200):
        observations, _, terminated, _, infos = env.step(action)
        if terminated.any():
            break
    row = observations["policy"][terminated][0]
    gravity = row[15:30].reshape(5, 3)
    assert (gravity == gravity[0]).all()  # the first sample of an episode fills the history
    assert gravity[0, 2] < -0.99
    assert (row[95:125] == 0).all()  # no last action
    assert not (infos["final_obs"][terminated][0]["policy"][95:125] == 0).all()


def test_time_outs_are_truncations_and_only_resets_have_the_log_of_the_managers():
    env = make("env.episode_length_s=0.1")
    env.reset(seed=0)
    steps = [env.step(np.zeros((N, 6), np.float32)) for _ in range(12)]
    infos = [step[4] for step in steps]
    assert ["log" in info for info in infos] == [k in (5, 11) for k in range(12)]
    assert [step[3].all() for step in steps] == [k in (5, 11) for k in range(12)]
    assert not any(step[2].any() for step in steps)
    log = infos[5]["log"]
    assert log["Episode_Termination/time_out"].tolist() == [1.0] * N
    # 6 steps with the weight 5, divided by the longest episode's 0.1 s
    assert log["Episode_Reward/alive"] == pytest.approx([5.0 * 6 / 60 / 0.1] * N)


def rollout(env, seed):
    found = [env.reset(seed=seed)[0]["policy"].copy()]
    for action in actions(40):
        observations, rewards, *_ = env.step(action)
        found += [observations["critic"].copy(), rewards.copy()]
    return found


def same(first, second):
    return all(np.array_equal(a, b) for a, b in zip(first, second, strict=True))


def test_the_same_seed_gives_the_same_episodes_again_and_elsewhere(env):
    first = rollout(env, 5)
    assert same(first, rollout(env, 5))
    assert same(first, rollout(make(), 5))
    assert not same(first, rollout(env, 6))


def test_several_seeds_actions_of_another_shape_and_zero_environments_are_refused(env):
    for seed in ([], [1, 2, 3, 4]):
        with pytest.raises(ValueError, match="one seed"):
            env.reset(seed=seed)
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"expected \(4, 6\)"):
        env.step(np.zeros((N, 5), np.float32))
    with pytest.raises(ConfigError, match=r"env\.num_envs"):
        gymnasium.make_vec(ENV_ID, num_envs=0)


def test_gymnasiums_own_batching_works_too():
    env = gymnasium.make_vec(ENV_ID, num_envs=2, vectorization_mode="sync", overrides=ONE_THREAD)
    observations, _ = env.reset(seed=0)
    assert observations["policy"].shape == (2, 135)
    env.step(np.zeros((2, 6), np.float32))


def test_the_source_of_nan_is_named_for_its_environment(env):
    env.reset(seed=0)
    wrong = np.zeros((N, 6), np.float32)
    wrong[2, 1] = np.nan
    observations, rewards, terminated, _, infos = env.step(wrong)
    last = infos["final_info"]
    assert last["_non_finite"].tolist() == terminated.tolist() == [False, False, True, False]
    assert last["non_finite"].tolist() == [None, None, ["env.actions"], None]
    assert np.isfinite(rewards).all()
    assert all(np.isfinite(value).all() for value in observations.values())
    assert env.step(np.zeros((N, 6), np.float32))[4] == {}


@pytest.mark.parametrize(
    ("given", "mode"),
    [
        ("same_step", AutoresetMode.SAME_STEP),
        ("next_step", AutoresetMode.NEXT_STEP),
        ("disabled", AutoresetMode.DISABLED),
        ("NextStep", AutoresetMode.NEXT_STEP),  # SyncVectorEnv accepts the enum's value, too
        (AutoresetMode.DISABLED, AutoresetMode.DISABLED),
    ],
)
def test_the_mode_of_autoreset_is_where_wrappers_read_it(given, mode):
    env = gymnasium.make_vec(ENV_ID, num_envs=2, autoreset_mode=given, overrides=ONE_THREAD)
    assert env.metadata["autoreset_mode"] is mode
    assert env.unwrapped.autoreset_mode is mode  # TorchRL reads this attribute of SyncVectorEnv
    assert type(env.unwrapped).metadata["autoreset_mode"] is AutoresetMode.SAME_STEP  # no other env's


@pytest.mark.parametrize("mode", ["next_stp", ["next_step"]])
def test_an_unknown_mode_of_autoreset_is_refused_with_the_nearest(mode):
    with pytest.raises(ConfigError, match="same_step, next_step, disabled") as caught:
        gymnasium.make_vec(ENV_ID, num_envs=2, autoreset_mode=mode)
    assert (caught.value.key, caught.value.nearest) == ("autoreset_mode", "next_step")
