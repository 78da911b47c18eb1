"""skrl: its wrapper around a single environment and around our batch, and an agent of its own that learns."""

import gymnasium
import numpy as np
import pytest
import torch

pytest.importorskip("skrl", reason="skrl is not installed: nox -s clients")
from skrl.envs.wrappers.torch import wrap_env

import wheelleg_exp  # noqa: F401
from wheelleg_exp.gym import ENV_ID

pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("default")]
SHORT = ["env.sim.nthread=1", "env.episode_length_s=0.2"]


@pytest.mark.parametrize("num_envs", [1, 3])
def test_its_wrapper_takes_both(num_envs):
    batch = {} if num_envs == 1 else {"num_envs": num_envs}
    env = wrap_env((gymnasium.make_vec if batch else gymnasium.make)(ENV_ID, overrides=SHORT, **batch))
    assert (env.num_envs, env.observation_space["policy"].shape, env.action_space.shape) == (num_envs, (135,), (6,))
    observed, _ = env.reset()
    assert observed.shape == (num_envs, 315)
    for k in range(12):
        observed, rewards, _, truncated, _ = env.step(torch.zeros(num_envs, 6))
        assert (observed.shape, rewards.shape) == ((num_envs, 315), (num_envs, 1))
        assert truncated.flatten().tolist() == [k == 11] * num_envs
    env.close()


def test_what_it_returns_is_what_we_return():
    """skrl flattens a Dict in the order of the space, in which critic comes before policy."""
    options = {"num_envs": 2, "overrides": SHORT}
    env, plain = wrap_env(gymnasium.make_vec(ENV_ID, **options)), gymnasium.make_vec(ENV_ID, **options)
    env._seed = 3
    found, (expected, _) = env.reset()[0], plain.reset(seed=3)
    np.testing.assert_array_equal(found, np.hstack([expected[group] for group in plain.single_observation_space]))
    found, reward, *_ = env.step(torch.ones(2, 6))
    expected, rewards, *_ = plain.step(np.ones((2, 6), np.float32))
    np.testing.assert_array_equal(found, np.hstack([expected[group] for group in plain.single_observation_space]))
    np.testing.assert_allclose(reward.flatten(), rewards, rtol=1e-6)
    assert env.render() == (None, None)  # skrl's trainers call render in every mode
    env.close()
