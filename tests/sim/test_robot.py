import math

import mujoco
import numpy as np
import pytest
import torch

from sim.small_envs import physics_step, run

ALL = torch.arange(4)


@pytest.fixture
def env(start_env):
    return start_env()


def _random_pose(env, seed=0):
    gen = torch.Generator().manual_seed(seed)
    quat = torch.nn.functional.normalize(torch.randn(4, 4, generator=gen), dim=1)
    pos = torch.randn(4, 3, generator=gen) + torch.tensor([0.0, 0.0, 5.0])
    env.scene.robot.write_root_pose_to_sim(torch.cat((pos, quat), dim=1), ALL)
    return pos, quat, torch.randn(4, 3, generator=gen), torch.randn(4, 3, generator=gen)


def _object_velocity(env, i, kind, local):
    model, data = env.scene.model, mujoco.MjData(env.scene.model)
    data.qpos[:] = env.scene.sim.view("qpos")[i].numpy()
    data.qvel[:] = env.scene.sim.view("qvel")[i].numpy()
    mujoco.mj_forward(model, data)
    out = np.zeros(6)
    mujoco.mj_objectVelocity(model, data, kind, model.body("base").id, out, local)
    return out


def test_root_velocities_in_all_frames_are_the_engines(env):
    _, _, lin, ang = _random_pose(env, seed=5)
    env.scene.robot.write_root_velocity_to_sim(torch.cat((lin, ang), dim=1), ALL)
    data = env.scene.robot.data
    for i in range(4):
        matrix = np.zeros(9)
        mujoco.mju_quat2Mat(matrix, data.root_quat_w[i].double().numpy())
        matrix = matrix.reshape(3, 3)
        com_w = _object_velocity(env, i, mujoco.mjtObj.mjOBJ_BODY, 0)
        link_w = _object_velocity(env, i, mujoco.mjtObj.mjOBJ_XBODY, 0)
        np.testing.assert_allclose(com_w, torch.cat((ang[i], lin[i])), atol=1e-6)
        np.testing.assert_allclose(data.root_lin_vel_w[i], com_w[3:], atol=1e-5)
        np.testing.assert_allclose(data.root_lin_vel_b[i], matrix.T @ com_w[3:], atol=1e-5)
        np.testing.assert_allclose(data.root_link_lin_vel_w[i], link_w[3:], atol=1e-5)
        np.testing.assert_allclose(data.root_link_lin_vel_b[i], matrix.T @ link_w[3:], atol=1e-5)
        np.testing.assert_allclose(data.root_ang_vel_b[i], matrix.T @ com_w[:3], atol=1e-5)
        assert np.abs(com_w[3:] - link_w[3:]).max() > 1e-3


def test_the_conversion_uses_each_environments_own_centre_of_mass(env):
    robot = env.scene.robot
    ipos = env.scene.sim.expand("body_ipos")
    base = env.scene.model.body("base").id
    ipos[:, base] += torch.randn(4, 3, generator=torch.Generator().manual_seed(3), dtype=torch.float64) * 0.05
    env.scene.sim.set_const()
    robot.data.com_b.copy_(ipos[:, base])
    _, _, lin, ang = _random_pose(env)
    robot.write_root_velocity_to_sim(torch.cat((lin, ang), dim=1), ALL)
    env.scene.refresh()
    torch.testing.assert_close(robot.data.root_lin_vel_w, lin, atol=1e-5, rtol=0)
    torch.testing.assert_close(robot.data.body_lin_vel_w[:, 0], lin, atol=1e-5, rtol=0)


def test_projected_gravity_and_heading_by_hand(env):
    robot, cos, sin = env.scene.robot, math.cos(0.3), math.sin(0.3)
    pitch, yaw = (torch.tensor([[0.0, 0.0, 0.0, *quat]] * 4) for quat in ([cos, 0, sin, 0], [cos, 0, 0, sin]))
    robot.write_root_pose_to_sim(pitch, ALL)
    expected = torch.tensor([[math.sin(0.6), 0.0, -math.cos(0.6)]]).expand(4, 3)
    torch.testing.assert_close(robot.data.projected_gravity_b, expected)
    robot.write_root_pose_to_sim(yaw, ALL)
    torch.testing.assert_close(robot.data.heading_w, torch.full((4,), 0.6))


def test_a_quaternion_that_is_not_normalised_is_written_normalised(env):
    env.scene.robot.write_root_pose_to_sim(torch.tensor([[0.0, 0, 0, 2, 0, 0, 0]] * 4), ALL)
    assert env.scene.robot.data.root_quat_w[0].tolist() == [1, 0, 0, 0]
    assert env.scene.sim.view("qpos")[0, 3:7].tolist() == [1, 0, 0, 0]
    env.scene.robot.write_root_velocity_to_sim(torch.ones(4, 6), ALL)
    torch.testing.assert_close(env.scene.robot.data.root_lin_vel_w, torch.ones(4, 3))


