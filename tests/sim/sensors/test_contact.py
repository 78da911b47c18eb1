import math
from fractions import Fraction

import pytest
import torch

from sim.small_envs import CONTACT, env_config, env_of, init_state, physics_step, run, variant
from wheelleg_exp.errors import WheellegError

WEIGHT = 2.001 * 9.81
STILL = torch.zeros(4, 1)
TRACKED = {"track_contact_points": True, "track_friction_forces": True}


def _sensing(start_env, base="block", **changes):
    return start_env(base, scene={"sensors": {"contact": CONTACT | changes}})


@pytest.fixture
def env(start_env):
    return _sensing(start_env)


def test_the_force_has_world_axes_when_the_body_is_upside_down(env):
    robot = env.scene.robot
    upside_down = torch.tensor([[0.0, 1.0, 0.0, 0.0]] * 4)
    robot.write_root_pose_to_sim(torch.cat((robot.data.root_pos_w.clone(), upside_down), dim=1))
    env.scene.refresh()
    run(env, 60)
    assert float(robot.data.projected_gravity_b[0, 2]) == pytest.approx(1.0, abs=1e-3)
    weight = torch.tensor([0.0, 0.0, WEIGHT]).expand(4, 3)
    torch.testing.assert_close(env.scene["contact"].data.net_forces_w[:, 0], weight, atol=0.02, rtol=0)


def test_history_is_newest_first_and_rolls_each_physics_step(env):
    sensor = env.scene["contact"]
    seen = []
    for _ in range(12):
        env.action_manager.apply_action()
        physics_step(env)
        seen.append(sensor.data.net_forces_w.clone())
    for age in range(3):
        assert torch.equal(sensor.data.net_forces_w_history[:, age], seen[-1 - age])
    assert not torch.equal(seen[-1], seen[-2])


def test_history_and_times_are_clean_after_a_reset(env):
    run(env, 60)
    env.reset(env_ids=torch.tensor([1, 3]))
    sensor, data = env.scene["contact"], env.scene["contact"].data
    history = data.net_forces_w_history
    for value in (history, data.current_contact_time, data.current_air_time, sensor.max_force_norm()):
        assert (value[[1, 3]] == 0).all()
    assert (history[[0, 2]] != 0).any()


def test_without_a_history_only_the_force_of_the_last_physics_step_is_used(start_env):
    env = _sensing(start_env, history_length=0)
    run(env, 60)
    sensor = env.scene["contact"]
    assert float(sensor.max_force_norm()[0, 0]) == pytest.approx(WEIGHT, abs=0.02)
    assert torch.equal(sensor.data.net_forces_w_history[:, 0], sensor.data.net_forces_w)
    env.scene.robot.write_root_pose_to_sim(torch.tensor([[0.0, 0.0, 5.0, 1.0, 0.0, 0.0, 0.0]] * 4))
    env.scene.refresh()
    env.step(STILL)
    assert (sensor.max_force_norm() == 0).all()


def test_a_dropped_body_is_timed_in_the_air_and_at_touchdown(start_env):
    env = start_env("block", decimation=1, robot={"init_state": init_state(0.3, {"spin": 0.0})})
    sensor = env.scene["contact"]
    dt = env.physics_dt
    fall = math.sqrt(2 * 0.2 / 9.81)  # The cube falls 0.2 m in 0.2 s.
    landed = None
    for k in range(1, 41):
        env.step(STILL)
        touching = sensor.data.net_forces_w[0, 0].norm() > 1.0
        if not touching and landed is None:
            assert float(sensor.data.current_air_time[0, 0]) == pytest.approx(k * dt, abs=1e-6)
            assert not sensor.compute_first_contact(dt).any()
        elif landed is None:
            landed = k
            assert sensor.compute_first_contact(dt)[:, 0].all()
            assert float(sensor.data.last_air_time[0, 0]) == pytest.approx(k * dt, abs=1e-6)
            assert float(sensor.data.current_air_time[0, 0]) == 0.0
        elif k == landed + 1 and touching:
            assert not sensor.compute_first_contact(dt)[:, 0].any()
            assert sensor.compute_first_contact(2 * dt)[:, 0].all()
    assert landed is not None
    assert landed * dt == pytest.approx(fall, abs=2.5 * dt)


def test_a_body_that_leaves_the_ground_is_timed(env):
    run(env, 30)
    robot, sensor = env.scene.robot, env.scene["contact"]
    spent = float(sensor.data.current_contact_time[0, 0])
    robot.write_root_velocity_to_sim(torch.tensor([[0.0, 0, 3.0, 0, 0, 0]] * 4))
    env.scene.refresh()
    run(env, 2)
    assert float(sensor.data.last_contact_time[0, 0]) >= spent
    assert float(sensor.data.current_contact_time[0, 0]) == 0.0
    assert sensor.compute_first_air(0.2)[:, 0].all()


