"""Compare metrics of rollouts with results calculated by hand for a fake environment."""

from __future__ import annotations

import math
from collections import Counter
from types import SimpleNamespace

import pytest
import torch

from wheelleg_exp.jobs.rollout_figures import ContactFigures, ContactMeter, StandMeter

STEP = 0.5  # s


class FakeEnv:
    """Three fake environments whose quantities a test sets by hand."""

    def __init__(self, terms=(("alive", {}), ("base_height", {"target_height": 0.3}))):
        self.num_envs, self.step_dt, self.extras = 3, STEP, {}
        self.episode_length_buf = torch.zeros(3, dtype=torch.long)
        self.reward_buf = torch.zeros(3)
        self.data = SimpleNamespace(root_pos_w=torch.zeros(3, 3), projected_gravity_b=torch.zeros(3, 3))
        forces = SimpleNamespace(net_forces_w=torch.zeros(3, 2, 3))
        self.sensor = SimpleNamespace(body_names=["wheel", "leg"], data=forces)
        self.scene = _Scene(contact_forces=self.sensor)
        self.scene.robot = SimpleNamespace(data=self.data)
        self.termination_manager = SimpleNamespace(active_terms=("time_out", "fell"), endings=self.endings)
        params = {name: SimpleNamespace(params=values) for name, values in terms}
        self.reward_manager = SimpleNamespace(active_terms=list(params), get_term_cfg=params.__getitem__)

    def set(self, heights=(0.3, 0.3, 0.3), pitches=(0.0, 0.0, 0.0), rewards=(0.0, 0.0, 0.0), out=(), fell=()):
        """Set the state after one more step: heights in m, pitches in rad, and the ended environments."""
        self.episode_length_buf += 1
        self.data.root_pos_w[:, 2] = torch.tensor(heights)
        angle = torch.tensor(pitches)
        # Rotate gravity (0, 0, -1) into the axes of a base that is pitched about its y axis.
        self.data.projected_gravity_b = torch.stack([angle.sin(), torch.zeros(3), -angle.cos()], dim=1)
        self.reward_buf = torch.tensor(rewards)
        manager = self.termination_manager
        manager.time_outs, manager.terminated = (torch.tensor([i in ids for i in range(3)]) for ids in (out, fell))
        manager.dones = manager.time_outs | manager.terminated

    def endings(self, ids):
        fired = {"time_out": self.termination_manager.time_outs, "fell": self.termination_manager.terminated}
        return Counter(" and ".join(name for name in fired if fired[name][i]) for i in ids.nonzero()[:, 0].tolist())


class _Scene(dict):
    robot: SimpleNamespace


def observe(env, meter, **values):
    env.set(**values)
    meter.observe()
    env.episode_length_buf[env.termination_manager.dones] = 0


def standing(settle_s=0.0):
    env = FakeEnv()
    return env, StandMeter(env, settle_s=settle_s)


def test_a_case_by_hand():
    env, meter = standing(2 * STEP)
    observe(env, meter, heights=(9.0, 9.0, 9.0), pitches=(1.0, 1.0, 1.0), rewards=(1.0, 2.0, 4.0))
    observe(env, meter, heights=(9.0, 9.0, 9.0), pitches=(1.0, 1.0, 1.0), rewards=(1.0, 2.0, 4.0), fell=(2,))
    observe(env, meter, heights=(0.31, 0.28, 9.0), pitches=(0.1, -0.3, 1.0), rewards=(1.0, -9.0, 7.0), fell=(1,))
    observe(env, meter, heights=(0.33, 9.0, 9.0), pitches=(0.5, 1.0, 1.0), rewards=(1.0, 7.0, 7.0), out=(0,))
    figures = meter.figures()
    assert not meter.running.any()
    assert (figures.episodes, figures.survival) == (3, pytest.approx(1 / 3))
    errors, angles = (0.01, -0.02, 0.03), (0.1, -0.3, 0.5)
    assert figures.height_rmse_m == pytest.approx(math.sqrt(sum(e * e for e in errors) / 3), rel=1e-5)
    assert figures.height_mean_m == pytest.approx((0.31 + 0.28 + 0.33) / 3)
    assert figures.pitch_rms_deg == pytest.approx(math.degrees(math.sqrt(sum(a * a for a in angles) / 3)), rel=1e-5)
    assert figures.pitch_mean_deg == pytest.approx(math.degrees(0.1), rel=1e-5)  # It leans forwards.
    assert figures.mean_return == pytest.approx((4.0 + (2 + 2 - 9) + 8.0) / 3)
    assert figures.ended_by == {"time_out": 1, "fell": 2}
    assert (figures.settle_s, figures.settled_episodes, figures.settled_steps) == (2 * STEP, 2, 3)


