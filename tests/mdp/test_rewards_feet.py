"""Rewards on feet and wheels, compared with values computed by hand and with MuJoCo's contact points."""

import math

import mujoco
import numpy as np
import pytest
import torch

from mdp.fakes import close, entity, fake_env
from wheelleg_exp.errors import ConfigError
from wheelleg_exp.mdp import rewards

T = torch.tensor
FEET = entity("contact", bodies=[0, 2])
CONTACT, ALL = entity("contact"), entity()


def _timed(command):
    last_contact = T([[0.25, 9.0, 0.25], [1.0, 9.0, 0.5]])
    return fake_env(
        step_dt=0.02,
        first_contact=T([[True, True, True], [False, True, True]]),
        contact={"last_air_time": T([[0.75, 9.0, 0.25], [0.75, 9.0, 1.0]]), "last_contact_time": last_contact},
        commands={"v": T([[command, 0.0, 9.0]] * 2)},
    )


def test_flights_count_when_they_end_and_while_walking_is_commanded():
    """The rewards are 0.75 - 0.5 + 0.25 - 0.5, and 1.0 - 0.5 where the first foot has not landed."""
    close(rewards.feet_air_time(_timed(0.2), "v", FEET, threshold=0.5), [0.0, 0.5])
    close(rewards.feet_air_time(_timed(0.2), "v", FEET, threshold=0.25), [0.5, 0.75])
    close(rewards.feet_air_time(_timed(0.1), "v", FEET, threshold=0.25), [0, 0])


def test_one_foot_stands_for_as_long_as_the_other_flies():
    env = fake_env(
        contact={
            "current_contact_time": T([[0.4, 1.0, 0.0], [0.0, 1.0, 0.0], [0.2, 1.0, 0.3], [2.0, 1.0, 0.0]]),
            "current_air_time": T([[0.0, 0.0, 0.3], [0.4, 0.0, 0.2], [0.0, 0.0, 0.0], [0.0, 0.0, 3.0]]),
        },
        commands={"v": T([[0.0, 0.2, 0.0]] * 4), "still": T([[0.0, 0.0, 9.0]] * 4)},
    )
    close(rewards.feet_air_time_positive_biped(env, "v", 0.5, FEET), [0.3, 0, 0, 0.5])
    close(rewards.feet_air_time_positive_biped(env, "still", 0.5, FEET), [0, 0, 0, 0])


def test_an_uneven_gait():
    """The variance of two numbers a and b is (a - b)^2 / 2."""
    close(rewards.air_time_variance(_timed(0.0), FEET, max_time=0.5), [0.25**2 / 2, 0])
    close(rewards.air_time_variance(_timed(0.0), FEET, max_time=2.0), [0.5**2 / 2, 0.25**2 / 2 + 0.5**2 / 2])


MOVING = {"data_body_lin_vel_w": T([[[3.0, 4.0, 9.0], [1.0, 0.0, 0.0]], [[0.0, 2.0, 0.0], [0.0, 0.5, 0.0]]])}


def test_feet_that_touch_and_slide():
    env = fake_env(**MOVING, contact_norm=T([[1.5, 9.0, 0.5], [1.0, 9.0, 2.0]]))
    bodies = entity(bodies=[0, 1])
    close(rewards.feet_slide(env, FEET, bodies), [5, 0.5])
    close(rewards.feet_slide(env, FEET, bodies, threshold=0.4), [6, 2.5])


def _slip(env, sensor=CONTACT, asset=ALL):
    return rewards.wheel_slip(env, 0.1, sensor, asset)


@pytest.mark.parametrize("reward", [rewards.feet_slide, rewards.wheel_spin_in_air_l1, _slip])
def test_a_sensors_bodies_must_be_the_robots(reward):
    contact = {"contact_norm": torch.ones(2, 3), "contact": {"net_forces_w": torch.ones(2, 3, 3)}}
    still = {"data_body_ang_vel_w": torch.zeros(2, 2, 3), "data_joint_vel": torch.zeros(2, 2)}
    env = fake_env(**MOVING, **contact, **still)
    with pytest.raises(ConfigError, match="3 bodies of the sensor, and 2 of the robot"):
        reward(env, CONTACT, ALL)


