"""Test that the update with CUDA graphs equals rsl_rl's update; without a GPU, minibatches run without capture."""

from __future__ import annotations

import copy
import json
import os

import pytest
import torch
from forks import forking
from jobs.ranks import end, start
from jobs.small import TINY

from wheelleg_exp.rl.ppo_graphs import CapturedUpdate, can_capture_update, is_plain_ppo

pytestmark = pytest.mark.slow

DEVICE = os.environ.get("WHEELLEG_TEST_DEVICE", "cpu")
UPDATES = 3


def updated(trainer, update) -> tuple[list[dict], list[float]]:
    """Return the losses and learning rates of several iterations."""
    losses, rates = [], []
    for index in range(UPDATES):
        torch.manual_seed(2 * index)
        trainer._collect()
        torch.manual_seed(2 * index + 1)  # rsl_rl also draws actions in the update.
        losses.append(update())
        rates.append(trainer.algorithm.learning_rate)
    return losses, rates


@pytest.mark.parametrize(
    "changes",
    [
        ("agent.actor.obs_normalization=true",),
        ("agent.algorithm.normalize_advantage_per_mini_batch=true", "agent.algorithm.use_clipped_value_loss=false"),
        ("agent=ppo_mirror_loss", "agent.actor.obs_normalization=true"),
        ("agent=ppo_mirror_loss", "agent.algorithm.symmetry_cfg.use_mirror_loss=false"),
    ],
)
def test_an_update_is_that_of_rsl_rl(make_trainer, changes):
    words = (*changes, f"agent.device={DEVICE}", "agent.algorithm.desired_kl=0.002")
    ours, theirs = make_trainer(*words), make_trainer(*words)
    assert is_plain_ppo(ours.algorithm)
    found = updated(ours, CapturedUpdate(ours.algorithm))
    if theirs.algorithm.symmetry:
        del theirs.algorithm.symmetry.compute_loss  # Restore rsl_rl's own method.
    expected = updated(theirs, theirs.algorithm.update)
    near = 1e-5 if DEVICE == "cpu" else 1e-3
    for mine, others in zip(found[0], expected[0], strict=True):
        assert mine == pytest.approx(others, rel=near, abs=near)
    assert found[1] == pytest.approx(expected[1], rel=1e-6)
    assert len(set(found[1])) > 1  # the learning rate has changed
    for mine, others in zip(ours.networks(), theirs.networks(), strict=True):
        for name, value in mine.state_dict().items():
            torch.testing.assert_close(value, others.state_dict()[name], atol=near, rtol=near)
    assert ours.algorithm.optimizer.param_groups[0]["lr"] == ours.algorithm.learning_rate
    assert ours.algorithm.optimizer.param_groups[0]["fused"] is theirs.algorithm.optimizer.param_groups[0]["fused"]


def test_acting_as_a_graph_is_acting(make_trainer):
    if DEVICE == "cpu":
        pytest.skip("CUDA graphs need a GPU")
    ours, theirs = (make_trainer(f"agent.device={DEVICE}", f"agent.graph_update={on}") for on in ("true", "false"))
    for trainer in (ours, theirs):
        torch.manual_seed(5)
        for _ in range(3):
            trainer._collect()
            found = trainer.algorithm.storage.actions.clone(), trainer.algorithm.storage.actions_log_prob.clone()
            trainer.algorithm.storage.clear()
        trainer.found = found
    assert ours._ppo.act._graph is not None
    for mine, others in zip(ours.found, theirs.found, strict=True):
        torch.testing.assert_close(mine, others, atol=1e-3, rtol=1e-3)


