import math

import numpy as np
import pytest
import torch
from sim.small_envs import physics_step, run

from mdp.nodes import bodies, event
from wheelleg_exp.mdp import events

ALL = torch.arange(4)


OFF = [[-1.0, 0.5, -2.0], [1.0, 0.5, 2.0]]


@pytest.mark.parametrize("per_env", [True, False])
def test_everything_falls_as_gravity_was_drawn(start_env, per_env):
    node = event("randomize_physics_scene_gravity", gravity_distribution_params=OFF, operation="add", per_env=per_env)
    env = start_env("block", events={"g": node})
    written = torch.from_numpy(np.array(env.scene.sim.batch.expanded("opt.gravity"))).float()
    assert len(written.unique(dim=0)) == (4 if per_env else 1)
    assert ((written - torch.tensor([0.0, 0.5, -9.81])).abs() <= torch.tensor([1.0, 1e-6, 2.0])).all()
    env.scene.robot.write_root_pose_to_sim(torch.tensor([[0.0, 0.0, 5.0, 1.0, 0.0, 0.0, 0.0]]).repeat(4, 1))
    env.scene.robot.write_root_velocity_to_sim(torch.zeros(4, 6))
    physics_step(env, 10)
    fallen = env.scene.robot.data.root_lin_vel_w / (10 * env.physics_dt)
    torch.testing.assert_close(fallen, written, atol=1e-4, rtol=1e-4)
    torch.testing.assert_close(env.scene.robot.data.projected_gravity_b, torch.tensor([[0.0, 0.0, -1.0]] * 4))


def test_gravity_is_drawn_from_the_configs_each_time_for_the_given_environments(make_env):
    fields = {"operation": "scale", "distribution": "log_uniform", "per_env": True}
    fields |= {"gravity_distribution_params": [[1.0, 1.0, 1.1], [1.0, 1.0, 1.5]]}
    env = make_env("block", events={"g": event("randomize_physics_scene_gravity", "custom", **fields)})
    for _ in range(3):
        env.apply_event("custom", torch.tensor([1, 2]))
    down = env.scene.sim.expanded["opt.gravity"][:, 2]
    assert down[[0, 3]].tolist() == [-9.81, -9.81]
    assert ((down[1:3] <= -9.81 * 1.1) & (down[1:3] >= -9.81 * 1.5)).all()


def test_one_gravity_applies_to_all_whichever_environment_resets(make_env):
    node = event("randomize_physics_scene_gravity", "custom", gravity_distribution_params=OFF, operation="add")
    env = make_env("block", events={"g": node})
    env.apply_event("custom", torch.tensor([1]))
    written = env.scene.sim.expanded["opt.gravity"]
    assert (len(written.unique(dim=0)), written[0, 1]) == (1, pytest.approx(0.5))


def test_each_environment_has_its_own_moments_of_inertia(make_env):
    ranges = {"inertia_distribution_params": [0.8, 1.4], "operation": "scale", "asset_cfg": bodies("block")}
    env = make_env("block", events={"i": event("randomize_rigid_body_inertia", **ranges)})
    body = env.scene.model.body("block").id
    ratio = np.array(env.scene.sim.batch.expanded("body_inertia"))[:, body] / env.scene.model.body_inertia[body]
    assert ((ratio >= 0.8 - 1e-6) & (ratio <= 1.4 + 1e-6)).all()
    assert len(np.unique(ratio)) == 12


def test_no_moment_of_inertia_is_more_than_the_other_two(make_env):
    fields = {"operation": "scale", "distribution": "log_uniform", "asset_cfg": bodies("base")}
    node = event("randomize_rigid_body_inertia", inertia_distribution_params=[1e-3, 10.0], **fields)
    env = make_env(events={"i": node}, num_envs=200)
    moments = np.sort(env.scene.sim.expanded["body_inertia"][:, env.scene.model.body("base").id].numpy(), axis=1)
    assert (moments[:, 2] <= moments[:, 0] + moments[:, 1] + 1e-15).all()
    assert (moments[:, 2] == moments[:, 0] + moments[:, 1]).any()


