"""Test that NaN and inf end a training with an error that names the term, the iteration, and the saved state."""

from __future__ import annotations

import functools
import itertools
import math

import pytest

from wheelleg_exp.errors import EXIT_FAILED, SimulationFailure
from wheelleg_exp.mdp import observations, rewards
from wheelleg_exp.rl.rollout_log import logged

pytestmark = pytest.mark.train

NAN, INF = math.nan, math.inf


def spoil(monkeypatch, module, name: str, value: float, *, rows=slice(2, 3), calls=range(40, 10**9)) -> None:
    """Make a stock term return ``value`` for some environments at some of its calls."""
    function, number = getattr(module, name), itertools.count()

    @functools.wraps(function)
    def spoiled(*args, **kwargs):
        found = function(*args, **kwargs).clone()
        if next(number) in calls:
            found[rows] = value
        return found

    monkeypatch.setattr(module, name, spoiled)


def failed(trainer, until: int) -> SimulationFailure:
    with pytest.raises(SimulationFailure) as caught:
        list(trainer.learn(until))
    assert caught.value.exit_code == EXIT_FAILED
    return caught.value


@pytest.mark.parametrize("value", [NAN, INF, -INF])
def test_an_observation_that_is_not_finite_names_its_term_and_iteration(make_trainer, monkeypatch, value):
    spoil(monkeypatch, observations, "joint_effort_commanded", value)
    error = failed(make_trainer(), 4)
    assert error.key == "env.observations.critic.terms.joint_effort"
    assert "1 of 16 environments (2)" in error.message
    assert "in iteration 1" in error.message
    assert error.evidence["env_ids"].tolist() == [2]
    assert not error.evidence["observation.critic"].isfinite().all()
    assert error.evidence["observation.policy"].isfinite().all()


@pytest.mark.parametrize("value", [NAN, INF])
def test_a_reward_that_is_never_finite_fails_in_its_first_step(make_trainer, monkeypatch, value):
    spoil(monkeypatch, rewards, "is_alive", value, rows=slice(None), calls=range(10**9))
    trainer = make_trainer()
    error = failed(trainer, 4)
    assert error.key == "env.rewards.alive"
    assert "ended 16 episodes by control step 1, in iteration 0" in error.message
    assert "agent.max_non_finite" in str(error.expected)
    alive = trainer.env.env.reward_manager.active_terms.index("alive")
    assert not error.evidence["rewards"][:, alive].isfinite().any()
    assert len(error.evidence["state"]) == len(error.evidence["env_ids"]) == 16


def test_a_reward_that_is_often_nan_in_one_environment_fails(make_trainer, monkeypatch):
    spoil(monkeypatch, rewards, "is_alive", NAN)
    assert failed(make_trainer(), 4).key == "env.rewards.alive"


@pytest.mark.parametrize(("words", "calls"), [([], range(10, 11)), (["agent.max_non_finite=1"], range(5, 15))])
def test_as_many_episodes_with_a_reward_of_nan_as_allowed_are_only_logged(make_trainer, monkeypatch, words, calls):
    spoil(monkeypatch, rewards, "is_alive", NAN, calls=calls)
    first, second = make_trainer(*words).learn(2)
    assert (logged(first.scalars), logged(second.scalars)) == ({"env.rewards.alive": len(calls)}, {})
    assert all(math.isfinite(value) for value in first.scalars.values())


def test_physics_that_fails_everywhere_fails_the_training_even_without_a_termination_for_it(make_trainer, capfd):
    trainer = make_trainer("~env.terminations.non_finite_state")
    list(trainer.learn(1))
    trainer.env.env.scene.sim.view("qvel")[:, 0] = NAN
    error = failed(trainer, 2)
    assert (error.key, "in iteration 1" in error.message) == ("env.sim", True)
    assert not error.evidence["motion_at_start"].isfinite().all()


def test_actions_of_nan_name_the_policy(make_trainer, monkeypatch):
    trainer = make_trainer()
    act = trainer.algorithm.act
    monkeypatch.setattr(trainer.algorithm, "act", lambda observations: act(observations) * NAN)
    error = failed(trainer, 1)
    assert error.key == "agent.actor"
    assert error.evidence["actions"].isnan().all()


def test_a_learning_rate_that_blows_the_networks_up_fails(make_trainer):
    error = failed(make_trainer("agent.algorithm.learning_rate=1e30"), 3)
    assert error.key == "agent.algorithm"
    assert "is not finite" in error.message
    assert "in the update of iteration 0" in error.message
    assert "learning_rate" in str(error.expected)


def test_a_loss_that_is_inf_and_a_parameter_that_is_nan_are_named(make_trainer, monkeypatch):
    trainer = make_trainer()
    update, weight = trainer.algorithm.update, trainer.algorithm.critic.mlp[0].weight
    monkeypatch.setattr(trainer.algorithm, "update", lambda: update() | {"surrogate": INF})
    error = failed(trainer, 3)
    assert error.message == "the surrogate loss is inf, in the update of iteration 0"
    assert {"loss.value", "loss.surrogate"} <= error.evidence.keys()
    monkeypatch.setattr(trainer.algorithm, "update", lambda: (update(), weight.data.fill_(NAN))[0])
    assert failed(trainer, 3).message.startswith("the critic's mlp.0.weight is not finite, in the update of iteration")
