"""CleanRL's PPO for continuous actions: its environments, and what its loop reads of a step."""

import gymnasium as gym
import numpy as np
import pytest
import torch

SHORT = ["env.sim.nthread=1", "env.episode_length_s=0.2"]  # 12 control steps
ID = "wheelleg_exp:Wheelleg-Velocity-v0"
N = 2


def make_env():
    env = gym.make(ID, overrides=SHORT)
    env = gym.wrappers.FlattenObservation(env)
    env = gym.wrappers.RecordEpisodeStatistics(env)
    env = gym.wrappers.ClipAction(env)
    env = gym.wrappers.NormalizeObservation(env)
    env = gym.wrappers.TransformObservation(env, lambda obs: np.clip(obs, -10, 10), env.observation_space)
    env = gym.wrappers.NormalizeReward(env, gamma=0.99)
    return gym.wrappers.TransformReward(env, lambda reward: np.clip(reward, -10, 10))


@pytest.mark.filterwarnings("default")
def test_its_row_of_single_environments():
    """CleanRL's loop allocates tensors by the single spaces, and reads ends from ``final_info``."""
    envs = gym.vector.SyncVectorEnv([make_env] * N, autoreset_mode=gym.vector.AutoresetMode.SAME_STEP)
    assert isinstance(envs.single_action_space, gym.spaces.Box)
    obs = torch.zeros((13, N, *envs.single_observation_space.shape))
    actions = torch.zeros((13, N, *envs.single_action_space.shape))
    assert (obs.shape, actions.shape) == ((13, N, 315), (13, N, 6))
    next_obs, _ = envs.reset(seed=1)
    for step in range(13):
        obs[step] = torch.Tensor(next_obs)
        actions[step] = torch.randn(N, 6, generator=torch.Generator().manual_seed(step))
        next_obs, reward, terminations, truncations, infos = envs.step(actions[step].numpy())
        assert np.isfinite(reward).all()
        assert np.logical_or(terminations, truncations).tolist() == [step == 11] * N
        assert ("final_info" in infos) == (step == 11)
        if "final_info" in infos:
            over = np.nonzero(infos["final_info"]["_episode"])[0]
            assert over.tolist() == [0, 1]
            assert infos["final_info"]["episode"]["l"][over].tolist() == [12, 12]
    assert obs.isfinite().all()
    envs.close()