def test_a_moment_of_inertia_never_falls_below_its_minimum(make_env):
    ranges = {"inertia_distribution_params": [-1.0, -1.0], "operation": "add", "min_inertia": 1e-4}
    env = make_env(events={"i": event("randomize_rigid_body_inertia", asset_cfg=bodies("base"), **ranges)})
    moments = env.scene.sim.expanded["body_inertia"][:, env.scene.model.body("base").id]
    assert moments.tolist() == [pytest.approx([1e-4] * 3)] * 4


IMPULSE = {"force_range": [1.0, 2.0], "torque_range": [0.0, 0.0], "asset_cfg": bodies("block")}


def test_a_push_lasts_and_a_pause_follows(start_env):
    """Pauses take 0.1 s, pushes 0.06 s, and control steps 0.02 s."""
    node = event("apply_body_impulse", "step", **IMPULSE, duration_s=[0.06, 0.06], pause_s=[0.1, 0.1])
    env = start_env("block", events={"to_default": event("reset_scene_to_default", "reset"), "p": node})
    body = env.scene.model.body("block").id
    felt = []
    for _ in range(18):
        env.step(torch.zeros(4, 1))
        felt.append(bool((env.scene.sim.view("xfrc_applied")[:, body].norm(dim=1) > 0.5).all()))
    assert felt == [False] * 5 + [True] * 3 + [False] * 5 + [True] * 3 + [False] * 2
    assert (env.scene.robot.permanent_wrench[:, 0].abs() < 1e-6).all()


def test_a_push_adds_to_a_permanent_wrench_and_ends_with_the_episode(start_env):
    ranges = {"force_range": [3.0, 3.0], "torque_range": [0.0, 0.0], "asset_cfg": bodies("block")}
    always = event("set_permanent_body_wrench", "reset", **ranges)
    node = event("apply_body_impulse", "step", **IMPULSE, duration_s=[9.0, 9.0], pause_s=[0.02, 0.02])
    env = start_env("block", events={"w": always, "p": node})
    run(env, 2)
    force = env.scene.robot.permanent_wrench[:, 0, :, 0]
    assert ((force >= 4.0) & (force <= 5.0)).all()
    assert len(force.unique()) == 12
    env.reset(env_ids=torch.tensor([1]))
    force = env.scene.robot.permanent_wrench[:, 0, :, 0]
    assert (force[1] == 3.0).all()
    assert (force[[0, 2, 3]] >= 4.0).all()
    run(env)
    force = env.scene.robot.permanent_wrench[:, 0, :, 0]
    assert ((force >= 4.0) & (force <= 5.0)).all()


def test_times_of_pushes_differ_between_environments(start_env):
    node = event("apply_body_impulse", "step", **IMPULSE, duration_s=[0.1, 0.5], pause_s=[0.1, 0.5])
    env = start_env("block", events={"p": node}, num_envs=64)
    run(env, 15)
    assert 5 < int(env.event_manager.get_term_cfg("p").func._is_pushed.sum()) < 59


def test_episodes_start_over_flat_patches_of_their_tile(make_env):
    ranges = {"pose_range": {"yaw": [1.0, 1.0]}, "velocity_range": {"x": [0.5, 0.5]}}
    rows = torch.arange(2 * 3 * 5 * 3, dtype=torch.float32).view(2, 3, 5, 3)
    env = make_env()
    env.scene.terrain.flat_patches["init_pos"] = rows
    env.scene.terrain.terrain_levels = torch.tensor([0, 1, 0, 1])
    env.scene.terrain.terrain_types = torch.tensor([2, 1, 0, 2])
    term = events.reset_root_state_from_terrain(env, **ranges, generator=torch.Generator().manual_seed(0))
    robot, seen = env.scene.robot, set()
    for _ in range(40):
        term(env, ALL)
        robot.data.invalidate()
        place = robot.data.root_pos_w - robot.default_root_pos
        for i, (row, column) in enumerate([(0, 2), (1, 1), (0, 0), (1, 2)]):
            found = (rows[row, column] - place[i]).norm(dim=1)
            assert found.min() < 1e-4
            seen.add((i, int(found.argmin())))
    assert len(seen) == 20
    half = torch.tensor([math.cos(0.5), 0.0, 0.0, math.sin(0.5)])
    torch.testing.assert_close(robot.data.root_quat_w, half.expand(4, 4))
    torch.testing.assert_close(robot.data.root_lin_vel_w, torch.tensor([[0.5, 0.0, 0.0]] * 4), atol=1e-5, rtol=0.0)