def test_a_foot_that_runs_into_something_steep():
    force = T([[[8.2, 0.0, 2.0], [99.0, 0.0, 0.0], [0.0, 0.0, 5.0]], [[0.0, 7.8, -2.0], [0.0] * 3, [0.0] * 3]])
    env = fake_env(contact={"net_forces_w": force})
    close(rewards.feet_stumble(env, FEET), [1, 0])
    close(rewards.feet_stumble(env, FEET, ratio=3.5), [1, 1])
    close(rewards.feet_stumble(env, FEET, ratio=5.0), [0, 0])


def test_feet_that_move_low():
    positions = T([[[0.0, 0.0, 0.05], [1.0, 0.0, 0.25]]] * 2)
    env = fake_env(**MOVING, data_body_pos_w=positions, ground=lambda xy: 0.1 * xy[..., 0])
    close(rewards.feet_clearance_l2(env, 0.1, entity()), [0.0025 * 6, 0.0025 * 2.5])


def test_wheels_that_turn_in_the_air():
    env = fake_env(contact_norm=T([[1.0, 9.0, 2.0], [0.0, 9.0, 0.0]]), data_joint_vel=T([[-3.0, 1.0], [2.0, -4.0]]))
    close(rewards.wheel_spin_in_air_l1(env, FEET, entity(joints=[0, 1])), [3, 6])


def _wheels(velocity, spin, force):
    shape = (len(velocity), 1, 3)
    return fake_env(
        data_body_lin_vel_w=T(velocity).view(shape),
        data_body_ang_vel_w=T(spin).view(shape),
        contact={"net_forces_w": T(force).view(shape)},
    )


def test_a_wheel_that_rolls_does_not_slip():
    """Wheels of 0.1 m roll along x, roll with a turned axle, lock, spin in place, slide sideways, or barely touch."""
    velocity = [[1.0, 0, 0], [0.6, 0.8, 0], [1.0, 0, 0], [0.0, 0, 0], [0, 0.3, 0], [1.0, 0, 0], [1.0, 0, 0]]
    spin = [[0, 10.0, 0], [-8.0, 6.0, 0], [0.0, 0, 0], [0, 5.0, 0], [0, 0.0, 0], [0, 0.0, 0], [0, 0.0, 0]]
    close(_slip(_wheels(velocity, spin, [[0.0, 0, 5]] * 5 + [[0.0, 0, 1.0], [0.0, 0, 0]])), [0, 0, 1, 0.5, 0.3, 0, 0])


def test_rolling_up_a_slope_and_bouncing_are_not_slip():
    """The slope has 30 degrees, and the second wheel also has a velocity along the normal of the slope."""
    c, s = math.cos(math.pi / 6), math.sin(math.pi / 6)
    up, normal = [2 * c, 0.0, 2 * s], [-7 * s, 0.0, 7 * c]
    close(_slip(_wheels([up, [2 * c - s, 0.0, 2 * s + c]], [[0, 20.0, 0]] * 2, [normal] * 2)), [0, 0])


BALL = """<mujoco><worldbody>
  <geom type="plane" size="0 0 1" euler="20 -10 0"/>
  <body name="wheel"><freejoint/><geom type="sphere" size=".1" mass="1"/></body>
</worldbody></mujoco>"""


def test_slip_is_the_speed_of_mujocos_contact_point():
    """The expected slip is the contact point's Jacobian times the velocity, without the part along the normal."""
    model, draw = mujoco.MjModel.from_xml_string(BALL), np.random.default_rng(0)
    data = mujoco.MjData(model)
    for _ in range(20):
        mujoco.mj_resetData(model, data)
        mujoco.mj_kinematics(model, data)
        data.qpos[:3] = data.geom_xmat[0].reshape(3, 3)[:, 2] * (0.1 - 1e-7)
        data.qpos[3:] = draw.standard_normal(4)
        data.qvel[:] = draw.standard_normal(6) * [1, 1, 1, 10, 10, 10]
        mujoco.mj_forward(model, data)
        (contact,) = data.contact
        jacobian, moved = np.zeros((3, 6)), np.zeros(6)
        mujoco.mj_jac(model, data, jacobian, None, contact.pos, 1)
        mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_BODY, 1, moved, 0)
        slip, normal = jacobian @ data.qvel, contact.frame[:3]
        env = _wheels([moved[3:].tolist()], [moved[:3].tolist()], [(3.0 * normal).tolist()])
        assert float(_slip(env)) == pytest.approx(np.linalg.norm(slip - slip @ normal * normal), rel=1e-4)
