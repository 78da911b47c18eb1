"""Test means over all control steps against closed forms, with episodes of different lengths."""

from types import SimpleNamespace

import pytest
import torch

from wheelleg_exp.rl.rollout_log import StepMeans


@pytest.fixture
def env():
    """Return two environments with a reward that is 1 in the first 4 steps and 0 later, and its opposite."""
    term = SimpleNamespace(metric_names=["error"])
    return SimpleNamespace(
        reward_manager=SimpleNamespace(active_terms=["early", "late"], step_reward=torch.zeros(2, 2)),
        termination_manager=SimpleNamespace(active_terms=["fell"], fired=torch.zeros(1, 2, dtype=torch.bool)),
        command_manager=SimpleNamespace(step_errors={}, get_term=lambda name: term),
    )


def run(env, means, lengths, steps):
    """Simulate ``steps`` steps in which environment ``i`` ends its episodes after ``lengths[i]`` steps."""
    for step in range(steps):
        age = torch.tensor([step % length for length in lengths])
        env.reward_manager.step_reward[0] = (age < 4).float()
        env.reward_manager.step_reward[1] = (age >= 4).float()
        env.termination_manager.fired[0] = age == torch.tensor(lengths) - 1
        env.command_manager.step_errors["drive"] = 0.1 * age.float().unsqueeze(0)
        means.take()


def test_each_environment_counts_alike_in_each_step(env):
    means = StepMeans(env)
    run(env, means, [4, 16], 16)
    scalars = means.collect()
    assert scalars["Rewards_per_step/early"] == pytest.approx((16 + 4) / 32)
    assert scalars["Rewards_per_step/late"] == pytest.approx(12 / 32)
    assert scalars["Terminations_per_step/fell"] == pytest.approx((4 + 1) / 32)
    assert scalars["Metrics_per_step/drive/error"] == pytest.approx((0.15 + 0.75) / 2)


def test_steps_without_an_end_count_and_each_iteration_starts_from_scratch(env):
    means = StepMeans(env)
    run(env, means, [100, 100], 8)
    assert means.collect()["Rewards_per_step/early"] == pytest.approx(0.5)
    run(env, means, [4, 4], 4)
    assert means.collect()["Rewards_per_step/early"] == 1.0
    run(env, means, [1, 1], 3)
    assert means.collect()["Terminations_per_step/fell"] == 1.0
    assert means.collect() == {}


@pytest.mark.train
def test_a_training_logs_the_means_of_its_environment(make_trainer):
    trainer, rewards = make_trainer(), []
    env = trainer.env.env
    compute = env.reward_manager.compute

    def spy(*args):
        reward = compute(*args)
        rewards.append(reward.double().clone())
        return reward

    env.reward_manager.compute = spy
    (done,) = trainer.learn(until=1)
    per_second = sum(value for key, value in done.scalars.items() if key.startswith("Rewards_per_step/"))
    assert len(rewards) == 24
    assert per_second * env.step_dt == pytest.approx(float(torch.stack(rewards).mean()), rel=1e-5)
    assert done.scalars["Metrics_per_step/base_velocity/error_vel_xy"] > 0.0
