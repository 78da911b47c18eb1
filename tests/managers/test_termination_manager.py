"""Terminations: failing, running out of time, and which of them ended the last episode."""

import torch
from sim.small_envs import run

from managers import spies

STILL = torch.zeros(4, 4)


def _term(key, **fields):
    spies.VALUES.setdefault(key, 0.0)
    return {"_target_": spies.HERE + "flag", "key": key, **fields}


def _at(*ids):
    return torch.tensor([float(i in ids) for i in range(4)])


def _env(start_env):
    return start_env(terminations={"fall": _term("fall"), "hit": _term("hit"), "late": _term("late", time_out=True)})


def test_a_time_out_truncates_other_terms_terminate_and_each_term_can_be_read(start_env):
    env = _env(start_env)
    manager = env.termination_manager
    spies.VALUES.update(fall=_at(0, 3), late=_at(1, 3))
    *_, terminated, time_outs, _ = env.step(STILL)
    assert (terminated.tolist(), time_outs.tolist()) == ([True, False, False, True], [False, True, False, True])
    assert manager.dones.tolist() == [True, True, False, True]
    assert manager.get_term("fall").tolist() == [True, False, False, True]
    assert not manager.get_term("hit").any()


def test_the_log_is_the_share_of_all_environments_whose_last_episode_a_term_ended(start_env):
    env, returned = _env(start_env), []
    rows = [([0], [], [0.25, 0, 0]), ([1], [], [0.5, 0, 0]), ([], [], [0.5, 0, 0]), ([], [0], [0.25, 0.25, 0.25])]
    for falls, hits, shares in rows:
        spies.VALUES.update(fall=_at(*falls), hit=_at(*hits), late=_at(*hits))
        returned.append(env.step(STILL)[2])
        log = env.extras["log"]
        assert [float(log[f"Episode_Termination/{name}"]) for name in ("fall", "hit", "late")] == shares
    assert [flags.nonzero().flatten().tolist() for flags in returned] == [[0], [1], [], [0]]


def test_an_environment_without_terminations_runs_on(start_env):
    *_, terminated, time_outs, _ = run(start_env(terminations={}), 3)
    assert not (terminated | time_outs).any()


def test_an_environment_counts_once_whatever_ended_its_episode(start_env):
    """Two terms end environment 0, one ends 1, a reward that is not finite ends 2, and 3 continues."""
    manager = _env(start_env).termination_manager
    spies.VALUES.update(fall=_at(0), hit=_at(0, 1))
    manager.compute()
    assert manager.force(torch.tensor([2])).tolist() == [True, True, True, False]
    assert manager.endings(manager.dones) == {"fall and hit": 1, "hit": 1, "a number that is not finite": 1}
    assert manager.last_endings() == {"fall and hit": 1, "hit": 1, "none": 2}
