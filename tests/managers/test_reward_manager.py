"""Rewards: weights, sums, logs, and values that are not finite."""

import math

import pytest
import torch
from sim.small_envs import run

from managers import spies

STILL = torch.zeros(4, 4)


def _reward(key, weight):
    return {"_target_": spies.HERE + "value", "key": key, "weight": weight}


def test_the_reward_is_the_sum_of_value_weight_and_time_step(start_env):
    """Whole numbers and booleans count as numbers."""
    whole, flags = torch.tensor([1, 2, 3, 4]), torch.tensor([True, False, True, False])
    spies.VALUES.update(a=torch.tensor([1.0, 2.0, 3.0, 4.0]), b=0.5, c=whole, d=flags)
    env = start_env(rewards={key: _reward(key, weight) for key, weight in zip("abcd", (2.0, -4.0, 2, 1), strict=True)})
    torch.testing.assert_close(env.step(STILL)[1], torch.tensor([3.0, 6.0, 11.0, 14.0]) * 0.02)
    assert env.reward_manager.step_reward.tolist() == [[2, 4, 6, 8], [-2, -2, -2, -2], [2, 4, 6, 8], [1, 0, 1, 0]]


def test_a_term_of_weight_zero_is_not_called_and_counts_as_zero(start_env):
    spies.VALUES.update(a=1.0, b=1.0)
    env = start_env(rewards={"a": _reward("a", 1.0), "b": _reward("b", 1.0)})
    env.step(STILL)
    env.reward_manager.get_term_cfg("a").fields["weight"] = 0.0
    spies.VALUES.update(a=lambda env: pytest.fail("called"))
    env.reset()
    env.step(STILL)
    assert env.reward_manager.step_reward.tolist() == [[0.0] * 4, [1.0] * 4]
    log = env.reset()[1]["log"]
    assert [float(log[f"Episode_Reward/{name}"]) for name in "ab"] == pytest.approx([0.0, 0.02 / 2.0])


def test_the_log_is_the_mean_over_the_environments_that_reset_per_second_of_the_longest_episode(start_env):
    spies.VALUES.update(a=torch.tensor([1.0, 2.0, 3.0, 4.0]))
    env = start_env(rewards={"a": _reward("a", 1.0)}, episode_length_s=20.0)
    # In the second row, environment 0 has made two steps, and environment 1 one step.
    for ids, total in (([1, 3], 3.0), ([0, 1], (2 * 1.0 + 2.0) / 2)):
        env.step(STILL)
        log = env.reset(env_ids=torch.tensor(ids))[1]["log"]
        assert float(log["Episode_Reward/a"]) == pytest.approx(total * 0.02 / 20.0)


@pytest.mark.parametrize("number", [math.nan, math.inf, -math.inf])
def test_a_value_that_is_not_finite_ends_only_its_environment_is_named_and_is_not_summed(start_env, number):
    spies.VALUES.update(a=1.0, b=1.0)
    env = start_env(rewards={"a": _reward("a", 1.0), "b": _reward("b", 1.0)}, episode_length_s=20.0)
    run(env, 2)
    spies.VALUES.update(a=torch.tensor([1.0, 1.0, number, 1.0]))
    _, reward, terminated, time_outs, extras = env.step(STILL)
    assert (terminated.tolist(), time_outs.any()) == ([False, False, True, False], False)
    assert env.episode_length_buf.tolist() == [3, 3, 0, 3]
    assert reward.tolist() == pytest.approx([0.04, 0.04, 0.0, 0.04])
    assert env.reward_manager.step_reward.tolist() == [[1, 1, 0, 1]] * 2
    # Two steps of .02 s count, divided by 20 s. The step with NaN or inf counts for neither term.
    assert [float(extras["log"][f"Episode_Reward/{name}"]) for name in "ab"] == pytest.approx([0.04 / 20] * 2)
    assert extras["non_finite"]["keys"] == {2: ["env.rewards.a"]}
    evidence = extras["non_finite"]["evidence"]
    assert (evidence["env_ids"].tolist(), evidence["state"].shape) == ([2], env.scene.sim.state[[2]].shape)
    assert not evidence["rewards"][0, 0].isfinite()
    assert evidence["rewards"][0, 1] == 1.0
    spies.VALUES.update(a=1.0)
    assert "non_finite" not in env.step(STILL)[-1]
