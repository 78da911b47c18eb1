"""Gymnasium's NumpyToTorch around both environments."""

import gymnasium
import numpy as np
import pytest
import torch

pytest.importorskip("array_api_compat", reason="array-api-compat is not installed: nox -s clients")
from gymnasium.wrappers import NumpyToTorch, vector

OPTIONS = {"overrides": ["env.sim.nthread=1", "env.episode_length_s=0.1"]}  # 6 control steps
ID = "wheelleg_exp:Wheelleg-Velocity-v0"


def test_a_single_environment_speaks_tensors():
    env, plain = NumpyToTorch(gymnasium.make(ID, **OPTIONS)), gymnasium.make(ID, **OPTIONS)
    env.reset(seed=0)
    plain.reset(seed=0)
    found, expected = env.step(torch.ones(6))[0]["policy"], plain.step(np.ones(6, np.float32))[0]["policy"]
    assert isinstance(found, torch.Tensor)
    np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize("mode", ["next_step", "disabled"])
def test_a_batch_speaks_tensors(mode):
    env = vector.NumpyToTorch(gymnasium.make_vec(ID, num_envs=2, autoreset_mode=mode, **OPTIONS))
    env.reset(seed=0)
    steps = [env.step(torch.zeros(2, 6)) for _ in range(6 if mode == "disabled" else 8)]
    assert all(isinstance(step[0]["critic"], torch.Tensor) for step in steps)
    assert [bool(step[3].all()) for step in steps] == [k == 5 for k in range(len(steps))]
