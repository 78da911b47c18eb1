"""Test training: networks from the config, logged scalars, streams, the adapter, and rsl_rl's extensions."""

from __future__ import annotations

import copy

import pytest
import torch

from wheelleg_exp.errors import ConfigError, RunDirectoryError
from wheelleg_exp.rl.algorithm import build_algorithm
from wheelleg_exp.rl.network_loading import load_policy
from wheelleg_exp.rl.options import read_agent
from wheelleg_exp.rl.vec_env import RslRlVecEnv

from .conftest import saved


@pytest.fixture(scope="module")
def trainer(make_trainer):
    """Return a trainer for tests that do not depend on the trainer's state."""
    return make_trainer()


def finish(trainer, until):
    return list(trainer.learn(until=until))


# --- networks ---


def test_the_stock_networks_have_the_articles_sizes(make_trainer):
    wide = ["agent.actor.hidden_dims=[512,256,128]", "agent.critic.hidden_dims=[512,256,128]"]
    algorithm = make_trainer(*wide, "env.num_envs=2").algorithm
    for net, inputs, outputs in ((algorithm.actor, 135, 6), (algorithm.critic, 180, 1)):
        weights = [p for name, p in net.named_parameters() if name.startswith("mlp") and p.ndim == 2]
        assert [tuple(p.shape) for p in weights] == [(512, inputs), (256, 512), (128, 256), (outputs, 128)]


def test_the_seed_decides_the_first_weights(make_trainer):
    def weights(seed):
        return torch.cat([p.detach().flatten() for p in make_trainer(seed=seed).algorithm.actor.parameters()])

    first = weights(0)
    torch.manual_seed(123)  # Earlier draws must not change the weights.
    assert torch.equal(weights(0), first)
    assert not torch.equal(weights(1), first)


def test_the_agent_section_is_left_as_it_was(trainer, tiny_config):
    agent = tiny_config()["agent"]
    before = repr(agent)
    build_algorithm(trainer.env, read_agent(agent))
    assert repr(agent) == before


def test_an_unknown_observation_group_is_reported_with_the_nearest(trainer, tiny_config):
    agent = tiny_config()["agent"] | {"obs_groups": {"actor": ["polcy"], "critic": ["critic"]}}
    with pytest.raises(ConfigError) as caught:
        build_algorithm(trainer.env, read_agent(agent))
    error = caught.value
    assert (error.key, error.nearest) == ("agent.obs_groups.actor", "policy")
    assert "critic" in str(error.expected)


@pytest.mark.parametrize(
    ("section", "value"),
    [
        ("algorithm", {"optimizer": "adm"}),
        ("algorithm", {"gama": 0.9}),
        ("algorithm", {"class_name": "PPPO"}),
        ("actor", {"activation": "eluu"}),
        ("actor", {"class_name": "MLPMdel"}),
        ("actor", {"distribution_cfg": {"class_name": "Gaussian"}}),
        ("device", "cuda:77"),
    ],
)
def test_a_value_that_rsl_rl_rejects_is_a_mistake_of_the_config(trainer, tiny_config, section, value):
    agent = tiny_config()["agent"]
    changed = value if section == "device" else agent[section] | value
    with pytest.raises(ConfigError, match=r"agent\.device" if section == "device" else "agent") as caught:
        build_algorithm(trainer.env, read_agent(agent | {section: changed}))
    assert len(str(caught.value).splitlines()) == 1


# --- logged scalars of an iteration ---


@pytest.mark.train
def test_an_iteration_logs_the_scalars_of_rsl_rl_and_isaac_lab(make_trainer):
    trainer = make_trainer()
    (first,) = finish(trainer, 1)
    assert [done.index for done in (first, *finish(trainer, 3), *finish(trainer, 3))] == [0, 1, 2]
    assert (trainer.state_dict()["iter"], first.env_steps) == (2, 16 * 24)
    keys = [f"Loss/{name}" for name in ("value", "surrogate", "entropy", "learning_rate")]
    keys += [f"Perf/{name}" for name in ("total_fps", "collection_time", "learning_time")]
    keys += ["Policy/mean_std", "Train/mean_reward", "Train/mean_episode_length", "Episode_Reward/alive"]
    keys += ["Episode_Termination/time_out", "Metrics/base_velocity/error_vel_xy", "Curriculum/lin_vel_z_weight"]
    for key in keys:
        assert isinstance(first.scalars[key], float), key
    assert first.scalars["Train/mean_episode_length"] <= 18
    assert first.scalars["Policy/mean_std"] == pytest.approx(1.0, abs=0.1)


