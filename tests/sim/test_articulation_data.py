import math

import mujoco
import numpy as np
import pytest
import torch

from sim.small_envs import run
from wheelleg_exp.errors import ConfigError
from wheelleg_exp.sim.class_members import unsupported_members
from wheelleg_exp.sim.engine import Engine

N = 4


@pytest.fixture
def env(make_env):
    env = make_env()
    robot, gen = env.scene.robot, torch.Generator().manual_seed(3)
    quat = torch.nn.functional.normalize(torch.randn(N, 4, generator=gen), dim=1)
    pose = torch.cat((torch.randn(N, 3, generator=gen) + torch.tensor([0.0, 0.0, 5.0]), quat), dim=1)
    robot.write_root_pose_to_sim(pose)
    robot.write_root_velocity_to_sim(torch.randn(N, 6, generator=gen))
    robot.write_joint_state_to_sim(torch.rand(N, 4, generator=gen), torch.randn(N, 4, generator=gen))
    env.scene.refresh()
    return env


def velocity(model, data, kind, body):
    found = np.zeros(6)
    mujoco.mj_objectVelocity(model, data, kind, body, found, 0)
    return [*found[3:], *found[:3]]


def matrix(quat):
    found = np.zeros(9)
    mujoco.mju_quat2Mat(found, np.asarray(quat, dtype=float))
    return found


@pytest.mark.parametrize("steps", [0, 5])
def test_poses_and_velocities_of_bodies_are_mujocos(env, steps):
    for _ in range(steps):
        env.step(torch.ones(N, 4))
    robot, model = env.scene.robot, env.scene.model
    state = robot.data
    for i in range(N):
        data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:] = env.scene.sim.view("qpos")[i], env.scene.sim.view("qvel")[i]
        mujoco.mj_forward(model, data)
        for b, name in enumerate(robot.body_names):
            body = model.body(name).id
            link = velocity(model, data, mujoco.mjtObj.mjOBJ_XBODY, body)
            com = velocity(model, data, mujoco.mjtObj.mjOBJ_BODY, body)
            for got, expected in (
                (state.body_link_pose_w[i, b], [*data.xpos[body], *data.xquat[body]]),
                (state.body_link_vel_w[i, b], link),
                (state.body_com_vel_w[i, b], com),
                (state.body_com_pose_w[i, b, :3], data.xipos[body]),
                (state.body_state_w[i, b, 7:], com),
                (state.body_link_state_w[i, b, 7:], link),
                (state.body_com_state_w[i, b, 7:], com),
                (state.body_vel_w[i, b], com),
                (state.body_com_pos_b[i, b], model.body_ipos[body]),
                (state.com_quat_b[i, b], model.body_iquat[body]),
            ):
                assert got.tolist() == pytest.approx(list(expected), abs=1e-5)
            assert matrix(state.body_com_quat_w[i, b]) == pytest.approx(data.ximat[body], abs=1e-5)


def test_the_roots_members_are_those_of_the_first_body(env):
    state = env.scene.robot.data
    for name in ("link_pose_w", "link_vel_w", "com_pose_w", "com_vel_w", "state_w", "link_state_w", "com_state_w"):
        root, body = getattr(state, f"root_{name}"), getattr(state, f"body_{name}")[:, 0]
        torch.testing.assert_close(root, body, atol=1e-5, rtol=1e-5)
    assert state.root_state_w.shape == (N, 13)
    assert torch.equal(state.root_pose_w, state.root_link_pose_w)
    assert torch.equal(state.root_com_lin_vel_b, state.root_lin_vel_b)


def test_accelerations_are_of_the_last_physics_step(start_env):
    env = start_env()
    robot = env.scene.robot
    run(env, 50)
    assert robot.data.body_lin_acc_w[:, 0].abs().max() < 0.05
    pose = robot.data.root_link_pose_w.clone()
    pose[:, 2] += 5.0
    robot.write_root_pose_to_sim(pose)
    robot.write_root_velocity_to_sim(torch.tensor([[1.0, 0, 0, 0, 0, 0]]).repeat(N, 1))
    env.scene.refresh()
    assert robot.data.body_acc_w.abs().max() == 0.0  # A written velocity does not count as acceleration.
    run(env)
    mass = robot.data.default_mass.unsqueeze(2)
    whole = (robot.data.body_lin_acc_w * mass).sum(dim=1) / mass.sum(dim=1)
    assert whole[0].tolist() == pytest.approx([0.0, 0.0, -9.81], abs=0.01)