def test_a_loaded_state_continues(make_trainer):
    trainer = make_trainer(f"agent.device={DEVICE}")
    update = CapturedUpdate(trainer.algorithm)
    updated(trainer, update)
    saved, rng = copy.deepcopy(trainer.algorithm.save()), torch.get_rng_state()
    env, first = trainer.env.env.state_dict(), []
    for _ in range(2):
        trainer.algorithm.load(copy.deepcopy(saved), None, True)
        trainer.env.env.load_state_dict(env)
        torch.set_rng_state(rng)
        torch.manual_seed(0)
        first.append(updated(trainer, update)[0][0]["value"])
    assert first[0] == pytest.approx(first[1], rel=1e-5)


def test_what_it_does_not_do_is_rsl_rls(make_trainer):
    trainer = make_trainer()
    assert not can_capture_update(trainer.algorithm)  # on a CPU
    assert not is_plain_ppo(make_trainer("agent.algorithm.optimizer=sgd").algorithm)
    assert not is_plain_ppo(make_trainer("agent=ppo_symmetry").algorithm)
    words = ("agent.critic.class_name=RNNModel", "+agent.critic.rnn_type=gru", "+agent.critic.rnn_hidden_dim=8")
    assert not is_plain_ppo(make_trainer(*words, "+agent.critic.rnn_num_layers=1").algorithm)


# Each process updates one trainer with rsl_rl's update and another trainer with the captured update.
_TOGETHER = """
import json, os, sys
os.environ["MASTER_PORT"] = str(json.loads(sys.argv[2])[0])
*words, mjcf = json.loads(sys.argv[1])[0]
from pathlib import Path
import torch
from wheelleg_exp.config.composing.compose import compose
from wheelleg_exp.env import ManagerBasedRLEnv
from wheelleg_exp.rl.options import read_agent
from wheelleg_exp.rl.ppo_graphs import CapturedUpdate, is_plain_ppo
from wheelleg_exp.rl.ranks import joined
from wheelleg_exp.rl.trainer import Trainer
from wheelleg_exp.rl.vec_env import RslRlVecEnv

torch.set_num_threads(1)
with joined() as ranks:
    config, said = compose(words).config, []
    for is_ours in (True, False):
        env = ManagerBasedRLEnv(config["env"], Path(mjcf), ranks.seed(0))
        trainer = Trainer(RslRlVecEnv(env, None), read_agent(config["agent"]), 0, ranks=ranks)
        algorithm = trainer.algorithm
        assert is_plain_ppo(algorithm) and algorithm.is_multi_gpu
        algorithm.broadcast_parameters()
        update, rates, losses = CapturedUpdate(algorithm) if is_ours else algorithm.update, [], []
        for index in range(3):
            torch.manual_seed(2 * index + ranks.rank)
            trainer._collect()
            torch.manual_seed(100 + index + ranks.rank)
            losses.append(update())
            rates.append(algorithm.learning_rate)
        weights = torch.cat([p.detach().flatten() for n in trainer.networks() for p in n.parameters()])
        said.append([rates, losses, weights.tolist()])
    print(json.dumps(said), flush=True)
"""


def test_processes_that_train_together_update_as_rsl_rl_does(mjcf, tmp_path):
    words = ["task=stand", *TINY, "agent.algorithm.desired_kl=0.002", str(mjcf)]
    with forking():
        found = end(start([words], tmp_path, _TOGETHER))
    assert all(out for _, out, _ in found), found
    ours, theirs = zip(*(json.loads(out) for _, out, _ in found), strict=True)
    for (rates, losses, weights), (their_rates, their_losses, their_weights) in zip(ours, theirs, strict=True):
        assert rates == pytest.approx(their_rates, rel=1e-6)
        for mine, others in zip(losses, their_losses, strict=True):
            assert mine == pytest.approx(others, rel=1e-5, abs=1e-5)
        assert weights == pytest.approx(their_weights, abs=1e-5)
    assert (ours[0][0], ours[0][2]) == (ours[1][0], ours[1][2])
    assert len(set(ours[0][0])) > 1  # the learning rate has changed
    assert ours[0][1] != ours[1][1]  # Each process collected different samples.