@pytest.mark.parametrize("mode", ["contact", "air"])
@pytest.mark.parametrize(("rate", "steps"), [(60, 1), (120, 2), (120, 10), (100, 25), (500, 50), (1000, 500)])
def test_the_first_substep_of_a_control_step_is_within_it_and_the_last_one_before_it_is_not(env, mode, rate, steps):
    """Fractions are exact: a touchdown ``steps`` substeps ago is first within the control step, one more is not."""
    sensor = env.scene["contact"]
    time = torch.zeros(4, 2)
    for _ in range(steps):
        time += 1 / rate
    sensor.data.times[f"current_{mode}_time"].copy_(time + torch.tensor([0.0, 1 / rate]))
    first = getattr(sensor, f"compute_first_{mode}")(float(Fraction(steps, rate)))
    assert first.tolist() == [[True, False]] * 4


def test_with_a_period_the_last_measurement_is_held(start_env):
    node = CONTACT | {"history_length": 2}
    sensors = {"contact": node, "slow": node | {"update_period": 0.03}}
    env = start_env("block", decimation=1, scene={"sensors": sensors})
    fast, slow = env.scene["contact"], env.scene["slow"]
    history, since = [torch.zeros(4, 2, 3)] * 2, 0.0
    for k in range(1, 70):
        if k == 32:
            env.scene.robot.write_root_velocity_to_sim(torch.tensor([[0.0, 0, 0.8, 0, 0, 0]] * 4), torch.arange(4))
        env.step(STILL)
        if k % 3 == 1:
            history = [fast.data.net_forces_w.clone(), history[0]]
            since = since + 0.03 if history[0][0, 0].norm() > 1.0 else 0.0
        assert torch.equal(slow.data.net_forces_w_history, torch.stack(history, dim=1))
        torch.testing.assert_close(slow.max_force_norm(), torch.stack(history).norm(dim=-1).amax(dim=0))
        assert float(slow.data.current_contact_time[0, 0]) == pytest.approx(since, abs=1e-6)
    assert float(slow.data.last_air_time[0, 0]) == pytest.approx(2 * 0.8 / 9.81, abs=0.06)


NOT_TRACKED = {"force_matrix_w": "filter_body_names", "pos_w": "track_pose", "quat_w": "track_pose"}
NOT_TRACKED |= {"contact_pos_w": "track_contact_points", "friction_forces_w": "track_friction_forces"}
NOT_TRACKED |= {"current_air_time": "track_air_time"}


@pytest.mark.parametrize(("name", "option"), NOT_TRACKED.items())
def test_untracked_values_name_the_option_to_set(start_env, name, option):
    sensor = _sensing(start_env, track_air_time=False).scene["contact"]
    with pytest.raises(WheellegError, match=option):
        getattr(sensor.data, name)
    with pytest.raises(WheellegError, match="track_air_time"):
        sensor.compute_first_contact(0.02)


def test_contacts_beyond_the_limit_are_logged_when_the_episode_ends(start_env):
    for env, share in ((_sensing(start_env, max_contacts=2), 1.0), (_sensing(start_env), 0.0)):
        run(env, 50)
        assert float(env.reset()[1]["log"]["Diagnostics/contact_overflow"]) == share
        assert float(env.reset()[1]["log"]["Diagnostics/contact_overflow"]) == 0.0


def test_bodies_of_the_sensor_are_found_by_name(start_env):
    env = _sensing(start_env, "rover", body_names=[".*_wheel", "base"])
    assert env.scene["contact"].body_names == ["base", "left_wheel", "right_wheel"]
    assert env.scene["contact"].find_bodies(["right_.*"], key="k")[0] == [2]


def test_forces_are_separated_by_the_body_that_they_come_from(start_env):
    env = _sensing(start_env, filter_body_names=["ground", "flywheel"])
    run(env, 60)
    data = env.scene["contact"].data
    assert data.force_matrix_w.shape == (4, 2, 2, 3)
    torch.testing.assert_close(data.force_matrix_w[:, 0, 0], data.net_forces_w[:, 0])
    torch.testing.assert_close(data.force_matrix_w[:, 0, 0, 2], torch.full((4,), WEIGHT), atol=0.02, rtol=0)
    assert not data.force_matrix_w[:, :, 1].any()
    assert not data.force_matrix_w[:, 1].any()
    assert data.force_matrix_w_history.shape == (4, 3, 2, 2, 3)
    saved = env.scene["contact"].state_dict()
    before, time = data.force_matrix_w_history.clone(), data.current_contact_time.clone()
    env.scene["contact"].reset(torch.tensor([1]))
    assert not data.force_matrix_w_history[1].any()
    assert torch.equal(data.force_matrix_w_history[0], before[0])
    env.scene["contact"].load_state_dict(saved)
    assert torch.equal(data.force_matrix_w_history, before)
    assert torch.equal(data.current_contact_time, time)


