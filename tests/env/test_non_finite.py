"""Numbers that are not finite: an environment's own failure is told with its key, anything else ends the run."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from managers import spies

from env.composed import term
from wheelleg_exp.errors import SimulationFailure

STILL = torch.zeros(4, 4)
ALIVE = term("rewards.is_alive", weight=1.0)


@pytest.fixture(autouse=True)
def _no_log(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # MuJoCo writes its warnings about reset states to a file in the current folder.


def _keys(extras: dict[str, Any]) -> dict[int, list[str]]:
    return extras["non_finite"]["keys"]


# --- failures of one environment ---


def test_a_state_that_goes_to_nan_ends_its_environment_even_without_a_termination(start_env):
    env = start_env(rewards={"alive": ALIVE}, terminations={})
    env.scene.sim.view("qvel")[2, 8] = math.nan
    observations, reward, terminated, _, extras = env.step(STILL)
    assert terminated.tolist() == [False, False, True, False]
    assert _keys(extras) == {2: ["env.sim"]}
    assert all(numbers.isfinite().all() for numbers in (observations["policy"], reward))
    *_, terminated, _, extras = env.step(STILL)
    assert (terminated.any().item(), "non_finite" in extras) == (False, False)


def test_terms_that_read_such_a_state_are_not_named(start_env):
    spies.VALUES["speed"] = lambda env: env.scene.robot.data.joint_vel[:, 0]
    env = start_env(rewards={"speed": {"_target_": spies.HERE + "value", "key": "speed", "weight": 1.0}})
    step, count = env.scene.sim.step, iter(range(100))

    def breaking_step():
        step()
        if next(count) == 1:  # After the last physics step of a control step, MuJoCo has not yet reset the state.
            env.scene.sim.view("qvel")[1] = math.nan

    env.scene.sim.step = breaking_step
    *_, extras = env.step(STILL)
    assert _keys(extras) == {1: ["env.sim"]}
    assert extras["non_finite"]["evidence"]["qvel"].isnan().all()


@pytest.mark.parametrize("size", [1e7, 1e25, math.nan])
def test_a_reward_that_overflows_because_of_the_actions_is_not_the_cause(start_env, size):
    spies.VALUES["power"] = lambda env: env.action_manager.action[:, 0] ** 8
    rate = {"_target_": spies.HERE + "value", "key": "power", "weight": -1.0}
    env, action = start_env(rewards={"power": rate}), STILL.clone()
    action[3, 0] = size
    *_, extras = env.step(action)
    assert _keys(extras) == {3: ["env.actions"]}


def test_rewards_that_are_finite_alone_but_too_large_together_are_named(start_env):
    spies.VALUES["big"] = 3e38
    big = {"_target_": spies.HERE + "value", "key": "big", "weight": 1.0}
    env = start_env(rewards={"a": big, "b": big})
    *_, extras = env.step(STILL)
    assert _keys(extras) == {i: ["env.rewards"] for i in range(4)}


def test_large_numbers_whose_sum_overflows_are_no_failure(make_env):
    spies.VALUES["big"] = 2e38
    term = {"_target_": spies.HERE + "column", "key": "big"}
    env = make_env(observations={"policy": {"terms": {"big": term}}})
    observations, _ = env.reset()
    assert observations["policy"].sum().isinf()
    env.step(STILL)


# --- failures of the whole run ---


def test_an_observation_that_is_not_finite_names_its_term(start_env):
    spies.VALUES["x"] = 0.0
    terms = {"q": term("observations.joint_pos"), "x": {"_target_": spies.HERE + "column", "key": "x"}}
    env = start_env(observations={"policy": {"terms": terms, "history_length": 3}})
    env.step(STILL)
    spies.VALUES["x"] = torch.tensor([0.0, math.inf, 0.0, 0.0])
    with pytest.raises(SimulationFailure) as caught:
        env.step(STILL)
    assert caught.value.key == "env.observations.policy.terms.x"
    assert "1 of 4 environments (1), control step 2" in caught.value.message


def test_a_manual_reset_reports_what_has_failed(make_env):
    env = make_env()
    env.autoreset = "disabled"
    env.reset()
    action = STILL.clone()
    action[1] = math.nan
    observations, _, terminated, _, extras = env.step(action)
    assert terminated.tolist() == [False, True, False, False]
    assert _keys(extras) == {1: ["env.actions"]}
    env.reset(env_ids=torch.tensor([1]))
    observations, *_ = env.step(STILL)
    assert observations["policy"].isfinite().all()


def _fill(name):
    return lambda env, ids: env.scene.sim.expand(name).index_fill_(0, ids, math.nan)


WRITES = {
    "positions": lambda env, ids: env.scene.sim.view("qpos").index_fill_(0, ids, math.nan),
    "velocities": lambda env, ids: env.scene.sim.view("qvel").index_fill_(0, ids, math.inf),
    "wrenches": lambda env, ids: env.scene.robot.set_permanent_wrench(ids, [0], torch.full((len(ids), 1, 6), math.nan)),
    **{f"the model's {name}": _fill(name) for name in ("body_mass", "actuator_biasprm")},
}


@pytest.mark.parametrize("mode", ["startup", "reset", "interval", "mine"])
@pytest.mark.parametrize("what", WRITES)
def test_values_are_checked_when_an_event_writes_them(make_env, what, mode):
    spies.VALUES["write"] = WRITES[what]
    node = {"_target_": spies.HERE + "writes", "key": "write", "mode": mode}
    node |= {"interval_range_s": [0.02, 0.02]} if mode == "interval" else {}
    with pytest.raises(SimulationFailure) as caught:
        _live(make_env, node)
    assert caught.value.key == "env.events.bad"
    assert f"wrote numbers that are not finite into {what} in 4 of 4 environments" in caught.value.message


def _live(make_env, node):
    env = make_env(events={"bad": node})
    env.reset()
    env.step(STILL)
    env.apply_event("mine")


def test_a_field_that_a_term_object_has_stored_is_checked(start_env):
    env = start_env(events={"bad": {"_target_": spies.HERE + "KeepsMasses", "mode": "reset"}})
    spies.VALUES["mass"] = math.inf
    with pytest.raises(SimulationFailure, match="body_mass") as caught:
        env.reset(env_ids=torch.tensor([1]))
    assert caught.value.key == "env.events.bad"
    assert "1 of 4 environments (1)" in caught.value.message