@pytest.mark.train
def test_returns_are_those_of_the_environment(make_trainer):
    trainer, rewards, ends = make_trainer(), [], []
    step = trainer.env.step

    def spy(actions):
        result = step(actions)
        rewards.append(result[1].clone())
        ends.append(result[2].bool())
        return result

    trainer.env.step = spy
    (done,) = finish(trainer, 1)
    returns, running = [], torch.zeros(16)
    for reward, end in zip(rewards, ends, strict=True):
        running = running + reward
        returns += running[end].tolist()
        running = running * ~end
    assert done.scalars["Train/mean_reward"] == pytest.approx(sum(returns[-100:]) / len(returns[-100:]), rel=1e-5)


# A policy that sees every second robot in a mirror learns the mean of the actions and their mirror images.
@pytest.mark.parametrize(
    ("agent", "learnt"), [("ppo", [0.3, -0.2, 0.1, 0.4, -0.5, 0.6]), ("ppo_mirrored", [0.2, 0.1, 0.2, 0.1, 0.05, 0.05])]
)
def test_a_warm_start_teaches_the_policy_the_controllers_actions(make_trainer, agent, learnt):
    actions = torch.tensor([0.3, -0.2, 0.1, 0.4, -0.5, 0.6]).expand(16, 6)
    trainer = make_trainer(f"agent={agent}", "agent.warm_start=15", controller=lambda: actions)
    before = copy.deepcopy(trainer.env.env.state_dict())
    finish(trainer, 0)
    assert trainer.iteration == 0
    torch.testing.assert_close(trainer.env.env.state_dict(), before, rtol=0.0, atol=0.0)
    with torch.no_grad():
        found = trainer.algorithm.actor(trainer.env.get_observations())
    assert (found - torch.tensor(learnt)).abs().max() < 0.1


def test_a_recurrent_policy_cannot_imitate(make_trainer):
    words = ("actor.class_name=RNNModel", "+agent.actor.rnn_type=lstm", "+agent.actor.rnn_hidden_dim=8")
    with pytest.raises(ConfigError, match=r"agent\.warm_start"):
        make_trainer(f"agent.{words[0]}", *words[1:], "+agent.actor.rnn_num_layers=1", controller=lambda: None)


def test_a_checkpoint_of_other_networks_does_not_fit(trainer, tiny_config, tmp_path):
    path = saved(trainer.state_dict(), tmp_path)
    with pytest.raises(RunDirectoryError) as caught:
        load_policy(path, trainer.env, read_agent(tiny_config("agent.actor.hidden_dims=[4]")["agent"]))
    assert str(path) in str(caught.value)


# --- streams ---


def test_draws_of_the_policy_and_of_the_environment_leave_each_others_streams_alone(trainer):
    env = trainer.env.env
    before = {path: value.clone() for path, value in env.streams.state_dict()["generators"].items()}
    for _ in range(5):
        trainer.algorithm.act(trainer.env.get_observations())
    after = env.streams.state_dict()["generators"]
    assert before.keys() == after.keys()
    assert all(torch.equal(before[path], after[path]) for path in before)
    stream = torch.get_rng_state()
    for _ in range(20):  # The loop runs past the end of an episode.
        trainer.env.step(torch.zeros(16, 6))
    assert torch.equal(torch.get_rng_state(), stream)


# --- the adapter ---


