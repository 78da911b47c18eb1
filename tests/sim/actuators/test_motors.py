import math

import numpy as np
import pytest
import torch

from sim.small_envs import physics_step
from wheelleg_exp.errors import ConfigError
from wheelleg_exp.sim.robot_model import JointTargets

HERE = "wheelleg_exp.sim.actuators."
GAINS = {"stiffness": 0.0, "damping": 0.0}


def with_hips(make_env, model, remove=(), base="rover", **numbers):
    groups = make_env(base).cfg["robot"]["actuators"]
    node = {k: v for k, v in groups["hips"].items() if k not in remove}
    groups["hips"] = {**node, **numbers, "_target_": HERE + model}
    env = make_env(base, robot={"actuators": groups})
    env.reset()
    return env, env.scene.robot.actuators["hips"]


def asked_at_speed(env, speed, torque):
    robot, data = env.scene.robot, env.scene.robot.data
    robot.write_joint_state_to_sim(data.joint_pos, torch.full((4, 4), float(speed)), env_ids=torch.arange(4))
    data.invalidate()
    robot.set_joint_effort_target(torch.full((4, 4), float(torque)), slice(None))
    physics_step(env)
    return data.applied_torque[0, 0].item(), data.computed_torque[0, 0].item()


# The torque-speed line reaches the effort limit of 4 N·m at 10 rad/s, and that of -4 N·m at 50 rad/s.
@pytest.mark.parametrize(
    ("speed", "low", "high"),
    [
        *((0, -4, 4), (10, -4, 4), (15, -4, 3), (20, -4, 2), (30, -4, 0), (40, -4, -2), (50, -4, -4), (80, -4, -4)),
        *((-10, -4, 4), (-20, -2, 4), (-30, 0, 4), (-60, 4, 4)),
    ],
)
def test_a_motors_torque_is_limited_by_its_torque_speed_line(make_env, speed, low, high):
    env, _ = with_hips(make_env, "DCMotor", **GAINS, effort_limit=4.0, velocity_limit=30.0, saturation_effort=6.0)
    for torque in (-100.0, 100.0):
        applied, computed = asked_at_speed(env, speed, torque)
        assert (applied, computed) == (pytest.approx(low if torque < 0 else high, abs=1e-5), torque)
    inside = (low + high) / 2
    assert asked_at_speed(env, speed, inside)[0] == pytest.approx(inside, abs=1e-5)


def spread(values):
    return JointTargets(*(torch.full((4, 4), float(v)) for v in values))


