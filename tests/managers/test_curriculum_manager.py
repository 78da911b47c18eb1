"""Curricula: when they run and what they log."""

import pytest
import torch

from managers import spies
from wheelleg_exp.errors import ConfigError

STILL = torch.zeros(4, 4)
ALIVE = {"_target_": "wheelleg_exp.mdp.rewards.is_alive", "weight": 1.0}
CHANGE = {"_target_": "wheelleg_exp.mdp.curriculums.modify_reward_weight", "term_name": "alive", "weight": 3.0}
CHANGE["num_steps"] = 2


def _state(key):
    return {"_target_": spies.HERE + "state_of", "key": key}


def test_a_weight_changes_at_the_first_reset_after_more_than_so_many_steps(make_env):
    env = make_env(rewards={"alive": ALIVE}, curriculum={"c": CHANGE})
    seen = []
    for _ in range(4):
        _, extras = env.reset()
        seen.append((env.common_step_counter, extras["log"]["Curriculum/c"]))
        env.step(STILL)
    assert seen == [(0, 1.0), (1, 1.0), (2, 1.0), (3, 3.0)]


def test_the_new_weight_counts_from_the_next_step_on(start_env):
    env = start_env(rewards={"alive": ALIVE}, curriculum={"c": CHANGE | {"num_steps": 0}})
    assert env.step(STILL)[1].tolist() == pytest.approx([0.02] * 4)
    env.reset(env_ids=torch.tensor([0]))
    assert env.step(STILL)[1].tolist() == pytest.approx([0.06] * 4)


def test_a_missing_reward_names_the_nearest(make_env):
    env = make_env(rewards={"alive": ALIVE}, curriculum={"c": CHANGE | {"term_name": "alve"}})
    with pytest.raises(ConfigError) as caught:
        env.reset()
    assert caught.value.nearest == "alive"


def test_results_are_logged_as_numbers_key_by_key_and_can_be_read(make_env):
    spies.VALUES.update(a={"mean": torch.tensor(2.5), "top": 4}, b=torch.tensor(1.5), c=None)
    env = make_env(curriculum={"a": _state("a"), "b": _state("b"), "c": _state("c")})
    assert env.curriculum_manager.get_active_iterable_terms(0) == []
    assert env.curriculum_manager.reset(torch.arange(4)) == {}  # before the first call
    _, extras = env.reset()
    log = {k: v for k, v in extras["log"].items() if k.startswith("Curriculum/")}
    assert log == {"Curriculum/a/mean": 2.5, "Curriculum/a/top": 4, "Curriculum/b": 1.5}
    assert env.curriculum_manager.get_active_iterable_terms(3) == [("a", [2.5, 4]), ("b", [1.5])]


def test_a_weight_changed_by_a_curriculum_is_saved_and_a_configured_one_is_not(make_env, start_env):
    rewards = {"alive": ALIVE, "other": ALIVE | {"weight": 5.0}}
    first = start_env(rewards=rewards, curriculum={"c": CHANGE | {"num_steps": 0}})
    first.step(STILL)
    first.reset()
    second = make_env(rewards=rewards | {"other": ALIVE | {"weight": 7.0}}, curriculum={"c": CHANGE | {"num_steps": 0}})
    second.load_state_dict(first.state_dict())
    assert second.reward_manager.get_term_cfg("alive").fields["weight"] == 3.0
    assert second.reward_manager.get_term_cfg("other").fields["weight"] == 7.0
    assert second.curriculum_manager.reset(torch.arange(4)) == {"Curriculum/c": 3.0}