def test_friction_takes_up_a_push_and_contacts_are_below_the_cube(start_env):
    env = _sensing(start_env, filter_body_names=["ground", "flywheel"], **TRACKED)
    wrench = torch.zeros(4, 1, 6)
    wrench[:, 0, 0], wrench[:, 0, 1] = torch.tensor([0.0, 5.0, -2.0, 4.0]), torch.tensor([0.0, 0.0, 3.0, 4.0])
    env.scene.robot.set_permanent_wrench(torch.arange(4), [0], wrench)
    run(env, 60)
    sensor, data = env.scene["contact"], env.scene["contact"].data
    assert data.friction_forces_w.shape == data.contact_pos_w.shape == (4, 2, 2, 3)
    torch.testing.assert_close(data.friction_forces_w[:, 0, 0], -wrench[:, 0, :3], atol=0.02, rtol=0)
    assert data.net_forces_w[:, 0, :2].abs().max() < 0.01  # without friction
    torch.testing.assert_close(data.force_matrix_w[:, 0, 0, 2], torch.full((4,), WEIGHT), atol=0.02, rtol=0)
    below = env.scene.robot.data.root_pos_w - torch.tensor([0.0, 0.0, 0.1])
    torch.testing.assert_close(data.contact_pos_w[:, 0, 0], below, atol=1e-3, rtol=0)
    assert data.contact_pos_w[:, 0, 1].isnan().all()
    assert data.contact_pos_w[:, 1].isnan().all()
    assert not data.friction_forces_w[:, 0, 1].any()
    assert not data.friction_forces_w[:, 1].any()
    saved, before = sensor.state_dict(), data.friction_forces_w.clone()
    sensor.reset(torch.tensor([1]))
    assert not data.friction_forces_w[1].any()
    assert data.contact_pos_w[1].isnan().all()
    assert torch.equal(data.friction_forces_w[2], before[2])
    sensor.load_state_dict(saved)
    assert torch.equal(data.friction_forces_w, before)
    assert not data.contact_pos_w[1, 0, 0].isnan().any()


@pytest.mark.parametrize("name", TRACKED)
def test_contact_details_without_filter_bodies_are_rejected(start_env, name):
    with pytest.raises(WheellegError, match="filter_body_names"):
        _sensing(start_env, **{name: True})


def test_two_bodies_push_each_other_with_opposite_forces(tmp_path):
    thin, fat = '"left_arm" type="capsule" size=".01"', '"left_arm" type="capsule" size=".195"'
    contact = CONTACT | TRACKED | {"filter_body_names": [".*"], "track_pose": True}
    env = env_of(variant(tmp_path, thin, fat), env_config(scene={"sensors": {"contact": contact}}))
    env.reset()
    sensor, data = env.scene["contact"], env.scene["contact"].data
    order = [sensor.filter_names.index(body) for body in sensor.body_names]
    pushed = torch.zeros(5, 5)
    for _ in range(20):
        env.step(torch.zeros(4, 4))
        between = data.force_matrix_w[:, :, order]
        torch.testing.assert_close(between, -between.transpose(1, 2), atol=1e-4, rtol=1e-5)
        torch.testing.assert_close(data.force_matrix_w.sum(dim=2), data.net_forces_w, atol=1e-4, rtol=1e-4)
        rubbed, points = data.friction_forces_w[:, :, order], data.contact_pos_w[:, :, order]
        torch.testing.assert_close(rubbed, -rubbed.transpose(1, 2), atol=1e-4, rtol=1e-5)
        torch.testing.assert_close(points, points.transpose(1, 2), atol=1e-6, rtol=0, equal_nan=True)
        pushed += between.norm(dim=-1).sum(dim=0)
    left, right = sensor.body_names.index("left_arm"), sensor.body_names.index("right_arm")
    assert pushed[left, right] > 1.0
    assert pushed[left, left] == 0.0
    torch.testing.assert_close(data.pos_w, env.scene.robot.data.body_pos_w)
    torch.testing.assert_close(data.quat_w, env.scene.robot.data.body_quat_w)
