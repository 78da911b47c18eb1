"""Test the reports of a rollout against hand-computed cases: returns, lengths, logs, and means over all steps."""

from types import SimpleNamespace

import pytest
import torch

from wheelleg_exp.errors import SimulationFailure
from wheelleg_exp.rl.rollout_log import EpisodeLog, FailureCount, StepMeans


def step(log, rewards, dones, values=None):
    """Add one step to the log; ``values`` is the managers' log, which is stale unless an environment was reset."""
    logged = {k: torch.tensor(v) for k, v in ({"a": 99.0} if values is None else values).items()}
    log.step(torch.tensor(rewards), torch.tensor(dones).long(), {"log": logged, "log_is_fresh": any(dones)})


def test_return_and_length_are_those_of_the_finished_episodes():
    log = EpisodeLog(3)
    step(log, [1.0, 10.0, 0.5], [0, 0, 0])
    step(log, [2.0, 10.0, 0.5], [1, 0, 0], {})  # Environment 0 ends with return 3 after 2 steps.
    step(log, [4.0, 10.0, 0.5], [0, 0, 1], {})  # Environment 2 ends with return 1.5 after 3 steps.
    step(log, [8.0, 10.0, 0.5], [1, 0, 0], {})  # Environment 0 ends with return 12 after 2 steps.
    scalars = log.collect()
    assert scalars["Train/mean_reward"] == pytest.approx((3.0 + 1.5 + 12.0) / 3)
    assert scalars["Train/mean_episode_length"] == pytest.approx((2 + 3 + 2) / 3)


def test_the_means_cover_the_last_hundred_episodes():
    log = EpisodeLog(1)
    for k in range(130):
        step(log, [float(k)], [1], {})
    assert log.collect()["Train/mean_reward"] == pytest.approx(sum(range(30, 130)) / 100)
    step(log, [1030.0], [1], {})
    assert log.collect()["Train/mean_reward"] == pytest.approx((sum(range(31, 130)) + 1030) / 100)


def test_there_are_no_means_before_an_episode_ends_and_they_stay_while_none_ends():
    log = EpisodeLog(1)
    step(log, [1.0], [0])
    assert log.collect() == {}
    step(log, [4.0], [1], {})
    first = log.collect()
    step(log, [7.0], [0])
    assert log.collect() == first == {"Train/mean_reward": 5.0, "Train/mean_episode_length": 2.0}


@pytest.mark.parametrize(
    ("steps", "expected"),
    [
        ([([1], {"a": 1.0}), ([0], None), ([0], None), ([1], {"a": 4.0})], {"a": 2.5}),  # A stale log counts once.
        ([([1, 1, 1, 0], {"a": 1.0}), ([0, 0, 0, 1], {"a": 3.0})], {"a": 2.0}),  # The size of a reset does not matter.
        ([([1], {"a": 1.0}), ([1], {"a": 3.0, "b": 7.0})], {"a": 2.0, "b": 7.0}),  # Only the logs with a key count.
    ],
)
def test_logs_of_resets_are_averaged(steps, expected):
    log = EpisodeLog(len(steps[0][0]))
    for dones, values in steps:
        step(log, [0.0] * len(dones), dones, values)
    assert expected.items() <= log.collect().items()


def test_scalars_are_floats_and_each_iteration_starts_with_an_empty_log():
    log = EpisodeLog(1)
    step(log, [1.5], [1], {"a": 1.0, "b": 2})
    assert {type(value) for value in log.collect().values()} == {float}
    assert "a" not in log.collect()


def test_state_goes_round(tmp_path):
    first, second = EpisodeLog(2), EpisodeLog(2)
    for k in range(60):
        step(first, [float(k), 1.0], [1, k % 7 == 0], {})
    first.collect()
    step(first, [1.0, 2.0], [0, 0])
    saved = first.state_dict()
    step(first, [10.0, 20.0], [1, 1], {"a": 3.0})
    torch.save(saved, tmp_path / "log.pt")  # A saved state does not change in later steps.
    second.load_state_dict(torch.load(tmp_path / "log.pt", weights_only=True))
    step(second, [10.0, 20.0], [1, 1], {"a": 3.0})
    assert first.collect() == second.collect()


@pytest.mark.parametrize(("num_envs", "share", "allowed"), [(1, 0.1, 1), (16, 0.1, 1), (512, 0.1, 51), (512, 0.0, 1)])
def test_one_failed_episode_and_a_share_of_many_are_always_allowed(num_envs, share, allowed):
    count = FailureCount(num_envs, share)
    for _ in range(allowed):
        count.take({"non_finite": {"keys": {0: ["env.sim"]}, "evidence": {}}})
    count.require_few("by now")
    count.take({"non_finite": {"keys": {0: ["env.sim"]}, "evidence": {}}})
    with pytest.raises(SimulationFailure, match=r"env\.sim"):
        count.require_few("by now")


def test_episodes_that_the_actions_end_are_the_policys_fault():
    count = FailureCount(1, 0.1)
    count.take({"non_finite": {"keys": {0: ["env.actions"], 1: ["env.actions"]}, "evidence": {}}})
    with pytest.raises(SimulationFailure, match="the policy has diverged") as caught:
        count.require_few("by now")
    assert caught.value.key == "agent.actor"


# --- means over all control steps, with episodes of different lengths ---


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
