import pytest
import torch

from sim.small_envs import ASSETS
from wheelleg_exp.config.composing.compose import compose
from wheelleg_exp.env import ManagerBasedRLEnv

STEPS = 12
# These terms give each robot its own parameters.
DRAWN = ("physics_material", "add_base_mass", "base_external_force_torque")
SCANNER = "+sensor@env.scene.sensors=[height_scanner,imu]"


def stand(*overrides: str) -> ManagerBasedRLEnv:
    config = compose(["task=stand", "env.num_envs=8", "env.sim.nthread=1", SCANNER, *overrides]).config["env"]
    return ManagerBasedRLEnv(config, ASSETS / "legged.xml", 0)


@pytest.fixture(scope="module")
def overrides(device) -> list[str]:
    return ["env.sim.engine=warp", f"env.sim.device={device}"]


@pytest.fixture(scope="module")
def env(overrides) -> ManagerBasedRLEnv:
    env = stand(*overrides)
    env.reset(seed=0)
    return env


def actions(env: ManagerBasedRLEnv, seed: int = 1) -> torch.Tensor:
    gen = torch.Generator().manual_seed(seed)
    drawn = 0.3 * torch.randn(STEPS, env.num_envs, env.action_manager.total_action_dim, generator=gen)
    return drawn.to(env.device)


def test_a_rollout_of_the_stock_task_is_that_of_mujocos_engine(env, overrides):
    drawn = [] if env.device.type == "cpu" else [f"env.events.{name}=null" for name in DRAWN]
    env = stand(*overrides, *drawn) if drawn else env
    env.reset(seed=0)
    other = stand(*drawn)
    other.reset(seed=0)
    if env.device.type == "cpu":
        for name in ("qpos", "qvel"):
            torch.testing.assert_close(env.scene.sim.view(name).double(), other.scene.sim.view(name), atol=1e-6, rtol=0)
    for name in ("qpos", "qvel"):
        env.scene.sim.view(name).copy_(other.scene.sim.view(name))
    env.scene.robot.mark_written(torch.arange(8, device=env.device))
    env.scene.refresh()
    for action in actions(env):
        ours, theirs = env.step(action), other.step(action.cpu())
        if env.device.type == "cpu":
            for group, value in ours[0].items():
                torch.testing.assert_close(value, theirs[0][group], atol=5e-3, rtol=5e-3)
            torch.testing.assert_close(ours[1], theirs[1], atol=1e-3, rtol=1e-3)
            assert torch.equal(ours[2], theirs[2])
        qpos = env.scene.sim.view("qpos").double().cpu()
        torch.testing.assert_close(qpos, other.scene.sim.view("qpos"), atol=1e-4, rtol=0)
    scan, reference = (e.scene["height_scanner"].data.ray_hits_w.cpu() for e in (env, other))
    torch.testing.assert_close(scan, reference, atol=2e-3, rtol=0)
    forces, others = (e.scene["contact_forces"].data.net_forces_w.cpu() for e in (env, other))
    torch.testing.assert_close(forces, others, atol=0.02, rtol=0.02)
    assert others.abs().max() > 1.0


def test_every_tensor_of_a_step_is_on_the_engines_device(env):
    observations, reward, terminated, truncated, _ = env.step(actions(env)[0])
    for value in (*observations.values(), reward, terminated, truncated):
        assert value.device.type == env.device.type
    assert env.scene.sim.state.dtype == torch.float32


def test_a_saved_environment_continues_in_a_new_one(env, overrides):
    given = actions(env, seed=2)
    for action in given[:4]:
        env.step(action)
    env.reset(env_ids=torch.tensor([1, 3], device=env.device))
    saved = env.state_dict()
    again = stand(*overrides)
    again.load_state_dict(saved)
    for action in given[4:]:
        ours, theirs = env.step(action), again.step(action)
        if env.scene.sim.exact:
            assert torch.equal(ours[0]["policy"], theirs[0]["policy"])
            assert torch.equal(ours[1], theirs[1])
        else:
            torch.testing.assert_close(ours[0]["policy"], theirs[0]["policy"], atol=0.05, rtol=0.05)
