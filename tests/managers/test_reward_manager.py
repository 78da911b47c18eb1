"""Rewards: weights, sums, logs, and values that are not finite."""

from __future__ import annotations

import math

import pytest
import torch

from managers import spies
from wheelleg_exp.errors import ConfigError

STILL = torch.zeros(4, 4)


def _reward(key, weight):
    return {"_target_": spies.HERE + "value", "key": key, "weight": weight}


def test_the_reward_is_the_sum_of_value_weight_and_time_step(make_env):
    spies.VALUES.update(a=torch.tensor([1.0, 2.0, 3.0, 4.0]), b=0.5)
    env = make_env(rewards={"a": _reward("a", 2.0), "b": _reward("b", -4.0)})
    env.reset()
    reward = env.step(STILL)[1]
    torch.testing.assert_close(reward, torch.tensor([0.0, 2.0, 4.0, 6.0]) * 0.02)
    assert env.reward_manager.step_reward.tolist() == [[2, 4, 6, 8], [-2, -2, -2, -2]]


def test_a_term_of_weight_zero_is_not_called_and_logs_zero(make_env):
    def fails(env):
        raise AssertionError("called")

    spies.VALUES.update(a=fails, b=1.0)
    env = make_env(rewards={"a": _reward("a", 0.0), "b": _reward("b", 1.0)})
    env.reset()
    env.step(STILL)
    _, extras = env.reset()
    assert float(extras["log"]["Episode_Reward/a"]) == 0.0
    assert float(extras["log"]["Episode_Reward/b"]) > 0.0


def test_a_weight_set_to_zero_leaves_no_old_value_behind(make_env):
    spies.VALUES.update(a=1.0)
    env = make_env(rewards={"a": _reward("a", 1.0)})
    env.reset()
    env.step(STILL)
    env.reward_manager.get_term_cfg("a").fields["weight"] = 0.0
    assert env.step(STILL)[1].tolist() == [0.0] * 4
    assert env.reward_manager.step_reward.tolist() == [[0.0] * 4]


def test_an_episodes_sum_is_logged_over_the_longest_episodes_seconds(make_env):
    """10 steps of 0.02 s with value 1 and weight 2, divided by 20 s, give 0.02."""
    spies.VALUES.update(a=1.0)
    env = make_env(rewards={"a": _reward("a", 2.0)}, episode_length_s=20.0)
    env.reset()
    for _ in range(10):
        env.step(STILL)
    _, extras = env.reset()
    assert float(extras["log"]["Episode_Reward/a"]) == pytest.approx(0.02)


def test_the_log_is_the_mean_over_the_environments_that_reset(make_env):
    spies.VALUES.update(a=torch.tensor([1.0, 2.0, 3.0, 4.0]))
    env = make_env(rewards={"a": _reward("a", 1.0)}, episode_length_s=1.0)
    env.reset()
    env.step(STILL)
    _, extras = env.reset(env_ids=torch.tensor([1, 3]))
    assert float(extras["log"]["Episode_Reward/a"]) == pytest.approx(3.0 * 0.02)
    env.step(STILL)
    _, extras = env.reset(env_ids=torch.tensor([0, 1]))
    # Environment 0 has made two steps, and environment 1 one step.
    assert float(extras["log"]["Episode_Reward/a"]) == pytest.approx((2 * 1.0 + 2.0) / 2 * 0.02)


@pytest.mark.parametrize("weight", [None, "2.0", True])
def test_a_weight_that_is_no_number_is_refused(make_env, weight):
    node = {"_target_": "wheelleg_exp.mdp.rewards.is_alive", "weight": weight}
    with pytest.raises(ConfigError) as caught:
        make_env(rewards={"a": node})
    assert caught.value.key == "env.rewards.a.weight"


def test_a_whole_number_or_bool_reward_counts_as_a_number(make_env):
    spies.VALUES.update(a=torch.tensor([1, 2, 3, 4]), b=torch.tensor([True, False, True, False]))
    env = make_env(rewards={"a": _reward("a", 2), "b": _reward("b", 1.0)})
    assert env.reward_manager.compute(1.0).tolist() == [3, 4, 7, 8]


# ---- not finite ----


@pytest.fixture(params=[math.nan, math.inf, -math.inf])
def broken(request, make_env):
    spies.VALUES.update(a=1.0, b=1.0)
    env = make_env(rewards={"a": _reward("a", 1.0), "b": _reward("b", 1.0)}, episode_length_s=20.0)
    env.reset()
    for _ in range(2):
        env.step(STILL)
    value = torch.ones(4)
    value[2] = request.param
    spies.VALUES.update(a=value)
    return env, env.step(STILL)


def test_a_value_that_is_not_finite_ends_that_environment_only(broken):
    env, (_, reward, terminated, time_outs, _) = broken
    assert terminated.tolist() == [False, False, True, False]
    assert not time_outs.any()
    assert env.episode_length_buf.tolist() == [3, 3, 0, 3]
    assert reward.tolist() == pytest.approx([0.04, 0.04, 0.0, 0.04])
    assert env.reward_manager.step_reward.tolist() == [[1, 1, 0, 1]] * 2


def test_a_value_that_is_not_finite_is_named_with_its_state(broken):
    env, (*_, extras) = broken
    assert extras["non_finite"]["keys"] == {2: ["env.rewards.a"]}
    kept = extras["non_finite"]["evidence"]
    assert kept["env_ids"].tolist() == [2]
    assert kept["state"].shape == env.scene.sim.state[[2]].shape
    assert not kept["rewards"][0, 0].isfinite()
    assert kept["rewards"][0, 1] == 1.0
    spies.VALUES.update(a=1.0)
    *_, extras = env.step(STILL)
    assert "non_finite" not in extras


def test_a_value_that_is_not_finite_is_not_summed_and_spoils_no_log(broken):
    _, (*_, extras) = broken
    # Two steps of .02 s count, divided by 20 s. The step with NaN or inf counts for neither term.
    assert float(extras["log"]["Episode_Reward/a"]) == pytest.approx(0.04 / 20)
    assert float(extras["log"]["Episode_Reward/b"]) == pytest.approx(0.04 / 20)
