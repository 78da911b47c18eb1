"""Stable-Baselines3: its checker, its PPO, and that its numbers are ours."""

import warnings

import gymnasium
import numpy as np
import pytest
from gymnasium.wrappers import FilterObservation, FlattenObservation

pytest.importorskip("stable_baselines3", reason="stable-baselines3 is not installed: nox -s clients")
from stable_baselines3 import PPO
from stable_baselines3.common.env_checker import check_env
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import SubprocVecEnv

import wheelleg_exp  # noqa: F401
from wheelleg_exp.gym import ENV_ID

pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("default")]
SHORT = ["env.sim.nthread=1", "env.episode_length_s=0.2"]  # 12 control steps


def make(**options):
    return gymnasium.make(ENV_ID, action_bound=1.0, overrides=SHORT, **options)


def test_its_checker_finds_nothing_and_names_missing_bounds():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(make(), warn=True)
    with pytest.raises(AssertionError, match="finite"):
        check_env(gymnasium.make(ENV_ID, overrides=SHORT))


@pytest.mark.parametrize("policy", ["MultiInputPolicy", "MlpPolicy"])
def test_ppo_learns_on_it(policy):
    env = make() if policy == "MultiInputPolicy" else FlattenObservation(FilterObservation(make(), ["policy"]))
    model = PPO(policy, env, n_steps=48, batch_size=24, n_epochs=1, seed=0, device="cpu")
    before = model.policy.state_dict()["log_std"].clone()
    model.learn(96)
    assert not np.array_equal(model.policy.state_dict()["log_std"], before)
    assert [episode["l"] for episode in model.ep_info_buffer] == [12] * 8
    observed = model.get_env().reset()
    assert model.predict(observed, deterministic=True)[0].shape == (1, 6)


def test_a_batch_of_its_own_gives_the_numbers_of_the_environment():
    theirs = make_vec_env(ENV_ID, n_envs=2, seed=5, env_kwargs={"action_bound": 1.0, "overrides": SHORT})
    ours = [make() for _ in range(2)]
    first = [env.reset(seed=5 + i)[0] for i, env in enumerate(ours)]
    observed = theirs.reset()
    for i in range(2):
        np.testing.assert_array_equal(observed["critic"][i], first[i]["critic"])
    actions = np.random.default_rng(0).uniform(-1, 1, (12, 2, 6)).astype(np.float32)
    for k in range(12):
        observed, rewards, dones, infos = theirs.step(actions[k])
        stepped = [env.step(actions[k, i]) for i, env in enumerate(ours)]
        np.testing.assert_allclose(rewards, [step[1] for step in stepped], rtol=1e-6)
    assert dones.all()
    for i in range(2):
        np.testing.assert_array_equal(infos[i]["terminal_observation"]["policy"], stepped[i][0]["policy"])
        assert infos[i]["TimeLimit.truncated"] is True
        assert infos[i]["episode"]["l"] == 12
        np.testing.assert_array_equal(observed["policy"][i], ours[i].reset()[0]["policy"])


def test_its_processes_hold_our_environments():
    """A new process has not imported this package, so the id names the package."""
    env = make_vec_env(
        f"wheelleg_exp:{ENV_ID}", n_envs=2, seed=5, env_kwargs={"overrides": SHORT}, vec_env_cls=SubprocVecEnv,
        vec_env_kwargs={"start_method": "spawn"},
    )  # fmt: skip
    try:
        assert env.reset()["policy"].shape == (2, 135)
        assert env.step(np.zeros((2, 6), np.float32))[1].shape == (2,)
    finally:
        env.close()
