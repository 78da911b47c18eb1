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


def _shares(env):
    log = env.extras["log"]
    return [float(log[f"Episode_Termination/{name}"]) for name in ("fall", "hit", "late")]


def test_the_log_is_the_share_of_all_environments_whose_last_episode_a_term_ended(start_env):
    env = _env(start_env)
    seen = []
    for ids in ([0], [1], []):
        spies.VALUES.update(fall=_at(*ids))
        env.step(STILL)
        seen.append(_shares(env)[0])
    assert seen == [0.25, 0.5, 0.5]


def test_a_new_end_replaces_the_old_one(start_env):
    env = _env(start_env)
    spies.VALUES.update(fall=_at(0, 1))
    env.step(STILL)
    assert _shares(env) == [0.5, 0.0, 0.0]
    spies.VALUES.update(fall=_at(), hit=_at(0), late=_at(0))
    env.step(STILL)
    assert _shares(env) == [0.25, 0.25, 0.25]


def test_the_outcome_returned_does_not_change_later(start_env):
    env = _env(start_env)
    spies.VALUES.update(fall=_at(0))
    terminated = env.step(STILL)[2]
    spies.VALUES.update(fall=_at())
    env.step(STILL)
    assert terminated[0]


def test_an_environment_forced_to_end_has_failed_by_no_term(start_env):
    env = _env(start_env)
    spies.VALUES.update(fall=_at(0))
    env.step(STILL)
    spies.VALUES.update(fall=_at())
    env.termination_manager.compute()
    assert env.termination_manager.force(torch.tensor([0])).tolist() == [True, False, False, False]
    assert float(env.termination_manager.reset(torch.arange(4))["Episode_Termination/fall"]) == 0.0


def test_an_environment_without_terminations_runs_on(start_env):
    *_, terminated, time_outs, _ = run(start_env(terminations={}), 3)
    assert not (terminated | time_outs).any()


def test_an_environment_counts_once_whatever_ended_its_episode(start_env):
    """Two terms end environment 0, one ends 1, a reward that is not finite ends 2, and 3 continues."""
    manager = _env(start_env).termination_manager
    spies.VALUES.update(fall=_at(0), hit=_at(0, 1))
    manager.compute()
    manager.force(torch.tensor([2]))
    assert manager.endings(manager.dones) == {"fall and hit": 1, "hit": 1, "a number that is not finite": 1}
    assert manager.last_endings() == {"fall and hit": 1, "hit": 1, "none": 2}
