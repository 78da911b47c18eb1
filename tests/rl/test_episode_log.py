"""Test the returns, lengths, and logs of a rollout against hand-computed cases."""

from __future__ import annotations

import pytest
import torch

from wheelleg_exp.rl.rollout_log import EpisodeLog


def step(log, rewards, dones, values=None):
    """Add one step to the log; ``values`` is the managers' log if an environment was reset in this step."""
    if values is not None:
        step.last = {k: torch.tensor(v) for k, v in values.items()}
    extras = {"log": getattr(step, "last", {}), "log_is_fresh": any(dones)}
    log.step(torch.tensor(rewards), torch.tensor(dones).long(), extras)


@pytest.fixture(autouse=True)
def _no_last_log():
    step.last = {}


def test_nothing_is_said_before_an_episode_ends():
    log = EpisodeLog(2)
    step(log, [1.0, 2.0], [0, 0])
    assert log.collect() == {}


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


def test_the_means_stay_while_no_episode_ends():
    log = EpisodeLog(1)
    step(log, [5.0], [1], {})
    first = log.collect()
    step(log, [7.0], [0])
    assert log.collect() == first == {"Train/mean_reward": 5.0, "Train/mean_episode_length": 1.0}


def test_a_log_that_stays_between_resets_counts_once():
    log = EpisodeLog(1)
    step(log, [0.0], [1], {"Episode_Reward/alive": 1.0})
    step(log, [0.0], [0])
    step(log, [0.0], [0])
    step(log, [0.0], [1], {"Episode_Reward/alive": 4.0})
    assert log.collect()["Episode_Reward/alive"] == 2.5


def test_reset_batches_count_alike_whatever_their_size():
    log = EpisodeLog(4)
    step(log, [0.0] * 4, [1, 1, 1, 0], {"Metrics/error": 1.0})
    step(log, [0.0] * 4, [0, 0, 0, 1], {"Metrics/error": 3.0})
    assert log.collect()["Metrics/error"] == 2.0


def test_a_key_that_only_some_logs_hold_is_the_mean_over_those():
    log = EpisodeLog(1)
    step(log, [0.0], [1], {"a": 1.0})
    step(log, [0.0], [1], {"a": 3.0, "b": 7.0})
    scalars = log.collect()
    assert (scalars["a"], scalars["b"]) == (2.0, 7.0)


def test_an_iteration_begins_with_an_empty_log():
    log = EpisodeLog(1)
    step(log, [0.0], [1], {"a": 1.0})
    log.collect()
    assert "a" not in log.collect()


def test_scalars_are_plain_numbers():
    log = EpisodeLog(1)
    step(log, [1.5], [1], {"a": 1.0, "b": 2})
    assert {type(value) for value in log.collect().values()} == {float}


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


def test_a_state_that_was_taken_does_not_move_on():
    log = EpisodeLog(1)
    step(log, [1.0], [0])
    saved = log.state_dict()
    step(log, [1.0], [1], {})
    assert (saved["return"].tolist(), saved["length"].tolist(), saved["returns"]) == ([1.0], [1.0], [])
