import math

import mujoco
import numpy as np
import pytest
import torch

from sim.small_envs import run
from wheelleg_exp.state import same

SENSOR = "wheelleg_exp.sim.sensors."
ALL = torch.arange(4)
QUARTER = math.sqrt(0.5)


@pytest.fixture
def make(start_env):
    def build(robot="block", seed=0, num_envs=4, **settings):
        node = {"_target_": SENSOR + "Imu", "body_name": {"block": "block", "rover": "base"}[robot], **settings}
        return start_env(robot, seed=seed, num_envs=num_envs, scene={"sensors": {"imu": node}})

    return build


def noise(**settings):
    return {"_target_": SENSOR + "ImuNoise", **settings}


def throw(env, height, lin=(0.0, 0.0, 0.0), ang=(0.0, 0.0, 0.0)):
    robot, ids = env.scene.robot, torch.arange(env.num_envs)
    robot.write_root_pose_to_sim(torch.tensor([[0.0, 0.0, height, 1.0, 0.0, 0.0, 0.0]] * len(ids)), ids)
    robot.write_root_velocity_to_sim(torch.tensor([[*lin, *ang]] * len(ids)), ids)
    env.scene.refresh()


def rows(*values):
    return torch.tensor(values).expand(4, len(values))


def test_an_imu_turned_in_its_body_measures_in_its_own_axes(make):
    env = make(offset={"pos": [0.1, 0.0, 0.2], "rot": [QUARTER, QUARTER, 0.0, 0.0]})
    run(env, 60)
    data = env.scene["imu"].data
    torch.testing.assert_close(data.lin_acc_b, rows(0.0, 9.81, 0.0), atol=2e-3, rtol=0)
    torch.testing.assert_close(data.projected_gravity_b, rows(0.0, -1.0, 0.0), atol=1e-4, rtol=0)
    torch.testing.assert_close(data.quat_w, rows(QUARTER, QUARTER, 0.0, 0.0), atol=1e-3, rtol=0)
    root = env.scene.robot.data.root_pos_w
    torch.testing.assert_close(data.pos_w, root + torch.tensor([0.1, 0.0, 0.2]), atol=1e-4, rtol=0)


@pytest.mark.parametrize(("bias", "reads"), [(9.81, 0.0), (0.0, -9.81)])
def test_in_free_fall_it_reads_nothing_but_the_lack_of_its_gravity_bias(make, bias, reads):
    env = make(gravity_bias=[0.0, 0.0, bias])
    throw(env, 5.0)
    run(env, 3)
    data = env.scene["imu"].data
    torch.testing.assert_close(data.lin_acc_b, rows(0.0, 0.0, reads), atol=1e-3, rtol=0)
    torch.testing.assert_close(data.lin_vel_b, rows(0.0, 0.0, -9.81 * 6 * env.physics_dt), atol=1e-4, rtol=0)


def test_on_a_circle_it_reads_the_centripetal_acceleration(make):
    env = make(offset={"pos": [0.2, 0.0, 0.0]})
    r, w, dt = 0.2, 3.0, env.physics_dt
    throw(env, 5.0, ang=(0.0, 0.0, w))
    run(env, 2)
    data = env.scene["imu"].data
    along, inward = r * w * (1 - math.cos(w * dt)) / dt, r * w * math.sin(w * dt) / dt
    assert inward == pytest.approx(r * w**2, rel=1e-3)
    torch.testing.assert_close(data.lin_acc_b, rows(-inward, along, 0.0), atol=2e-3, rtol=0)
    torch.testing.assert_close(data.ang_vel_b, rows(0.0, 0.0, w), atol=1e-3, rtol=0)
    torch.testing.assert_close(data.lin_vel_b[:, :2], rows(0.0, r * w), atol=1e-3, rtol=0)
    torch.testing.assert_close(data.ang_acc_b, rows(0.0, 0.0, 0.0), atol=2e-2, rtol=0)


@pytest.mark.parametrize("body", ["base", "left_wheel"])
def test_velocities_are_mujocos(make, body):
    env = make("rover", body_name=body)
    env.step(torch.tensor([[1.0, -0.5, 0.7, 0.3]]).expand(4, 4))
    run(env, 7)
    model, data = env.scene.model, mujoco.MjData(env.scene.model)
    data.qpos[:], data.qvel[:] = env.scene.sim.view("qpos")[2], env.scene.sim.view("qvel")[2]
    mujoco.mj_forward(model, data)
    found = np.zeros(6)
    mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_XBODY, model.body(body).id, found, 1)
    seen = env.scene["imu"].data
    np.testing.assert_allclose(seen.ang_vel_b[2], found[:3], atol=2e-5)
    np.testing.assert_allclose(seen.lin_vel_b[2], found[3:], atol=2e-5)
    np.testing.assert_allclose(seen.pos_w[2], data.body(body).xpos, atol=1e-5)