def test_accelerations_do_not_depend_on_when_they_are_first_read(start_env):
    early, late = start_env(), start_env()
    for k in range(5):
        action = torch.sin(torch.arange(4.0) + k).expand(N, 4)
        early.scene.robot.data.body_acc_w  # noqa: B018
        for env in (early, late):
            env.step(action)
    assert early.scene.robot.data.body_acc_w.abs().max() > 1.0
    assert torch.equal(early.scene.robot.data.body_acc_w, late.scene.robot.data.body_acc_w)
    for env in (early, late):
        env.step(action)
    assert torch.equal(early.scene.sim.state, late.scene.sim.state)


def test_an_engine_can_return_copies_of_the_motion_state_and_accelerations_are_saved(make_env, start_env, monkeypatch):
    env, other, restored = start_env(), start_env(), make_env()
    for one in (env, other):
        one.step(torch.ones(N, 4))
    wanted = env.scene.robot.data.body_acc_w.clone()
    assert wanted.abs().max() > 1.0
    restored.load_state_dict(env.state_dict())
    assert torch.equal(restored.scene.robot.data.body_acc_w, wanted)
    monkeypatch.setattr(type(other.scene.sim), "motion", Engine.motion)
    assert torch.equal(other.scene.robot.data.body_acc_w, wanted)


def test_inertia_is_about_the_centre_of_mass_in_link_axes(env):
    state, model = env.scene.robot.data, env.scene.model
    for b, name in enumerate(env.scene.robot.body_names):
        body = model.body(name).id
        axes = matrix(model.body_iquat[body]).reshape(3, 3)
        expected = sum(model.body_inertia[body, k] * np.outer(axes[:, k], axes[:, k]) for k in range(3))
        assert state.default_inertia[2, b].tolist() == pytest.approx(expected.reshape(-1).tolist(), rel=1e-5)
        assert float(state.default_mass[2, b]) == pytest.approx(model.body_mass[body])


def test_parameters_of_joints(make_env):
    env = make_env()
    data, model = env.scene.robot.data, env.scene.model
    dofs = [int(model.joint(name).dofadr[0]) for name in env.scene.robot.joint_names]
    hips = env.scene.robot.actuators["hips"]
    assert data.joint_stiffness[1, 0] == hips.stiffness.flatten()[0]
    assert data.default_joint_damping[3, 1] == hips.damping.flatten()[0]
    assert data.joint_armature[0].tolist() == pytest.approx(model.dof_armature[dofs].tolist())
    assert data.joint_friction_coeff[0].tolist() == pytest.approx(model.dof_frictionloss[dofs].tolist())
    assert data.gear_ratio.tolist() == N * [[1.0] * 4]
    assert data.joint_limits.shape == data.default_joint_pos_limits.shape == (N, 4, 2)


def test_constants_and_default_states(env, make_env):
    data = env.scene.robot.data
    assert data.FORWARD_VEC_B.tolist() == N * [[1.0, 0.0, 0.0]]
    assert data.default_root_state[1].tolist() == pytest.approx([0, 0, 0.3, 1, 0, 0, 0] + 6 * [0])
    assert (data.body_names, data.joint_names) == (env.scene.robot.body_names, env.scene.robot.joint_names)
    data.default_root_state[2, 2] = 0.7
    other = make_env()
    other.load_state_dict(env.state_dict())
    assert float(other.scene.robot.data.default_root_state[2, 2]) == pytest.approx(0.7)


@pytest.mark.parametrize(
    ("owner", "name", "why"),
    [
        ("data", "body_incoming_joint_wrench_b", "force and torque sensors"),
        ("data", "joint_dynamic_friction_coeff", "joint_friction_coeff"),
        ("data", "fixed_tendon_stiffness", "tendons"),
        ("robot", "root_physx_view", "no PhysX"),
    ],
)
def test_an_unsupported_member_names_the_alternative(make_env, owner, name, why):
    robot = make_env().scene.robot
    holder = robot.data if owner == "data" else robot
    assert name in unsupported_members(type(holder))
    assert not hasattr(holder, name)
    with pytest.raises(ConfigError, match=rf"'{name}'.*{why}"):
        getattr(holder, name)


