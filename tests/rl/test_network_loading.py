"""Test how a training treats the policy with which it starts: the warm critic, and the loss ``agent.initial_kl``."""

from __future__ import annotations

import os

import pytest
import torch
from tensordict import TensorDict
from torch.distributions import Independent, Normal, kl_divergence

from wheelleg_exp.errors import ConfigError
from wheelleg_exp.rl.network_loading import Initial
from wheelleg_exp.state import cloned

DEVICE = os.environ.get("WHEELLEG_TEST_DEVICE", "cpu")
NORMALISED = ("agent.actor.obs_normalization=true", "agent.critic.obs_normalization=true")
KL = "+agent.initial_kl={weight: 1.0, except_while: velocity_commands}"


@pytest.fixture(scope="module")
def source(make_trainer):
    """Return a trainer whose observation normalisation has learned."""
    trainer = make_trainer(*NORMALISED, seed=7)
    list(trainer.learn(until=1))
    return trainer


@pytest.fixture(scope="module")
def initial(source):
    return Initial(source.state_dict(), ("actor",), {})


@pytest.mark.train
@pytest.mark.parametrize("changes", [(), ("agent=ppo_mirror_loss", KL)])  # rsl_rl's update, and that of CapturedUpdate
def test_a_warm_critic_leaves_the_policy_unchanged(make_trainer, initial, changes):
    words = ("+agent.warm_critic=2", "agent.algorithm.learning_rate=1e-5", "agent.average_iterations=3")
    words += (f"agent.device={DEVICE}",)
    trainer = make_trainer(*changes, *NORMALISED, *words, initial=initial)
    actor, critic = (cloned(network.state_dict()) for network in trainer.networks())
    rates = [done.scalars["Loss/learning_rate"] for done in trainer.learn(until=2)]
    assert rates == pytest.approx([1e-5, 1e-5])
    policy, value = (network.state_dict() for network in trainer.networks())
    assert all(torch.equal(policy[name], actor[name]) for name in actor)
    assert (value["mlp.0.weight"] - critic["mlp.0.weight"]).abs().max() > 1e-3  # 16 steps with 1e-5 give 1.6e-4
    assert all(not torch.equal(value[name], critic[name]) for name in critic)
    (done,) = trainer.learn(until=3)
    assert all(not torch.equal(trainer.algorithm.actor.state_dict()[name], actor[name]) for name in actor)
    averaged = trainer.average.state_dict()["averaged_state_dict"]
    assert torch.equal(averaged["mlp.0.weight"], trainer.algorithm.actor.state_dict()["mlp.0.weight"])
    assert done.scalars["Loss/learning_rate"] != rates[0]  # the adaptive schedule
    before = cloned(trainer.algorithm.actor.state_dict())
    list(trainer.learn(until=4))  # On a GPU, this is the first captured update of the policy.
    assert all(not torch.equal(trainer.algorithm.actor.state_dict()[name], before[name]) for name in before)


def test_the_loss_is_the_kl_divergence_outside_the_excepted_samples(make_trainer, source, initial):
    trainer = make_trainer(*NORMALISED, KL, initial=initial)
    policy = trainer._initial_policy(trainer._agent, initial)
    actor = trainer.algorithm.actor
    with torch.no_grad():
        for parameter in actor.parameters():
            parameter.add_(0.01 * torch.randn_like(parameter)).abs_()
        actor.obs_normalizer._mean.add_(0.5)
    samples = torch.randn(8, 135)
    commands = trainer.env.env.observation_manager.term_slices("policy")["velocity_commands"]
    samples[::2, commands] = 0.0
    samples[1, commands.start : commands.stop - 1] = 0.0  # One value that is not 0 excepts a sample.
    means, stds = [], []
    for network in (actor, source.algorithm.actor):
        normal = network.obs_normalizer
        means.append(network.mlp((samples - normal._mean) / (normal._std + normal.eps)))
        stds.append(network.distribution.std_param.expand(8, 6))
    now, first = (Independent(Normal(mean, std), 1) for mean, std in zip(means, stds, strict=True))
    observations = TensorDict({"policy": samples}, batch_size=[8])
    actor(observations, stochastic_output=True)
    expected = kl_divergence(now, first)[::2].sum() / 8
    assert expected > 0.1
    torch.testing.assert_close(policy.loss(actor, observations), expected)


@pytest.mark.train
def test_a_larger_weight_keeps_the_policy_nearer(make_trainer, initial):
    found = []
    for weight in (0.0, 100.0):
        word = f"+agent.initial_kl={{weight: {weight}}}"
        trainer = make_trainer(*NORMALISED, word, "agent.algorithm.schedule=fixed", initial=initial)
        found.append([done.scalars["Loss/initial_kl"] for done in trainer.learn(until=4)][-1])
    assert found[1] < 0.2 * found[0]


RECURRENT = ("agent.actor.class_name=RNNModel", "+agent.actor.rnn_type=lstm", "+agent.actor.rnn_hidden_dim=8")


@pytest.mark.parametrize(
    ("words", "key", "message"),
    [
        ((KL,), "agent.initial_kl", "no initial policy"),
        ((KL, *RECURRENT, "+agent.actor.rnn_num_layers=1"), "agent.initial_kl", "without this loss"),
        ((KL, "agent=ppo_symmetry"), "agent.initial_kl", "without this loss"),
        (("+agent.initial_kl={weight: 1.0, except_while: jump}",), "agent.initial_kl.except_while", "no network sees"),
    ],
)
def test_an_unsupported_loss_is_refused(make_trainer, words, key, message):
    initial = None if words == (KL,) else Initial({}, (), {})
    if "jump" in words[0]:
        initial = Initial(make_trainer().state_dict(), ("actor",), {})
    with pytest.raises(ConfigError, match=message) as caught:
        make_trainer(*words, initial=initial)
    assert caught.value.key == key


@pytest.mark.parametrize("words", [(), NORMALISED, ("+env.observations.policy.terms.last_action.action_name=leg_pos",)])
def test_a_policy_moves_the_legs_as_before_after_their_scale_has_changed(make_trainer, words):
    before = make_trainer(*words, seed=7)
    list(before.learn(until=1))
    scale = float(before.env.cfg["actions"]["leg_pos"]["scale"])
    initial = Initial(before.state_dict(), ("actor", "critic"), {"scales": {"leg_pos": 0.5}})
    after = make_trainer(*words, f"env.actions.leg_pos.scale={2.0 * scale}", initial=initial)
    seen = before.env.get_observations().clone()
    legs = [name for name, term in before.env.env.action_manager._action_terms.items() for _ in range(term.action_dim)]
    ratio = torch.tensor([0.5 if name == "leg_pos" else 1.0 for name in legs])
    converted = seen.clone()
    for group in ("policy", "critic"):
        (last,) = before.env.env.observation_manager.term_parts(group)["last_action"]
        own = ratio[:4] if group == "policy" and "action_name" in "".join(words) else ratio  # only the legs' actions
        converted[group][:, last] = seen[group][:, last] * own.repeat((last.stop - last.start) // len(own))
    assert not torch.equal(converted["policy"], seen["policy"])
    for one, other, unit in zip(before.networks(), after.networks(), (ratio, 1.0), strict=True):
        torch.testing.assert_close(other.eval()(converted), one.eval()(seen) * unit, rtol=1e-4, atol=1e-5)
