"""The robot that could be built: actions of any size leave its numbers those of a small machine."""

import pytest
import torch

from wheelleg_exp.build import build_env
from wheelleg_exp.config.composing.compose import compose

SMALL = ["robot=physical", "env.num_envs=32", "env.sim.nthread=1"]
TILES = ["env.scene.terrain.num_rows=2", "env.scene.terrain.num_cols=2"]


@pytest.mark.parametrize("task", [["task=walk"], ["task=terrain", *TILES]], ids=lambda words: words[0])
def test_drives_at_their_limits_do_not_shake_the_robot_apart(task, tmp_path_factory, monkeypatch):
    monkeypatch.setenv("WHEELLEG_CACHE", str(tmp_path_factory.getbasetemp() / "wheelleg-cache"))
    env = build_env(compose([*SMALL, *task]).config)
    env.reset()
    draws, fastest = torch.Generator().manual_seed(0), 0.0
    for _ in range(80):
        env.step(2.0 * torch.randn(32, 6, generator=draws))
        data = env.scene["robot"].data
        fastest = max(fastest, float(data.root_ang_vel_b.abs().max()))
        assert float(data.joint_vel.abs().max()) < 100.0  # The unit is rad/s, and targets reach 45 rad/s.
    assert 1.0 < fastest < 60.0  # rad/s