def test_joint_acceleration_is_the_difference_over_the_last_physics_step_and_0_after_a_write(env):
    data = env.scene.robot.data
    env.scene.robot.set_joint_velocity_target(torch.full((4, 2), 5.0), torch.tensor([2, 3]))
    for _ in range(3):
        before = data.joint_vel.clone()
        physics_step(env)
        torch.testing.assert_close(data.joint_acc, (data.joint_vel - before) / 0.01, atol=1e-3, rtol=1e-5)
    assert data.joint_acc.abs().max() > 1
    env.scene.robot.write_joint_state_to_sim(torch.zeros(4, 4), torch.full((4, 4), 7.0), env_ids=ALL)
    assert data.joint_acc.abs().max() == 0  # A written velocity does not count as acceleration.


def test_acceleration_and_torque_are_zero_after_a_reset_until_the_next_step(start_env):
    env = start_env(events={})
    env.scene.robot.set_joint_position_target(torch.full((4, 4), 0.5), slice(None))
    env.scene.robot.set_joint_velocity_target(torch.full((4, 4), 2.0), slice(None))
    physics_step(env, 4)
    data = env.scene.robot.data
    assert (data.applied_torque.abs() > 0.01).all()
    env.reset(env_ids=torch.tensor([1]))
    for quantity in (data.applied_torque, data.computed_torque, data.joint_acc):
        assert (quantity[1] == 0).all()
        assert (quantity[0] != 0).any()
    physics_step(env)
    assert (data.applied_torque[1].abs() > 0.01).all()
    assert (data.joint_acc[1] != 0).all()


def _permanent(env, ids, wrench):
    env.scene.robot.set_permanent_wrench(ids, [0], wrench.expand(len(ids), 1, 6))


def test_a_permanent_wrench_acts_in_link_axes_and_turns_with_the_body(env):
    _random_pose(env)
    env.scene.refresh()
    wrench = torch.tensor([1.0, 2.0, 3.0, 0.1, 0.2, 0.3])
    _permanent(env, ALL, wrench)
    env.scene.robot.write_root_velocity_to_sim(torch.tensor([[0.0, 0, 0, 3, 3, 3]] * 4), ALL)
    env.scene.refresh()
    previous = None
    for _ in range(5):
        quats = env.scene.robot.data.root_quat_w.double().numpy()
        env.scene.write_data_to_sim()
        applied = env.scene.sim.view("xfrc_applied")[:, env.scene.model.body("base").id].clone()
        for i in range(4):
            expected = np.zeros(6)
            mujoco.mju_rotVecQuat(expected[:3], wrench[:3].double().numpy(), quats[i])
            mujoco.mju_rotVecQuat(expected[3:], wrench[3:].double().numpy(), quats[i])
            np.testing.assert_allclose(applied[i], expected, atol=1e-6)
        assert previous is None or not torch.allclose(applied, previous, atol=1e-3)
        previous = applied
        env.scene.sim.step()
        env.scene.update()


def test_a_permanent_wrench_lasts_until_its_environments_reset(env):
    _permanent(env, ALL, torch.tensor([0.0, 0, 1.0, 0, 0, 0]))
    run(env, 6)
    force = env.scene.sim.view("xfrc_applied")[:, env.scene.model.body("base").id]
    assert (force[:, :3].norm(dim=1) > 0.99).all()
    env.reset(env_ids=torch.tensor([0, 2]))
    env.step(torch.zeros(4, 4))
    assert (force.norm(dim=1) > 0.99).tolist() == [False, True, False, True]


def test_wrenches_act_on_their_environment_and_all_their_bodies_only(env):
    robot, bodies = env.scene.robot, [env.scene.model.body(name).id for name in ("base", "left_wheel")]
    first, second = torch.zeros(1, 1, 6), torch.zeros(1, 1, 6)
    first[..., 0], second[..., 1] = 1.0, 2.0
    robot.set_permanent_wrench(torch.tensor([1]), [3], first)
    robot.set_permanent_wrench(torch.tensor([1]), [0], second)
    physics_step(env)
    applied = env.scene.sim.view("xfrc_applied")
    assert (applied.abs().sum(dim=(1, 2)) > 0).tolist() == [False, True, False, False]
    assert (applied[1].abs().sum(dim=1) > 0).nonzero().flatten().tolist() == sorted(bodies)
    assert applied[1, bodies].norm(dim=1).tolist() == pytest.approx([2.0, 1.0])


def test_a_reset_of_the_scene_leaves_state_and_targets_to_events_and_actions(make_env):
    env = make_env(events={})
    robot, gen = env.scene.robot, torch.Generator().manual_seed(2)
    env.reset()
    run(env, 3, 1.0)
    robot.set_joint_position_target(torch.randn(4, 4, generator=gen))
    robot.set_joint_effort_target(torch.randn(4, 4, generator=gen))
    motion = [env.scene.sim.view("qpos"), env.scene.sim.view("qvel")]
    before = [*robot.targets.state_dict().values(), *(t.clone() for t in motion)]
    env.scene.reset(torch.tensor([1, 3]))
    now = [*robot.targets.state_dict().values(), *motion]
    assert len(before) == 5
    assert all(map(torch.equal, before, now))
