from collections import Counter

import numpy as np
import pytest

from wheelleg_exp.inspection.condition_query import Condition, find_hits
from wheelleg_exp.inspection.recording_summary import summarize
from wheelleg_exp.recording.reading.recording_reader import Recording


@pytest.fixture(scope="module")
def told(recorded):
    path, account, env = recorded
    return summarize(Recording(path)), account, env


def test_episodes_end_as_reported_by_the_environment(told):
    summary, account, _ = told
    ended = [episode for episode in summary.episodes if episode.outcome != "unfinished"]
    assert [(e.last_step, list(e.ended_by)) for e in ended] == [(step, names) for step, names, _ in account.ended]
    assert [e.duration_s for e in ended] == pytest.approx([seconds for _, _, seconds in account.ended])
    assert summary.figures.ended_by == Counter(name for _, names, _ in account.ended for name in names)
    assert {e.env_id for e in summary.episodes} == {account.env_id}


def test_height_forces_efforts_and_tracking_errors_are_the_environments(told):
    summary, account, env = told
    assert summary.base["height"].mean == pytest.approx(account["height"].mean(), rel=1e-6)
    norms = np.linalg.norm(account["forces"], axis=-1)
    names = env.scene["contact_forces"].body_names
    assert [force.body for force in summary.forces] == list(names)
    for i, force in enumerate(summary.forces):
        assert force.mean_n == pytest.approx(norms[:, i].mean(), rel=1e-5, abs=1e-9)
        assert force.largest_n >= norms[:, i].max() * (1 - 1e-6)
    largest = dict(zip(env.scene.robot.joint_names, np.abs(account["effort"]).max(axis=0), strict=True))
    assert {use.joint: use.largest for use in summary.efforts} == pytest.approx(largest, rel=1e-6)
    assert all(use.limit and use.largest <= use.limit * (1 + 1e-6) for use in summary.efforts)
    error = account["lin_vel"][:, 0] - account["command"][:, 0]
    forward = next(tracked for tracked in summary.tracking if tracked.name == "v_x")
    assert forward.rmse == pytest.approx(np.sqrt(np.mean(error**2)), rel=1e-5)
    assert forward.mean_command == pytest.approx(account["command"][:, 0].mean(), rel=1e-5)


def test_rewards_sum_up_to_what_the_environment_computed(told):
    summary, account, env = told
    means = dict(zip(env.reward_manager.active_terms, account["rewards"].mean(axis=0), strict=True))
    assert {reward.term: reward.mean for reward in summary.rewards} == pytest.approx(means, rel=1e-5, abs=1e-9)
    assert sum(reward.share for reward in summary.rewards) == pytest.approx(1.0)
    rows = [line.split() for line in str(env.reward_manager).splitlines()]
    configured = {row[1]: float(row[2]) for row in rows if len(row) == 4 and row[0].isdigit()}
    assert {reward.term: reward.weight for reward in summary.rewards} == configured


def test_pushes_are_found_where_they_were(recorded, told):
    path, account, _ = recorded
    assert sum(told[0].events.values()) == len(account.pushed)
    hits = find_hits(Recording(path), Condition("events.push_robot"))
    # A push follows the frame of a control step, so the expected values contain the push one control step later.
    assert [hit.first.step for hit in hits] == pytest.approx(account.pushed, abs=1)