@pytest.mark.parametrize("lag", [0, 1, 3])
def test_a_delayed_drive_acts_on_the_targets_of_some_physics_steps_ago(make_env, lag):
    numbers = {"stiffness": 7.0, "damping": 0.5, "effort_limit": 1e6}
    env, hips = with_hips(make_env, "DelayedPDActuator", **numbers, min_delay=lag, max_delay=lag)
    data = env.scene.robot.data
    pos, vel = data.joint_pos[:, hips.joint_ids], data.joint_vel[:, hips.joint_ids]
    signal = [(0.1 * k, 0.2 * k, math.sin(k)) for k in range(8)]
    for k, values in enumerate(signal):
        q, qd, tau = signal[max(0, k - lag)]  # The first target replaces all earlier targets.
        expected = 7.0 * (q - pos) + 0.5 * (qd - vel) + tau
        torch.testing.assert_close(hips.act(spread(values), data), expected, atol=1e-5, rtol=1e-5)
        torch.testing.assert_close(hips.torque_asked(spread((9, 9, 9)), data), expected, atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("model", ["ImplicitActuator", "IdealPDActuator", "DCMotor"])
def test_every_model_can_have_a_delay(make_env, model):
    more = {"saturation_effort": 1e6} if model == "DCMotor" else {}
    env, hips = with_hips(make_env, model, delay=[2, 2], effort_limit=1e6, velocity_limit=1e6, **more)
    robot, data, ids = env.scene.robot, env.scene.robot.data, hips.joint_ids
    targets = [torch.full((4, 4), v) for v in (0.1, 0.2, 0.3, 0.4, 0.5)]
    for step, target in enumerate(targets):
        robot.set_joint_position_target(target, slice(None))
        q, qd = data.joint_pos[:, ids].clone(), data.joint_vel[:, ids].clone()
        physics_step(env)
        expected = 20.0 * (targets[max(0, step - 2)][:, ids] - q) - 1.0 * qd
        torch.testing.assert_close(data.computed_torque[:, ids], expected, atol=1e-4, rtol=1e-4)
        torch.testing.assert_close(data.applied_torque[:, ids], expected, atol=1e-4, rtol=1e-4)


def test_lags_are_drawn_at_each_reset_for_each_environment_from_the_groups_stream(make_env):
    groups = make_env().cfg["robot"]["actuators"]
    groups["hips"] |= {"delay": [1, 4]}
    env = make_env(robot={"actuators": groups}, num_envs=400)
    delay = env.scene.robot.actuators["hips"].delay
    assert (delay._past.lag == 0).all()
    env.reset()
    first = delay._past.lag.clone()
    assert first.unique().tolist() == [1, 2, 3, 4]
    assert all(70 < int((first == lag).sum()) < 130 for lag in (1, 2, 3, 4))
    env.reset(env_ids=torch.arange(100))
    assert torch.equal(delay._past.lag[100:], first[100:])
    assert not torch.equal(delay._past.lag[:100], first[:100])
    assert "env.robot.actuators.hips" in env.streams.state_dict()["generators"]


def test_the_targets_of_an_episode_do_not_reach_the_next(make_env):
    env, hips = with_hips(make_env, "DelayedPDActuator", stiffness=1.0, damping=0.0, min_delay=2, max_delay=2)
    data, still = env.scene.robot.data, env.scene.robot.data.joint_pos[:, hips.joint_ids]
    for _ in range(3):
        hips.act(spread((1.0, 0.0, 0.0)), data)
    hips.begin(torch.tensor([1, 3]))
    assert (hips.act(spread((2.0, 0.0, 0.0)), data) + still)[:, 0].tolist() == pytest.approx([1.0, 2.0, 1.0, 2.0])


TABLE = [[-0.5, 1.0, 1.0], [0.5, 1.0, 3.0], [1.0, 1.0, 2.0]]


@pytest.mark.parametrize("pos", [-1.4, -0.5, -0.1, 0.3, 0.5, 0.7, 1.0, 1.4])
def test_behind_a_linkage_the_largest_torque_follows_from_the_position(make_env, pos):
    limits = ("effort_limit", "velocity_limit")
    env, hips = with_hips(make_env, "RemotizedPDActuator", limits, **GAINS, joint_parameter_lookup=TABLE)
    robot, data = env.scene.robot, env.scene.robot.data
    robot.write_joint_state_to_sim(torch.full((4, 4), pos), torch.zeros(4, 4), env_ids=torch.arange(4))
    data.invalidate()
    largest = float(np.interp(pos, [row[0] for row in TABLE], [row[2] for row in TABLE]))
    for asked, given in ((50.0, largest), (-50.0, -largest), (0.4, 0.4)):
        torch.testing.assert_close(hips.act(spread((0, 0, asked)), data), torch.full((4, 2), given))
        assert (hips.torque_asked(spread((0, 0, asked)), data) == asked).all()
    assert (hips.effort_limit == math.inf).all()


@pytest.mark.parametrize(
    ("model", "key", "fields", "words"),
    [
        ("ImplicitActuator", "stiffness", {"stiffness": {"left_.*": 5.0}}, "no value for joint right_hip"),
        ("ImplicitActuator", "damping", {"damping": -1.0}, "at least 0"),
        ("ImplicitActuator", "joint_names_expr", {"joint_names_expr": ["hip"]}, "matches nothing"),
        ("ImplicitActuator", "effort_limit", {"effort_limit": {"left_ankle": 1.0}}, "matches nothing"),
        ("DelayedPDActuator", "min_delay", {"min_delay": 3, "max_delay": 2}, "more than max_delay, 2"),
        ("ImplicitActuator", "delay", {"delay": [2, 1]}, ""),
        ("ImplicitActuator", "delay", {"delay": [0.5, 1]}, ""),
        ("DCMotor", "saturation_effort", {"saturation_effort": 0.0}, ""),
        *(
            ("RemotizedPDActuator", "joint_parameter_lookup", {"joint_parameter_lookup": rows}, "")
            for rows in (TABLE[:1], TABLE[::-1], [[0.0, 1.0], [1.0, 1.0]])
        ),
    ],
)
def test_wrong_numbers_name_their_key(make_env, model, key, fields, words):
    limits = ("effort_limit", "velocity_limit") if model == "RemotizedPDActuator" else ()
    with pytest.raises(ConfigError) as caught:
        with_hips(make_env, model, limits, **fields)
    assert caught.value.key == f"env.robot.actuators.hips.{key}"
    assert words in str(caught.value)