def test_an_episode_with_nan_counts_in_no_return_and_in_height_up_to_then():
    env, meter = standing()
    observe(env, meter, heights=(0.2, 0.3, 0.4), rewards=(1.0, 2.0, 4.0))
    env.extras = {"non_finite": {"keys": {1: ["env.sim"]}}}
    observe(env, meter, heights=(0.2, math.nan, 0.4), pitches=(0.0, math.nan, 0.0), rewards=(1.0, 0.0, 4.0), fell=(1,))
    env.extras = {"non_finite": {"keys": {1: ["env.rewards.x"]}}}  # of its second episode
    observe(env, meter, heights=(0.2, 9.0, 0.4), rewards=(1.0, 0.0, 4.0), out=(0, 2))
    figures = meter.figures()
    assert figures.non_finite == figures.as_dict()["non_finite"] == {"env.sim": 1}
    assert figures.mean_return == pytest.approx((3.0 + 12.0) / 2)
    assert (figures.height_mean_m, figures.settled_steps) == (pytest.approx((3 * 0.2 + 0.3 + 3 * 0.4) / 7), 7)


def test_a_fall_at_the_time_out_is_no_survival_and_counts_once():
    env, meter = standing()
    observe(env, meter, out=(0, 1), fell=(1, 2))
    assert meter.figures().survival == pytest.approx(1 / 3)
    assert meter.figures().ended_by == {"time_out": 1, "fell": 1, "time_out and fell": 1}


def test_unfinished_episodes_do_not_count_as_ended():
    env, meter = standing()
    observe(env, meter, rewards=(1.0, 5.0, 9.0))
    assert (meter.figures().survival, meter.figures().mean_return) == (None, None)
    observe(env, meter, rewards=(1.0, 5.0, 9.0), out=(0,))
    figures = meter.figures()
    assert (figures.episodes, figures.unfinished, figures.ended) == (3, 2, 1)
    assert (figures.survival, figures.mean_return) == (1.0, 2.0)


def test_second_episodes_do_not_count():
    env, meter = standing()
    observe(env, meter, rewards=(1.0, 1.0, 1.0), out=(0, 1, 2))
    first = meter.figures()
    observe(env, meter, heights=(9.0, 9.0, 9.0), pitches=(1.0, 1.0, 1.0), rewards=(9.0, 9.0, 9.0), fell=(0, 1, 2))
    assert meter.figures() == first


def test_steps_that_do_not_divide_a_second_settle_in_whole_steps():
    env = FakeEnv()
    env.step_dt = 2 * 0.008333333333333333
    meter = StandMeter(env, settle_s=1.0)
    for k in range(1, 62):
        observe(env, meter, heights=(float(k),) * 3)
    assert meter.figures().height_mean_m == 61.0


def test_nobody_who_settled_gives_no_figures():
    env, meter = standing(10.0)
    observe(env, meter, fell=(0, 1, 2))
    figures = meter.figures()
    assert figures.survival == 0.0
    assert math.isnan(figures.height_mean_m)
    assert math.isnan(figures.pitch_rms_deg)


def test_a_task_without_a_target_has_no_height_error():
    env = FakeEnv(terms=[("alive", {})])
    meter = StandMeter(env, settle_s=0.0)
    observe(env, meter, heights=(0.1, 0.2, 0.3))
    assert meter.figures().height_rmse_m is None
    assert meter.figures().height_mean_m == pytest.approx(0.2)


def contact(env, forces, pitches=(0.0, 0.0, 0.0)):
    env.set(pitches=pitches)
    env.sensor.data.net_forces_w = torch.tensor([[[0.0, 0.0, f] for f in row] for row in forces])


def test_contacts_by_hand():
    env = FakeEnv()
    meter = ContactMeter(env, "contact_forces", settle_s=1.0, upright_rad=0.3)
    contact(env, [[99.0, 99.0]] * 3)
    meter.observe()
    contact(env, [[2.0, 0.0], [4.0, 1.0], [99.0, 99.0]], pitches=(0.1, -0.29, 0.31))
    meter.observe()
    contact(env, [[0.0, 0.0], [99.0, 99.0], [99.0, 99.0]], pitches=(0.0, 1.0, -1.0))
    meter.observe()
    wheel, leg = meter.figures()
    assert wheel == ContactFigures("wheel", pytest.approx(2.0), 4.0, pytest.approx(2 / 3), 3)
    assert leg == ContactFigures("leg", pytest.approx(1 / 3), 1.0, pytest.approx(1 / 3), 3)


def test_the_length_of_a_force_counts_and_only_after_the_settling_time():
    env = FakeEnv()
    meter, late = (ContactMeter(env, "contact_forces", settle_s=s, upright_rad=0.3) for s in (0.0, 10.0))
    env.set()
    env.sensor.data.net_forces_w = torch.tensor([[[3.0, 0.0, 4.0], [0.0, -2.0, 0.0]]] * 3)
    meter.observe()
    late.observe()
    assert [row.mean_n for row in meter.figures()] == pytest.approx([5.0, 2.0])
    assert late.figures() == []
