"""The stock files of observations, commands and actions run on the stock robot, and go on where they were saved."""

from __future__ import annotations

import pytest
import torch
import yaml

from wheelleg_exp.build import build_env
from wheelleg_exp.config.composing.compose import compose
from wheelleg_exp.paths import configs_dir

ABSENT = {"no_command"}  # has nothing to observe
SENSORS = sorted(path.stem for path in (configs_dir() / "sensor").glob("*.yaml"))
CHANGES = (
    "env.num_envs=4",
    "env.episode_length_s=0.3",
    "env.scene.sensors.contact_forces.track_air_time=true",
)


def _nodes(group):
    files = sorted((configs_dir() / group).rglob("*.yaml"))
    return {name: node for file in files for name, node in yaml.safe_load(file.read_text()).items()}


def _needs(node):
    """Return the sensor that a term names."""
    return next((v["name"] for k, v in node.items() if k in ("sensor_cfg", "asset_cfg")), "robot")


@pytest.fixture(scope="module")
def build():
    config = compose(["task=stand", *CHANGES]).config
    config["env"]["scene"]["sensors"] |= _nodes("sensor")
    known = {"robot", *config["env"]["scene"]["sensors"]}
    config["env"]["commands"] |= {n: c for n, c in _nodes("command").items() if n != "flat_patch"}
    seen = {name: node for name, node in _nodes("observation").items() if _needs(node) in known}
    asked = {
        name: {"_target_": "wheelleg_exp.mdp.observations.generated_commands", "command_name": name}
        for name in config["env"]["commands"]
        if name not in ABSENT
    }
    terms = {name: node for name, node in (seen | asked).items() if "image" not in node["_target_"]}
    config["env"]["observations"]["policy"] |= {"terms": terms, "enable_corruption": True}

    def make(seed=0, **action):
        config["seed"] = seed
        config["env"]["actions"] = action or config["env"]["actions"]
        return build_env(config)

    return make


def _run(env, steps):
    draw = torch.Generator().manual_seed(0)
    return [env.step(torch.randn(4, env.action_manager.total_action_dim, generator=draw)) for _ in range(steps)]


def test_every_stock_observation_and_command_runs_and_goes_on_where_it_was_saved(build):
    first, second = build(0), build(3)
    shown, _ = first.reset()
    assert shown["policy"].dtype == torch.float32
    _run(first, 12)
    first.observation_manager.peek()
    second.load_state_dict(first.state_dict())
    for (expected, *_), (got, *_) in zip(_run(first, 15), _run(second, 15), strict=True):
        assert expected["policy"].isfinite().all()
        assert torch.equal(got["policy"], expected["policy"])


def test_a_peek_between_steps_changes_no_step(build):
    plain, looked = build(0), build(0)
    for env in (plain, looked):
        env.reset()
    for _ in range(8):
        looked.observation_manager.peek()
        for (expected, *_), (got, *_) in zip(_run(plain, 1), _run(looked, 1), strict=True):
            assert torch.equal(got["policy"], expected["policy"])


@pytest.mark.parametrize("name", _nodes("action"))
def test_every_stock_action_runs_and_goes_on_where_it_was_saved(build, name):
    first, second = (build(seed, **{name: _nodes("action")[name]}) for seed in (0, 3))
    first.reset()
    _run(first, 5)
    second.load_state_dict(first.state_dict())
    _run(first, 15)
    _run(second, 15)
    for kind in ("pos", "vel", "effort"):
        target = getattr(first.scene.robot.data, f"joint_{kind}_target")
        assert target.isfinite().all()
        assert torch.equal(getattr(second.scene.robot.data, f"joint_{kind}_target"), target)
    assert torch.equal(second.scene.robot.data.joint_pos, first.scene.robot.data.joint_pos)