def test_the_adapter_clips_only_when_asked(trainer, make_trainer):
    for made, expected in ((trainer, 3.0), (make_trainer("+agent.clip_actions=0.5"), 0.5)):
        made.env.step(torch.full((16, 6), 3.0))
        assert (made.env.env.action_manager.action == expected).all()


def test_the_adapter_separates_time_outs_from_failures(make_trainer):
    adapter = make_trainer().env
    pose = torch.tensor([[0.0, 0.0, 0.015, 0.0, 1.0, 0.0, 0.0]])
    pose[:, :3] += adapter.env.scene.env_origins[3]
    adapter.env.scene.robot.write_root_pose_to_sim(pose, torch.tensor([3]))
    adapter.env.scene.refresh()
    _, _, dones, extras = adapter.step(torch.zeros(16, 6))
    assert dones.nonzero().squeeze(1).tolist() == [3]
    assert not extras["time_outs"].any()
    for _ in range(17):
        _, _, dones, extras = adapter.step(torch.zeros(16, 6))
    assert dones.dtype == torch.long
    assert extras["time_outs"].tolist() == [i != 3 for i in range(16)]


@pytest.mark.parametrize("finite", [False, True])
def test_time_outs_of_a_finite_horizon_are_ends_like_any_other(make_env, finite):
    adapter = RslRlVecEnv(make_env(episode_length_s=0.02, is_finite_horizon=finite))
    _, _, dones, extras = adapter.step(torch.zeros(4, 4))
    assert dones.tolist() == [1] * 4
    assert ("time_outs" in extras) is not finite


def test_episode_lengths_that_are_set_shift_no_timers_and_no_commands(make_trainer):
    adapter = make_trainer().env
    env = adapter.env
    command = env.command_manager.get_term("base_velocity")
    before = copy.deepcopy((command.time_left, command.command, env.event_manager.state_dict()["_time_left"]))
    drawn = torch.arange(16)  # of 18 control steps
    adapter.episode_length_buf = drawn
    after = command.time_left, command.command, env.event_manager.state_dict()["_time_left"]
    assert str(before) == str(after)
    adapter.step(torch.zeros(16, 6))
    assert env.episode_length_buf.tolist() == (drawn + 1).tolist()


# --- rsl_rl's extensions ---


@pytest.mark.train
def test_what_has_been_seen_is_no_longer_new(make_trainer):
    losses = [done.scalars["Loss/rnd"] for done in make_trainer("agent=ppo_rnd").learn(until=8)]
    assert all(loss > 0.0 for loss in losses)
    assert losses[-1] < 0.5 * max(losses[:3])


@pytest.mark.train
def test_novelty_is_rewarded_by_the_weight_and_the_control_step(make_trainer):
    plain = ["agent.algorithm.rnd_cfg.reward_normalization=false", "agent.algorithm.rnd_cfg.weight_schedule=null"]
    trainer = make_trainer("agent=ppo_rnd", *plain, "agent.algorithm.rnd_cfg.weight=3.0")
    rnd, seen = trainer.algorithm.rnd, trainer.env.get_observations()
    with torch.inference_mode():
        state = (seen["policy"] - rnd.state_normalizer._mean) / (rnd.state_normalizer._std + rnd.state_normalizer.eps)
        error = rnd.target(state) - rnd.predictor(state)
        expected = 3.0 / 60.0 * error.square().sum(dim=1).sqrt()
        torch.testing.assert_close(rnd.get_intrinsic_reward(seen), expected)


@pytest.mark.train
@pytest.mark.parametrize(
    "words", [["agent=ppo_symmetry", "agent.algorithm.symmetry_cfg.use_mirror_loss=true"], ["agent=ppo_mirror_loss"]]
)
def test_mirror_images_make_a_policy_its_own_image(make_trainer, words):
    losses = [
        [done.scalars["Loss/symmetry"] for done in make_trainer(*words, f"{key}={factor}").learn(until=4)][-1]
        for key, factor in [("agent.algorithm.symmetry_cfg.mirror_loss_coeff", c) for c in (0.0, 10.0)]
    ]
    assert losses[1] < 0.5 * losses[0]
