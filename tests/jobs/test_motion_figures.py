"""Compare metrics of motion with hand calculations for a fake environment and with closed forms."""

import math
from dataclasses import fields
from types import SimpleNamespace

import pytest
import torch

from wheelleg_exp.definitions import MOTION
from wheelleg_exp.jobs.rollout_figures import MotionFigures, MotionMeter

STEP = 0.5  # s; one physics step


class FakeEnv:
    """Two fake environments of two joints, whose quantities a test sets by hand."""

    def __init__(self):
        self.num_envs, self.step_dt, self.physics_dt, self.device = 2, STEP, STEP, torch.device("cpu")
        self.episode_length_buf = torch.zeros(2, dtype=torch.long)
        names = ("joint_pos", "joint_vel", "joint_vel_before", "applied_torque", "joint_armature")
        self.data = SimpleNamespace(**{name: torch.zeros(2, 2) for name in names})
        self.data.joint_effort_limits = torch.tensor([[2.0, math.inf]] * 2)
        self.data.root_pos_w, self.data.heading_w = torch.zeros(2, 3), torch.zeros(2)
        groups = {name: SimpleNamespace(joint_ids=torch.tensor([i])) for i, name in enumerate(("leg", "wheel"))}
        self.scene = SimpleNamespace(robot=SimpleNamespace(data=self.data, actuators=groups), sensors={})
        self.action_manager = SimpleNamespace(action=torch.zeros(2, 2), prev_action=torch.zeros(2, 2))
        self.termination_manager = SimpleNamespace(dones=torch.zeros(2, dtype=torch.bool))

    def step(
        self, meter, *, place=(0.0, 0.0), heading=(0.0, 0.0), torque=((0.0, 0.0),) * 2, speed=0.0, action=0.0, done=()
    ):
        """Advance one step, in which the joints reach ``speed``, rad/s."""
        self.episode_length_buf += 1
        self.data.root_pos_w[:, 0] = torch.tensor(place)
        self.data.heading_w = torch.tensor(heading)
        self.data.applied_torque = torch.tensor(torque)
        self.data.joint_vel_before = self.data.joint_vel
        self.data.joint_vel = torch.full((2, 2), float(speed))
        self.action_manager.prev_action = self.action_manager.action
        self.action_manager.action = torch.full((2, 2), float(action))
        self.termination_manager.dones = torch.tensor([i in done for i in range(2)])
        for sensor in self.scene.sensors.values():
            sensor.update()
        meter.observe()
        self.episode_length_buf[self.termination_manager.dones] = 0


def moving(settle_s=0.0):
    env = FakeEnv()
    return env, MotionMeter(env, settle_s)


def test_the_way_is_from_where_it_settled_and_means_are_over_episodes():
    env, meter = moving(STEP)
    env.step(meter, place=(9.0, 9.0))
    env.step(meter, place=(1.0, 5.0), heading=(3.0, 0.0))
    env.step(meter, place=(4.0, 4.0), heading=(-3.0, 0.1))
    env.step(meter, place=(2.0, 5.0), heading=(-3.1, 0.0))
    found = meter.figures()
    assert found.drift_m == pytest.approx((3.0 + 1.0) / 2)
    assert found.yaw_drift_deg == pytest.approx(
        math.degrees((2 * math.pi - 6.0 + 0.1) / 2), rel=1e-5
    )  # past half a turn


def test_torques_by_hand():
    env, meter = moving()
    for leg, wheel in ((2.0, 1.0), (-1.0, -1.0), (0.0, 1.0), (1.0, 0.0), (0.0, -1.0)):
        env.step(meter, torque=((leg, wheel), (leg, wheel)))
    found = meter.figures()
    assert found.torque_rms_nm == pytest.approx({"leg": math.sqrt(6 / 5), "wheel": math.sqrt(4 / 5)})
    assert found.at_limit == pytest.approx({"leg": 1 / 5, "wheel": 0.0})
    assert found.sign_changes_per_s == pytest.approx({"leg": 2 / (5 * STEP), "wheel": 3 / (5 * STEP)})


def test_what_only_swings_the_armature_is_no_power():
    env, meter = moving()
    env.data.joint_armature[:] = 0.5
    env.step(meter, torque=((2.0, 2.0),) * 2, speed=2.0)
    assert meter.figures().power_net_w == pytest.approx(0.0, abs=1e-6)
    env.step(meter, torque=((3.0, 0.0),) * 2, speed=2.0)
    assert meter.figures().power_net_w == pytest.approx(3.0 * 2.0 / 2)


def test_actions_change_by_their_mean_size_and_not_at_the_beginning():
    env, meter = moving(STEP)
    for action in (8.0, 1.0, 0.0, 4.0):
        env.step(meter, action=action)
    assert meter.figures().action_rate_per_s == pytest.approx((1.0 + 4.0) / 2 / STEP)


def test_second_episodes_do_not_count():
    env, meter = moving()
    env.step(meter, torque=((1.0, 1.0),) * 2, done=(0, 1))
    first = meter.figures()
    env.step(meter, place=(9.0, 9.0), torque=((2.0, 2.0),) * 2, action=5.0)
    assert meter.figures() == first


def test_nobody_who_settled_gives_no_figures():
    env, meter = moving(9.0)
    env.step(meter)
    assert all(value in (None, {}) for value in vars(meter.figures()).values())


def test_every_key_has_a_definition():
    assert {field.name for field in fields(MotionFigures)} == set(MOTION)