def test_a_written_velocity_is_measured_at_once_without_an_acceleration(make):
    env = make()
    throw(env, 5.0)
    run(env)
    throw(env, 5.0, lin=(4.0, 0.0, 0.0))
    torch.testing.assert_close(env.scene["imu"].data.lin_acc_b, rows(0.0, 0.0, 0.0), atol=2e-3, rtol=0)
    torch.testing.assert_close(env.scene["imu"].data.lin_vel_b[:, 0], torch.full((4,), 4.0))
    run(env)
    torch.testing.assert_close(env.scene["imu"].data.lin_acc_b, rows(0.0, 0.0, 0.0), atol=2e-3, rtol=0)


def test_after_a_reset_it_measures_the_new_state_at_rest(make):
    env = make()
    throw(env, 5.0, ang=(3.0, 2.0, 1.0))
    run(env, 4)
    others = env.scene["imu"].data.lin_acc_b[[0, 2, 3]].clone()
    env.reset(env_ids=torch.tensor([1]))
    data = env.scene["imu"].data
    assert data.lin_acc_b[1].tolist() == pytest.approx([0.0, 0.0, 9.81])
    assert data.ang_vel_b[1].tolist() == [0.0, 0.0, 0.0]
    assert torch.equal(data.pos_w[1], env.scene.robot.data.root_pos_w[1])
    assert torch.equal(data.lin_acc_b[[0, 2, 3]], others)


def test_the_noise_has_the_configured_deviation(make):
    env = make(num_envs=400, accelerometer=noise(std=0.5), gyroscope=noise(std=0.02))
    throw(env, 9.0)
    run(env)
    data = env.scene["imu"].data
    assert float(data.lin_acc_b.std()) == pytest.approx(0.5, rel=0.1)
    assert float(data.ang_vel_b.std()) == pytest.approx(0.02, rel=0.1)
    first = data.lin_acc_b.clone()
    assert torch.equal(env.scene["imu"].data.lin_acc_b, first)
    run(env)
    both = torch.stack((first.flatten(), env.scene["imu"].data.lin_acc_b.flatten()))
    assert abs(float(torch.corrcoef(both)[0, 1])) < 0.15
    env.reset()
    fresh = data.lin_acc_b - torch.tensor([0.0, 0.0, 9.81])
    assert float(fresh.std()) == pytest.approx(0.5, rel=0.1)
    assert abs(float(torch.corrcoef(torch.stack((both[1], fresh.flatten())))[0, 1])) < 0.15


@pytest.mark.parametrize(("part", "shown"), [("gyroscope", "ang_vel_b"), ("accelerometer", "lin_acc_b")])
def test_a_bias_stays_for_an_episode_and_is_drawn_at_its_reset(make, part, shown):
    env = make(**{part: noise(bias_range=[0.1, 0.3])}, gravity_bias=[0.0, 0.0, 0.0])
    fall = torch.tensor([0.0, 0.0, -9.81 if part == "accelerometer" else 0.0])
    throw(env, 9.0)
    run(env)
    first = getattr(env.scene["imu"].data, shown).clone()
    assert ((first - fall >= 0.1 - 2e-3) & (first - fall <= 0.3 + 2e-3)).all()
    assert len(first.unique()) == 12
    run(env)
    torch.testing.assert_close(getattr(env.scene["imu"].data, shown), first, atol=2e-3, rtol=0)
    env.reset(env_ids=torch.tensor([3]))
    throw(env, 9.0)
    run(env)
    assert (getattr(env.scene["imu"].data, shown)[3] - first[3]).abs().min() > 4e-3


@pytest.mark.parametrize("period", [0.0, 0.04])
def test_a_bias_wanders_with_the_square_root_of_time(make, period):
    env = make(num_envs=400, gyroscope=noise(bias_walk=0.1), update_period=period)
    throw(env, 90.0)
    run(env, 18)
    assert float(env.scene["imu"].data.ang_vel_b.std()) == pytest.approx(0.1 * math.sqrt(18 * 0.02), rel=0.1)


def test_with_a_period_the_last_measurement_is_held(make):
    env = make(update_period=0.04)
    throw(env, 5.0)
    speeds = []
    for _ in range(5):
        run(env)
        speeds.append(round(float(env.scene["imu"].data.lin_vel_b[0, 2] / -9.81), 3))
    assert speeds == pytest.approx([0.0, 0.04, 0.04, 0.08, 0.08], abs=1e-3)


@pytest.mark.parametrize("period", [0.0, 0.05])
def test_it_continues_from_its_saved_state(make, period):
    settings = {"accelerometer": noise(std=0.1, bias_range=[-1.0, 1.0], bias_walk=0.5), "update_period": period}
    env, other = make("rover", **settings), make("rover", seed=5, **settings)
    run(env, 7)
    other.load_state_dict(env.state_dict())
    throw(env, 1.0)
    throw(other, 1.0)
    for k in range(6):
        assert same(*(each.scene["imu"].data.state_dict() for each in (env, other)))
        for each in (env, other):
            if k == 3:
                each.reset(env_ids=torch.tensor([3]))
            run(each)


def test_without_errors_nothing_is_drawn(make):
    assert "env.scene.sensors.imu" not in make().streams.state_dict()["generators"]
    assert "env.scene.sensors.imu" in make(gyroscope=noise(std=0.1)).streams.state_dict()["generators"]
