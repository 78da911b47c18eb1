"""Test the returns, lengths, and logs of a rollout against hand-computed cases."""

import pytest
import torch

from wheelleg_exp.errors import SimulationFailure
from wheelleg_exp.rl.rollout_log import EpisodeLog, FailureCount


def step(log, rewards, dones, values=None):
    """Add one step to the log; ``values`` is the managers' log if an environment was reset in this step."""
    if values is not None:
        step.last = {k: torch.tensor(v) for k, v in values.items()}
    extras = {"log": getattr(step, "last", {}), "log_is_fresh": any(dones)}
    log.step(torch.tensor(rewards), torch.tensor(dones).long(), extras)


@pytest.fixture(autouse=True)
def _no_last_log():
    step.last = {}


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
    torch.save(first.state_dict(), tmp_path / "log.pt")
    second.load_state_dict(torch.load(tmp_path / "log.pt", weights_only=True))
    for log in (first, second):
        step(log, [10.0, 20.0], [1, 1], {"a": 3.0})
    assert first.collect() == second.collect()


def test_a_saved_state_does_not_change_in_later_steps():
    log = EpisodeLog(1)
    step(log, [1.0], [0])
    saved = log.state_dict()
    step(log, [1.0], [1], {})
    assert (saved["return"].tolist(), saved["length"].tolist(), saved["returns"]) == ([1.0], [1.0], [])


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
