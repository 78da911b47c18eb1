"""Test that the mean of a policy's weights is played, and that training does not depend on the mean."""

import copy

import pytest
import torch

from wheelleg_exp.errors import RunDirectoryError
from wheelleg_exp.jobs.train.resume_training import load_state
from wheelleg_exp.rl.digests import of_state
from wheelleg_exp.rl.network_loading import load_policy
from wheelleg_exp.rl.policy_average import PolicyAverage, without_average

from .conftest import saved

OVER = "agent.average_iterations=2"


def test_the_mean_is_that_of_all_at_first_and_exponential_from_then_on():
    policy = torch.nn.Linear(1, 1)
    policy.register_buffer("count", torch.tensor(0))
    mean = PolicyAverage(policy, 2)
    assert mean.state_dict() == {}
    expected = [1.0, 1.5, 2.75, 5.375]  # 1; (1 + 2) / 2; 1.5 + (4 - 1.5) / 2; 2.75 + (8 - 2.75) / 2
    for index, value in enumerate((1.0, 2.0, 4.0, 8.0)):
        with torch.no_grad():
            policy.weight.fill_(value)
        policy.count += 1
        mean.take()
        kept = mean.state_dict()["averaged_state_dict"]
        assert float(kept["weight"]) == expected[index]
        assert int(kept["count"]) == index + 1  # An integer buffer is not averaged.
    assert policy.weight.item() == 8.0


@pytest.fixture(scope="module")
def averaged(make_trainer):
    """Return the checkpoints of three successive iterations."""
    trainer = make_trainer(OVER)
    return [trainer.state_dict() for _ in trainer.learn(3)]


def test_training_is_the_same_with_and_without_a_mean_of_weights(make_trainer, averaged):
    plain = make_trainer()
    list(plain.learn(3))
    ours, theirs = of_state(averaged[-1]), of_state(plain.state_dict())
    assert {name for name in ours if ours[name] != theirs.get(name)} == {"mean", "rest"}
    assert of_state(without_average(averaged[-1])) == theirs


def test_a_training_may_go_on_without_its_mean(make_trainer, averaged):
    plain = make_trainer()
    assert load_state(plain, copy.deepcopy(averaged[0]), None) == []
    list(plain.learn(3))
    assert of_state(plain.state_dict()) == of_state(without_average(averaged[-1]))


@pytest.mark.parametrize(
    "change",
    [
        lambda state: state["averaged_state_dict"].popitem(),
        lambda state: state["unsaved"].update(averaged_iterations=-1),
        lambda state: state["unsaved"].pop("averaged_iterations"),
    ],
)
def test_the_mean_of_another_network_does_not_fit(make_trainer, averaged, change):
    state = {**averaged[0], "averaged_state_dict": dict(averaged[0]["averaged_state_dict"])}
    state["unsaved"] = dict(state["unsaved"])
    change(state)
    with pytest.raises(RunDirectoryError, match="a checkpoint does not fit the run: the averaged weights"):
        make_trainer(OVER).load_state_dict(state)


def test_a_mean_may_begin_at_a_resume(make_trainer):
    plain = make_trainer()
    list(plain.learn(1))
    begun = make_trainer(OVER)
    begun.load_state_dict(plain.state_dict())
    list(begun.learn(2))
    state = begun.state_dict()
    assert torch.equal(state["averaged_state_dict"]["mlp.0.weight"], state["actor_state_dict"]["mlp.0.weight"])


def test_the_mean_is_what_is_played(make_trainer, averaged, tmp_path):
    trainer = make_trainer(OVER)
    policy = load_policy(saved(averaged[-1], tmp_path), trainer.env, trainer._agent)
    mean = averaged[-1]["averaged_state_dict"]["mlp.0.weight"]
    first, second, third = (state["actor_state_dict"]["mlp.0.weight"] for state in averaged)
    torch.testing.assert_close(mean, ((first + second) / 2 + third) / 2)
    assert torch.equal(policy.state_dict()["mlp.0.weight"], mean)
    trainer.load_state_dict(copy.deepcopy(averaged[0]))
    list(trainer.learn(3))
    with trainer.played() as played:
        assert torch.equal(played.state_dict()["mlp.0.weight"], mean)
    assert of_state(trainer.state_dict()) == of_state(averaged[-1])
