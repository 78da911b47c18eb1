"""``gymnasium.make_vec``: batched spaces and modes of autoreset; test_sync_layout checks seeds, logs, and layout."""

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, VectorEnv

from wheelleg_exp.errors import ConfigError
from wheelleg_exp.gym import ENV_ID

N = 4
ONE_THREAD = ["env.sim.nthread=1"]


@pytest.fixture(scope="module")
def env(_cache):
    return gymnasium.make_vec(ENV_ID, num_envs=N, overrides=ONE_THREAD)


def test_it_is_a_vector_env_with_batched_float32_spaces(env):
    assert (type(env.unwrapped).__name__, isinstance(env, VectorEnv)) == ("WheellegVectorEnv", True)
    assert env.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
    assert (env.num_envs, *map(env.unwrapped.call, ("render_mode", "render"))) == (N, (None,) * N, (None,) * N)
    assert {g: b.shape for g, b in env.observation_space.items()} == {"policy": (N, 135), "critic": (N, 180)}
    assert {g: b.shape for g, b in env.single_observation_space.items()} == {"policy": (135,), "critic": (180,)}
    assert (env.action_space.shape, env.single_action_space.shape) == ((N, 6), (6,))
    assert env.action_space.dtype == env.observation_space["policy"].dtype == np.float32


def test_the_results_of_a_step_fit_the_spaces_and_are_copies(env):
    observations, infos = env.reset(seed=0)
    assert infos == {}
    assert env.observation_space.contains(observations)
    observations, rewards, terminated, truncated, _ = env.step(np.zeros((N, 6), np.float32))
    assert env.observation_space.contains(observations)
    assert (rewards.shape, rewards.dtype.kind) == ((N,), "f")
    assert (terminated.shape, terminated.dtype, truncated.dtype) == ((N,), np.bool_, np.bool_)
    results = [observations["policy"], rewards, terminated, truncated]
    copies = [result.copy() for result in results]
    for _ in range(40):
        env.step(np.ones((N, 6), np.float32))
    assert all(map(np.array_equal, results, copies))


def test_several_seeds_actions_of_another_shape_and_zero_environments_are_refused(env):
    for seed in ([], [1, 2, 3, 4]):
        with pytest.raises(ValueError, match="one seed"):
            env.reset(seed=seed)
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"expected \(4, 6\)"):
        env.step(np.zeros((N, 5), np.float32))
    with pytest.raises(ConfigError, match=r"env\.num_envs"):
        gymnasium.make_vec(ENV_ID, num_envs=0)


@pytest.mark.parametrize(
    ("given", "mode"),
    [
        ("same_step", AutoresetMode.SAME_STEP),
        ("next_step", AutoresetMode.NEXT_STEP),
        ("disabled", AutoresetMode.DISABLED),
        ("NextStep", AutoresetMode.NEXT_STEP),  # SyncVectorEnv accepts the enum's value, too
        (AutoresetMode.DISABLED, AutoresetMode.DISABLED),
    ],
)
def test_the_mode_of_autoreset_is_where_wrappers_read_it(given, mode):
    env = gymnasium.make_vec(ENV_ID, num_envs=2, autoreset_mode=given, overrides=ONE_THREAD)
    assert env.metadata["autoreset_mode"] is mode
    assert env.unwrapped.autoreset_mode is mode  # TorchRL reads this attribute of SyncVectorEnv
    assert type(env.unwrapped).metadata["autoreset_mode"] is AutoresetMode.SAME_STEP  # no other env's


@pytest.mark.parametrize("mode", ["next_stp", ["next_step"]])
def test_an_unknown_mode_of_autoreset_is_refused_with_the_nearest(mode):
    with pytest.raises(ConfigError, match="same_step, next_step, disabled") as caught:
        gymnasium.make_vec(ENV_ID, num_envs=2, autoreset_mode=mode)
    assert (caught.value.key, caught.value.nearest) == ("autoreset_mode", "next_step")
