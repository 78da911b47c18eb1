"""Gymnasium's own wrappers around both environments: they take them, and what they compute is what they should."""

import warnings

import gymnasium
import numpy as np
import pytest
from gymnasium import wrappers
from gymnasium.wrappers import vector

from wheelleg_exp.gym import ENV_ID

N = 3
OVERRIDES = ["env.sim.nthread=1", "env.episode_length_s=0.2"]  # 12 control steps
MODES = ("same_step", "next_step")


def make(**options):
    return gymnasium.make(ENV_ID, overrides=OVERRIDES, **options)


def make_vec(mode="same_step", **options):
    return gymnasium.make_vec(ENV_ID, num_envs=N, overrides=OVERRIDES, autoreset_mode=mode, **options)


def flat(env):
    return wrappers.FlattenObservation(wrappers.FilterObservation(env, ["policy"]))


def flat_vec(env):
    return vector.FlattenObservation(vector.FilterObservation(env, ["policy"]))


def ignoring_precision(make_it):
    """Call a function without the warning of Gymnasium's RescaleAction about its float64 bounds."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*precision lowered by casting to float32")
        return make_it()


def test_observations_are_filtered_flattened_and_normalized():
    env = flat(make())
    assert env.observation_space.shape == (135,)
    np.testing.assert_array_equal(env.reset(seed=0)[0], make().reset(seed=0)[0]["policy"])
    env = wrappers.NormalizeReward(wrappers.NormalizeObservation(flat(make())))
    env.reset(seed=0)
    rows = [env.step(np.zeros(6, np.float32))[0] for _ in range(12)]
    assert np.isfinite(rows).all()
    assert np.abs(rows).max() < 10


def test_episodes_are_counted_and_limited():
    env = wrappers.RecordEpisodeStatistics(wrappers.TimeLimit(make(), 5))
    env.reset(seed=0)
    steps = [env.step(np.zeros(6, np.float32)) for _ in range(5)]
    assert ([step[3] for step in steps], steps[-1][4]["episode"]["l"]) == ([False] * 4 + [True], 5)
    assert steps[-1][4]["episode"]["r"] == pytest.approx(sum(step[1] for step in steps))


@pytest.mark.parametrize("mode", MODES)
def test_the_episodes_of_a_batch_are_counted_and_a_partial_reset_restarts_its_counts(mode):
    env = vector.RecordEpisodeStatistics(make_vec(mode))
    env.reset(seed=0)
    returns = np.zeros(N)
    lengths = []
    for k in range(26):
        _, rewards, terminated, truncated, infos = env.step(np.zeros((N, 6), np.float32))
        returns += rewards
        assert ("episode" in infos) == (terminated | truncated).any()
        if "episode" in infos:
            np.testing.assert_allclose(infos["episode"]["r"], returns)
            lengths.append((k, infos["episode"]["l"].tolist()))
            returns[:] = 0
    second = 23 if mode == "same_step" else 24  # one step between episodes
    assert lengths == [(11, [12] * N), (second, [12] * N)]
    env = vector.RecordEpisodeStatistics(make_vec("disabled"))
    env.reset(seed=0)
    env.step(np.zeros((N, 6), np.float32))
    env.reset(options={"reset_mask": np.array([True, False, False])})
    assert env.episode_lengths.tolist() == [0, 1, 1]


@pytest.mark.parametrize("mode", MODES)
def test_actions_and_rewards_of_a_batch_are_transformed(mode):
    plain, bounded = make_vec(mode), [make_vec(mode, action_bound=0.5) for _ in range(2)]
    clipped = vector.ClipReward(vector.ClipAction(bounded[0]), 0.0, 0.01)
    rescaled = vector.NormalizeReward(ignoring_precision(lambda: vector.RescaleAction(bounded[1], -1.0, 1.0)))
    for env in (plain, clipped, rescaled):
        env.reset(seed=0)
    wide = np.tile(np.array([9.0, -9.0, 0.25, 0.0, 0.5, -0.5], np.float32), (N, 1))
    inside = np.clip(wide, -0.5, 0.5)
    observations, rewards, *_ = plain.step(inside)
    assert (rewards < 0.0).any() or (rewards > 0.01).any()
    seen, small, *_ = clipped.step(wide)
    np.testing.assert_array_equal(seen["policy"], observations["policy"])
    np.testing.assert_array_equal(small, np.clip(rewards, 0.0, 0.01))
    seen, normal, *_ = rescaled.step(inside / 0.5)
    np.testing.assert_array_equal(seen["policy"], observations["policy"])
    assert np.isfinite(normal).all()


def test_observations_of_a_batch_are_transformed():
    env = vector.NormalizeObservation(flat_vec(make_vec("next_step")))
    assert env.observation_space.shape == (N, 135)
    env.reset(seed=0)
    rows = [env.step(np.zeros((N, 6), np.float32))[0] for _ in range(30)]
    assert np.isfinite(rows).all()
    plain, only = make_vec("next_step"), flat_vec(make_vec("next_step"))
    np.testing.assert_array_equal(only.reset(seed=0)[0], plain.reset(seed=0)[0]["policy"])


def test_gymnasiums_own_batches_can_contain_our_single_environments():
    options = {"vectorization_mode": "async", "vector_kwargs": {"context": "spawn"}}
    env = gymnasium.make_vec(ENV_ID, num_envs=1, overrides=OVERRIDES, **options)
    try:
        assert env.reset(seed=0)[0]["policy"].shape == (1, 135)
        assert env.step(np.zeros((1, 6), np.float32))[1].shape == (1,)
    finally:
        env.close()
