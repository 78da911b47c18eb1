"""The stock files of terms run on the stock robot."""

import pytest
import torch
import yaml
from omegaconf import OmegaConf

from wheelleg_exp.build import build_env
from wheelleg_exp.config.composing.compose import compose
from wheelleg_exp.paths import configs_dir

SECTIONS = {"reward": "rewards", "termination": "terminations", "curriculum": "curriculum"}
CHANGES = (
    "env.num_envs=4",
    "env.episode_length_s=0.2",
    "env.scene.sensors.contact_forces.track_air_time=true",
    "+command@env.commands=[base_pose,jump,travel_velocity]",
)


def _nodes(group):
    files = sorted((configs_dir() / group).rglob("*.yaml"))
    return {name: node for file in files for name, node in yaml.safe_load(file.read_text()).items()}


@pytest.fixture(scope="module")
def env():
    config = compose(["task=stand", *CHANGES]).config
    for group, section in SECTIONS.items():
        config["env"][section] = {**_nodes(group), **config["env"][section]}
    for node in config["env"]["rewards"].values():
        node["weight"] = node["weight"] or 1.0
    return build_env(OmegaConf.to_container(OmegaConf.create(config), resolve=True))


def test_every_stock_term_runs_on_the_stock_robot(env):
    env.reset()
    draw = torch.Generator().manual_seed(0)
    for _ in range(30):
        env.step(torch.randn(4, env.action_manager.total_action_dim, generator=draw))
        assert env.reward_manager.non_finite == {}
    assert set(_nodes("reward")) <= set(env.reward_manager.active_terms)