def test_written_states_are_read_back(make_env):
    robot, gen = make_env().scene.robot, torch.Generator().manual_seed(1)
    ids = torch.tensor([3, 1])
    quat = torch.nn.functional.normalize(torch.randn(2, 4, generator=gen), dim=1)
    state = torch.cat((torch.randn(2, 3, generator=gen), quat, torch.randn(2, 6, generator=gen)), dim=1)
    for write, read in (
        (robot.write_root_state_to_sim, "root_state_w"),
        (robot.write_root_link_state_to_sim, "root_link_state_w"),
        (robot.write_root_com_state_to_sim, "root_com_state_w"),
    ):
        before = getattr(robot.data, read)[[0, 2]].clone()
        write(state, env_ids=ids)
        torch.testing.assert_close(getattr(robot.data, read)[ids], state, atol=1e-5, rtol=1e-5)
        assert torch.equal(getattr(robot.data, read)[[0, 2]], before)


@pytest.mark.parametrize("env_ids", [[1, 3], torch.tensor([1, 3]), slice(1, None, 2)])
@pytest.mark.parametrize("joint_ids", [[2, 0], torch.tensor([2, 0])])
def test_joints_are_written_by_any_indices(make_env, env_ids, joint_ids):
    robot = make_env().scene.robot
    assert robot.data.joint_pos[3, 0] != 0.5  # A value that was read before is read from scratch after a write.
    robot.write_joint_state_to_sim(torch.tensor([[5.0, 0.5]] * 2), torch.tensor([[-5.0, 0.25]] * 2), joint_ids, env_ids)
    assert robot.data.joint_pos[3].tolist() == pytest.approx([0.5, 0.2, 5.0, 0.0])
    assert robot.data.joint_vel[1].tolist() == pytest.approx([0.25, 0.0, -5.0, 0.0])
    assert robot.data.joint_vel[0].tolist() == [0.0] * 4
    robot.set_joint_position_target(torch.tensor([[7.0, 8.0]] * 2), joint_ids=joint_ids, env_ids=env_ids)
    assert robot.data.joint_pos_target[1].tolist() == pytest.approx([8.0, 0.2, 7.0, 0.0])
    assert robot.data.joint_pos_target[2].tolist() == pytest.approx([0.2, 0.2, 0.0, 0.0])
    robot.set_joint_velocity_target(torch.tensor([[1e3, -1e3]] * 2), joint_ids=joint_ids, env_ids=env_ids)
    assert robot.data.joint_vel_target[3].tolist() == [-30.0, 0.0, 20.0, 0.0]  # the actuators' velocity limits


def test_finding(make_env):
    robot = make_env().scene.robot
    assert robot.find_joints(["right_axle", "left_hip"], preserve_order=True)[0] == [3, 0]
    assert robot.find_joints("right.*", robot.joint_names[2:]) == ([1], ["right_axle"])
    assert (robot.num_bodies, robot.num_instances) == (len(robot.body_names), N)
    with pytest.raises(ConfigError, match="'knee' matches nothing"):
        robot.find_joints("knee")


def test_a_force_in_world_axes_at_a_point_turns_about_the_centre_of_mass(make_env):
    robot = make_env().scene.robot
    half = math.sqrt(0.5)
    robot.write_root_pose_to_sim(torch.tensor([[0.0, 0, 2, half, 0, 0, half]]).repeat(N, 1))
    robot._sim.forward()
    point = robot.data.body_com_pos_w[:, 0:1] + torch.tensor([0.0, 0.0, 0.5])
    force, torque = torch.tensor([[[2.0, 0, 0]]]).repeat(N, 1, 1), torch.zeros(N, 1, 3)
    robot.set_external_force_and_torque(force, torque, positions=point, body_ids=[0], is_global=True)
    found = robot.permanent_wrench[0, 0].T.reshape(-1)
    # In link axes, the lever 0.5 z and the force -2 y give the torque (0.5 z) x (-2 y) = 1 x.
    assert found.tolist() == pytest.approx([0, -2, 0, 1, 0, 0], abs=1e-5)
    robot.set_external_force_and_torque(torch.zeros(0, 3), torch.zeros(0, 3))
    assert not robot.permanent_wrench.any()
