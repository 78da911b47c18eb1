"""Curricula: when they run and what they log."""

import torch

from managers import spies

STILL = torch.zeros(4, 4)
ALIVE = {"_target_": "wheelleg_exp.mdp.rewards.is_alive", "weight": 1.0}
CHANGE = {"_target_": "wheelleg_exp.mdp.curriculums.modify_reward_weight", "term_name": "alive", "weight": 3.0}
CHANGE["num_steps"] = 2


def _state(key):
    return {"_target_": spies.HERE + "state_of", "key": key}


def test_a_weight_changes_at_the_first_reset_after_more_than_so_many_steps_and_counts_at_once(make_env):
    env, seen = make_env(rewards={"alive": ALIVE}, curriculum={"c": CHANGE}), []
    for _ in range(4):
        _, extras = env.reset()
        seen.append((extras["log"]["Curriculum/c"], round(float(env.step(STILL)[1][0]), 6)))
    assert seen == [(1.0, 0.02), (1.0, 0.02), (1.0, 0.02), (3.0, 0.06)]


def test_results_are_logged_as_numbers_key_by_key_and_can_be_read(make_env):
    spies.VALUES.update(a={"mean": torch.tensor(2.5), "top": 4}, b=torch.tensor(1.5), c=None)
    env = make_env(curriculum={"a": _state("a"), "b": _state("b"), "c": _state("c")})
    assert env.curriculum_manager.get_active_iterable_terms(0) == []
    assert env.curriculum_manager.reset(torch.arange(4)) == {}  # before the first call
    _, extras = env.reset()
    log = {k: v for k, v in extras["log"].items() if k.startswith("Curriculum/")}
    assert log == {"Curriculum/a/mean": 2.5, "Curriculum/a/top": 4, "Curriculum/b": 1.5}
    assert env.curriculum_manager.get_active_iterable_terms(3) == [("a", [2.5, 4]), ("b", [1.5])]
    other = make_env(curriculum={"a": _state("a"), "b": _state("b"), "c": _state("c")})
    other.load_state_dict(env.state_dict())
    assert other.curriculum_manager.reset(torch.arange(4)) == log
