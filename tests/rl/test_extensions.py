"""Test that stock configs of rsl_rl's extensions learn, and that a resumed training is bit-identical."""

import pytest
import torch

from wheelleg_exp.rl import checkpoint

from .conftest import saved, without_times

pytestmark = pytest.mark.train


@pytest.mark.parametrize("agent", ["ppo_rnd", "ppo_symmetry", "ppo_mirrored", "ppo_mirror_loss"])
def test_three_iterations_are_one_and_two_more(make_trainer, tmp_path, agent):
    trainer = make_trainer(f"agent={agent}")
    running = trainer.learn(until=3)
    next(running)
    path = saved(trainer.state_dict(), tmp_path)
    straight = list(running)
    second = make_trainer(f"agent={agent}", seed=5)
    second.load_state_dict(checkpoint.load(path))
    later = list(second.learn(until=3))
    assert [without_times(done) for done in later] == [without_times(done) for done in straight]
    assert checkpoint.serialize(second.state_dict()) == checkpoint.serialize(trainer.state_dict())


def test_what_has_been_seen_is_no_longer_new(make_trainer):
    losses = [done.scalars["Loss/rnd"] for done in make_trainer("agent=ppo_rnd").learn(until=8)]
    assert all(loss > 0.0 for loss in losses)
    assert losses[-1] < 0.5 * max(losses[:3])


def test_novelty_is_rewarded_by_the_weight_and_the_control_step(make_trainer):
    plain = ["agent.algorithm.rnd_cfg.reward_normalization=false", "agent.algorithm.rnd_cfg.weight_schedule=null"]
    trainer = make_trainer("agent=ppo_rnd", *plain, "agent.algorithm.rnd_cfg.weight=3.0")
    rnd, seen = trainer.algorithm.rnd, trainer.env.get_observations()
    with torch.inference_mode():
        state = (seen["policy"] - rnd.state_normalizer._mean) / (rnd.state_normalizer._std + rnd.state_normalizer.eps)
        error = rnd.target(state) - rnd.predictor(state)
        expected = 3.0 / 60.0 * error.square().sum(dim=1).sqrt()
        torch.testing.assert_close(rnd.get_intrinsic_reward(seen), expected)


@pytest.mark.parametrize(
    "words", [["agent=ppo_symmetry", "agent.algorithm.symmetry_cfg.use_mirror_loss=true"], ["agent=ppo_mirror_loss"]]
)
def test_mirror_images_make_a_policy_its_own_image(make_trainer, words):
    losses = [
        [done.scalars["Loss/symmetry"] for done in make_trainer(*words, f"{key}={factor}").learn(until=4)][-1]
        for key, factor in [("agent.algorithm.symmetry_cfg.mirror_loss_coeff", c) for c in (0.0, 10.0)]
    ]
    assert losses[1] < 0.5 * losses[0]
