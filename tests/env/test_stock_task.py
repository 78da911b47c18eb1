"""Test the stock task on a small robot whose joints and bodies have the names of the stock robot."""

import pytest
import torch
from sim.small_envs import ASSETS

from wheelleg_exp.build import build_env
from wheelleg_exp.config.composing.compose import compose
from wheelleg_exp.env import ManagerBasedRLEnv


@pytest.fixture
def env():
    config = compose(["task=stand", "env.num_envs=8", "env.sim.nthread=1"]).config["env"]
    return ManagerBasedRLEnv(config, ASSETS / "legged.xml", 0)


def test_the_observation_has_the_articles_widths(env):
    assert env.observation_manager.group_obs_dim == {"policy": (135,), "critic": (180,)}
    slices = env.observation_manager.term_slices("policy")
    assert {name: (s.start, s.stop) for name, s in slices.items()} == {
        "base_ang_vel": (0, 15),
        "projected_gravity": (15, 30),
        "velocity_commands": (30, 45),
        "joint_pos_rel": (45, 65),
        "joint_vel_rel": (65, 95),
        "last_action": (95, 125),
        "travel_error": (125, 135),
    }
    critic = env.observation_manager.term_slices("critic")
    assert (critic["base_lin_vel"], critic["joint_effort"]) == (slice(125, 140), slice(140, 170))


def test_the_observation_matches_its_documented_layout(env):
    env.reset()
    data, frames = env.scene.robot.data, []
    signs, travel = torch.tensor(env.command_manager.get_term("base_velocity").wheel_signs), torch.zeros(8, 2)
    for k in range(6):
        action = torch.randn(8, 6, generator=torch.Generator().manual_seed(k)) * 0.1
        obs, *_ = env.step(action)
        rolled = (data.joint_vel[:, 4:] * signs).mean(dim=1) * 0.02
        travel = travel + torch.stack((rolled, data.root_ang_vel_b[:, 2]), dim=1) / 60
        assert travel.abs().max() < 0.1
        seen = {
            "base_ang_vel": data.root_ang_vel_b * 0.25,
            "projected_gravity": data.projected_gravity_b,
            "joint_pos_rel": (data.joint_pos - data.default_joint_pos)[:, :4],
            "joint_vel_rel": data.joint_vel * 0.05,
            "last_action": action,
            "base_lin_vel": data.root_lin_vel_b,
            "joint_effort": data.applied_torque * 0.01,
            "travel_error": travel * 20,
        }
        frames.append({name: value.clone() for name, value in seen.items()})
    assert env.scene.robot.joint_names == ["l01", "r01", "l02", "r02", "l03", "r03"]
    critic = obs["critic"]
    begin = {"base_ang_vel": 0, "projected_gravity": 15, "joint_pos_rel": 45, "joint_vel_rel": 65, "last_action": 95}
    begin |= {"base_lin_vel": 125, "joint_effort": 140, "travel_error": 170}
    for name, start in begin.items():
        width = frames[0][name].shape[1]
        for age in range(5):
            place = slice(start + age * width, start + (age + 1) * width)
            torch.testing.assert_close(critic[:, place], frames[1 + age][name], msg=f"{name}, sample {age}")
    assert torch.equal(torch.cat((critic[:, :125], critic[:, 170:]), dim=1), obs["policy"])
    assert (critic[:, 30:45] == 0).all()


def test_actions_go_left_leg_right_leg_wheels(env):
    env.reset()
    env.action_manager.process_action(torch.tensor([[1.0, 2.0, 3.0, 4.0, 5.0, 6.0]] * 8))
    env.action_manager.apply_action()
    data = env.scene.robot.data
    # Joint targets of l01, r01, l02, r02 are default + 0.15 * action; actions have the order l01, l02, r01, r02.
    expected = torch.tensor([0.9599 + 0.15, 0.9599 + 0.45, -1.885 + 0.30, -1.885 + 0.60])
    torch.testing.assert_close(data.joint_pos_target[0, :4], expected)
    assert data.joint_vel_target[0, 4:].tolist() == [25.0, 30.0]


def test_an_episode_is_300_steps_and_pushes_never_come(env):
    assert env.max_episode_length == 300
    left = env.event_manager._time_left["push_robot"]
    assert float(left.min()) >= env.max_episode_length_s


def test_failing_costs_200_times_the_time_step(env):
    assert env.cfg["rewards"]["terminating"]["weight"] * env.step_dt == pytest.approx(-3.333, abs=1e-3)
    env.reset()
    env.scene.robot.write_root_pose_to_sim(torch.tensor([[0.0, 0.0, 0.017, 0.0, 1.0, 0.0, 0.0]]), torch.tensor([3]))
    env.scene.refresh()
    _, reward, terminated, *_ = env.step(torch.zeros(8, 6))
    assert terminated.tolist() == [k == 3 for k in range(8)]
    assert reward[3] == pytest.approx(-200 / 60, abs=0.2)
    assert reward[0] == pytest.approx(5 / 60, abs=0.1)


def test_materials_masses_and_wrenches_match_the_article(env):
    env.reset()
    friction = torch.as_tensor(env.scene.sim.batch.expanded("geom_friction").copy())
    robot = [g for g in range(env.scene.model.ngeom) if env.scene.model.geom_bodyid[g] > 0]
    assert 0.55 <= float(friction[:, robot, 0].min()) <= float(friction[:, robot, 0].max()) <= 0.85
    mass = env.scene.sim.batch.expanded("body_mass")[:, env.scene.model.body("base_link").id]
    assert 0.28 - 1e-9 <= mass.min() <= mass.max() <= 0.33 + 1e-9
    wrench = env.scene.robot._wrench[:, 0]
    assert wrench[..., 0].abs().max() <= 0.2
    assert wrench[..., 1].abs().max() <= 0.005
    assert (env.scene.robot._wrench[:, 1:] == 0).all()


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
