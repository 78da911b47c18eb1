"""Test the columns of episodes against closed forms on synthetic trajectories."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from evaluation.synthetic import DT, fall, parts, still, times
from wheelleg_exp.evaluation import disturbance_tests, motion_columns
from wheelleg_exp.evaluation.disturbance_tests import recovery
from wheelleg_exp.evaluation.metric_catalogue import measured, metrics_of
from wheelleg_exp.evaluation.motion_columns import Motion, impact, jump, resting_sides
from wheelleg_exp.evaluation.protocol_options import Jump, Push, Steps, Walk

WALK = Walk(
    episodes=1, horizon_s=10.0, lin_vel_x=[-0.3, 0.0, 0.3], ang_vel_z=[0.0, 0.5], steady_s=3.0, band=0.1,
    std_lin_vel_x=0.1, std_ang_vel_z=0.2,
)  # fmt: skip
JUMP = Jump(1, [0.3], [0.0], 2.0, 0.04, 4.0, None, 0.25, 0.015, 0.3, 2.5, 0.05, 0.2, 0.8, 0.02, 0.02, 10.0, False, [])


def one(columns, name):
    return float(columns[name][0])


def test_a_sine_has_its_amplitude_over_root_two_and_a_mean_of_its_middle():
    made = still(11.0)
    t = times(made)
    made.pitch[:, 0] = 0.1 + 0.2 * torch.sin(2 * math.pi * t)
    made.height[:, 0] = 0.07 + 0.01 * torch.sin(2 * math.pi * t)
    columns = measured(Motion(made, parts(), 1.0, 0.07))
    assert one(columns, "pitch_rms_rad") == pytest.approx(math.sqrt(0.1**2 + 0.2**2 / 2), rel=1e-5)
    assert one(columns, "lean_rad") == pytest.approx(0.1, rel=1e-5)
    assert one(columns, "pitch_std_rad") == pytest.approx(0.2 / math.sqrt(2), rel=1e-5)
    assert one(columns, "height_rmse_m") == pytest.approx(0.01 / math.sqrt(2), rel=1e-4)
    assert one(columns, "height_mean_m") == pytest.approx(0.07, rel=1e-5)


def test_motion_while_settling_and_after_a_fall_does_not_count():
    made = still(5.0, 2)
    made.pitch[:60] = 1.0
    fall(made, 1, 3.0)
    made.pitch[180:, 1] = 1.0
    assert measured(Motion(made, parts(2), 1.0))["pitch_rms_rad"].tolist() == [0.0, 0.0]
    fall(made, 0, 0.5)  # This episode ends while settling.
    assert math.isnan(one(measured(Motion(made, parts(2), 1.0, 0.07)), "height_rmse_m"))
    assert math.isnan(one(motion_columns.drift(made, 1.0), "drift_max_m"))


def test_a_fall_appears_at_the_moments_after_it():
    made = still(20.0, 2)
    fall(made, 1, 7.0)
    columns = motion_columns.survival(made, [5.0, 7.0, 20.0, 60.0])
    assert columns["survived_5s"].tolist() == [1.0, 1.0]
    assert columns["survived_7s"].tolist() == columns["survived_20s"].tolist() == [1.0, 0.0]
    assert "survived_60s" not in columns  # The horizon is shorter than 60 s.
    assert columns["time_to_failure_s"].tolist() == pytest.approx([20.0, 7.0])


def test_a_constant_drift_has_its_speed_and_its_way_since_settling():
    made = still(11.0)
    made.pos[:, 0, 0], made.pos[:, 0, 1] = 0.03 * times(made), 0.04 * times(made)
    made.yaw[:, 0] = torch.remainder(3.0 + 0.1 * times(made) + math.pi, 2 * math.pi) - math.pi  # The yaw wraps at pi.
    columns = motion_columns.drift(made, 1.0)
    assert one(columns, "drift_speed_m_s") == pytest.approx(0.05, rel=1e-5)
    assert one(columns, "drift_max_m") == pytest.approx(0.5, rel=1e-4)
    assert one(columns, "yaw_drift_rad") == pytest.approx(1.0, rel=1e-3)
    assert one(columns, "yaw_drift_rad_s") == pytest.approx(0.1, rel=1e-4)
    made.pos[:, 0, 0], made.pos[:, 0, 1] = 0.2 * torch.sin(math.pi * (times(made) - 1.0) / 10.0), 0.0
    assert one(motion_columns.drift(made, 1.0), "drift_max_m") == pytest.approx(0.2, rel=1e-3)  # It returns.


def test_legs_are_compared_by_the_sign_of_their_mirror_and_lifted_wheels_are_counted():
    made = still(3.0)
    made.joint_pos[..., 0], made.joint_pos[..., 1] = 0.5, -0.5
    made.down[::2, 0, 1] = False
    columns = measured(Motion(made, parts(), 1.0))
    assert (one(columns, "leg_symmetry_rms_rad"), one(columns, "wheels_down_share")) == (0.0, pytest.approx(0.5))
    made.joint_pos[..., 1] = 0.5
    assert one(measured(Motion(made, parts(), 1.0)), "leg_symmetry_rms_rad") == pytest.approx(1.0)


def test_torques_are_root_mean_squares_over_joints_and_sign_changes_are_per_wheel_and_second():
    made = still(11.0)
    made.torque_rms[:, 0, 2], made.torque_rms[:, 0, 3] = 3.0, 5.0
    made.torque_rms[:60], made.sign_changes[:60] = 9.0, 9.0
    made.sign_changes[60::6, 0, 1] = 2.0
    motion = Motion(made, parts(), 1.0)
    columns = measured(motion) | motion_columns.group_effort(motion)
    assert one(columns, "wheel_sign_changes_per_s") == pytest.approx(10.0)
    assert one(columns, "torque_rms_wheels_nm") == pytest.approx(math.sqrt((9.0 + 25.0) / 2))
    assert one(columns, "torque_share_wheels") == pytest.approx(math.sqrt((9.0 + 25.0) / 2) / 10.0)
    assert one(columns, "torque_rms_hips_nm") == 0.0


def test_saturation_is_a_share_with_its_worst_joint():
    made = still(3.0)
    made.saturated[..., 3] = 1.0
    columns = motion_columns.group_effort(Motion(made, parts(), 1.0))
    assert one(columns, "saturation_wheels") == pytest.approx(0.5)
    assert one(columns, "saturation_max_wheels") == pytest.approx(1.0)
    assert one(columns, "saturation_hips") == 0.0


def test_the_cost_of_transport_is_energy_over_weight_and_way():
    made = still(11.0, 2)
    made.pos[:, 0, 0] = 0.3 * times(made)
    made.command[:, 0, 0] = 0.3
    made.work[..., 0], made.work[..., 1], made.work[..., 2] = 2.0 * DT, 0.5 * DT, 1.0 * DT
    made.work[..., 3] = 3.0
    columns = measured(Motion(made, parts(2), 1.0))
    assert columns["power_gross_w"].tolist() == pytest.approx([2.0, 2.0], rel=1e-5)
    assert columns["positive_work_j"].tolist() == pytest.approx([10.0, 10.0], rel=1e-5)
    assert columns["peak_power_w"].tolist() == [3.0, 3.0]
    assert one(columns, "cost_of_transport_gross") == pytest.approx(2.0 / (0.5 * 9.81 * 0.3), rel=1e-4)
    assert one(columns, "cost_of_transport_net") == pytest.approx(0.5 / (0.5 * 9.81 * 0.3), rel=1e-4)
    assert math.isnan(columns["cost_of_transport_net"][1])  # Episodes with a zero command have no cost of transport.


def test_alternating_actions_have_the_greatest_rate_and_acceleration():
    made = still(3.0)
    made.action[:] = torch.where(torch.arange(made.steps) % 2 == 0, 1.0, -1.0).view(-1, 1, 1)
    columns = measured(Motion(made, parts(), 1.0))
    assert one(columns, "action_rate_per_s") == pytest.approx(2.0 / DT)
    assert one(columns, "action_acceleration_per_s2") == pytest.approx(4.0 / DT**2)


@pytest.mark.parametrize(("hertz", "share"), [(2.0, 0.0), (20.0, 1.0)])
def test_power_above_and_below_ten_hertz_is_separated(hertz, share):
    made = still(11.0)
    made.torque[..., 2] = 1.0 + torch.sin(2 * math.pi * hertz * times(made)).unsqueeze(1)  # The mean must not count.
    assert one(measured(Motion(made, parts(), 1.0)), "fast_power_share") == pytest.approx(share, abs=1e-4)


def test_both_errors_come_together_at_the_wheels():
    made = still(11.0, 4)
    made.command[..., 0], made.command[..., 2] = 0.3, 0.5
    made.vel[..., 0], made.ang[..., 2] = 0.3, 0.5
    made.vel[:, 1, 0], made.ang[:, 2, 2] = 0.33, 0.9
    made.vel[:, 3, 0], made.ang[:, 3, 2] = 0.33, 0.9
    columns = motion_columns.wheel_error(made, parts(4), 1.0)
    assert columns["error_wheels_m_s"].tolist() == pytest.approx([0.0, 0.03, 0.04, 0.05], abs=1e-6)
    lopsided = replace(parts(4), wheel_offsets=torch.tensor([0.2, -0.1]))
    both = math.sqrt(((0.03 - 0.4 * 0.2) ** 2 + (0.03 + 0.4 * 0.1) ** 2) / 2)
    assert float(motion_columns.wheel_error(made, lopsided, 1.0)["error_wheels_m_s"][3]) == pytest.approx(both)


def test_standing_still_earns_the_score_of_standing_still_and_tracking_all():
    made = still(11.0, 3)
    made.command[..., 0] = 0.3
    made.vel[:, 1, 0], made.vel[:, 2, 0] = 0.3, -0.3
    columns = motion_columns.tracking(made, 1.0, WALK)
    columns |= motion_columns.within_band(made, columns, WALK)
    lone = math.exp(-9.0)
    assert columns["score_vx"].tolist() == pytest.approx([lone, 1.0, math.exp(-36.0)], rel=1e-5)
    assert columns["still_vx"].tolist() == pytest.approx([lone] * 3, rel=1e-5)
    assert columns["error_vx"].tolist() == pytest.approx([0.3, 0.0, 0.6], abs=1e-6)
    assert columns["sign_vx"].tolist() == [0.0, 1.0, 0.0]
    assert columns["in_band"].tolist() == [0.0, 1.0, 0.0]


def test_errors_of_the_reaction_and_of_the_steady_drive_are_separate():
    made = still(5.0)
    made.command[..., 0] = 0.3
    made.vel[..., 0] = torch.where(times(made) > WALK.steady_s, 0.29, 0.1)[:, None]
    columns = motion_columns.tracking(made, 1.0, WALK)
    assert float(columns["error_vx_transient"]) == pytest.approx(0.2, rel=0.02)
    assert float(columns["error_vx_steady"]) == pytest.approx(0.01, rel=0.02)


def test_a_fall_costs_the_score_of_the_rest_and_no_less_error_than_standing():
    made = still(11.0, 2)
    made.command[..., 0], made.vel[..., 0] = 0.3, 0.3
    fall(made, 1, 6.0 + DT)
    columns = motion_columns.tracking(made, 1.0, WALK)
    assert columns["score_vx"].tolist() == pytest.approx([1.0, 0.5])
    assert columns["error_vx_with_falls"].tolist() == pytest.approx([0.0, 0.3])
    off = motion_columns.within_band(made, columns, WALK)["off_vx"].tolist()
    assert off == pytest.approx([0.0, math.inf], abs=1e-6)


def test_where_nothing_is_asked_the_band_is_that_of_the_least_command():
    made = still(11.0, 2)
    made.vel[:, 0, 0], made.vel[:, 1, 0] = 0.02, 0.04
    columns = motion_columns.tracking(made, 1.0, WALK)
    assert motion_columns.within_band(made, columns, WALK)["in_band"].tolist() == [1.0, 0.0]


STEPS = Steps(episodes=1, stand_s=2.0, drive_s=4.0, lin_vel_x=[0.3], ang_vel_z=[], band=0.1)
FORWARDS = torch.tensor([[0.3, 0.0, 0.0]])


def steps_of_a_first_order_lag(tau: float):
    """Return episodes in which the velocity v follows the command c by v' = (c - v) / tau."""
    made = still(14.0)
    segment = ((torch.arange(made.steps) * DT - 2.0 + 1e-6) / 4.0).floor().long() + 1
    made.command[:, 0, 0] = torch.tensor([0.0, 0.3, -0.3, 0.0])[segment.clamp(0, 3)]
    speed, place = 0.0, 0.0
    for step in range(made.steps):
        speed += (float(made.command[step, 0, 0]) - speed) * (1.0 - math.exp(-DT / tau))
        place += speed * DT
        made.vel[step, 0, 0], made.pos[step, 0, 0] = speed, place
    return made


def test_a_first_order_lag_settles_after_its_logarithms():
    columns = motion_columns.responses(steps_of_a_first_order_lag(0.4), STEPS, FORWARDS)
    assert one(columns, "settle_s_vx") == pytest.approx(0.4 * math.log(10), abs=2 * DT)
    assert one(columns, "reversal_s_vx") == pytest.approx(0.4 * math.log(20), abs=2 * DT)
    assert one(columns, "stop_s_vx") == pytest.approx(0.4 * math.log(10), abs=2 * DT)
    assert one(columns, "overshoot_vx") == 0.0
    assert one(columns, "stop_distance_vx") == pytest.approx(0.3 * 0.4, abs=0.006)
    assert one(columns, "settle_did_vx") == 1.0


def test_who_never_reaches_the_band_has_not_settled():
    columns = motion_columns.responses(steps_of_a_first_order_lag(3.0), STEPS, FORWARDS)
    assert math.isnan(one(columns, "settle_s_vx"))
    assert (one(columns, "settle_did_vx"), one(columns, "stop_did_vx")) == (0.0, 0.0)


def test_pushes_add_up_to_their_change_of_velocity_over_their_length(monkeypatch):
    """The first two robots are pushed in one step, the others over three steps: forwards, or backwards."""
    given = []
    monkeypatch.setattr(disturbance_tests, "add_velocity", lambda env, change: given.append(change))
    cells = SimpleNamespace(cell_of=lambda: torch.arange(4))
    rollout = SimpleNamespace(env=SimpleNamespace(step_dt=0.02, device="cpu"), scenarios=cells)
    options = SimpleNamespace(directions=2, pulses_s=[0.0, 0.06], at_s=0.1)
    push = disturbance_tests.pushes(rollout, options)(torch.tensor([1.0, 1.0, 0.6, 0.6]))
    lengths = [push(step) or len(given) for step in range(12)]
    assert lengths == [0] * 5 + [1, 2] + [3] * 5
    changes = torch.stack(given)[:, :, 0]
    torch.testing.assert_close(changes[0], torch.tensor([1.0, -1.0, 0.2, -0.2]))
    torch.testing.assert_close(changes.sum(dim=0), torch.tensor([1.0, -1.0, 0.6, -0.6]))


def test_recovery_is_when_tilt_and_height_are_back_for_good():
    options = Push(
        episodes=1, directions=1, pulses_s=[0.0], at_s=2.0, after_s=4.0, highest=1.0, iterations=1, reference=0.1,
        recovered_tilt=0.25, recovered_height=0.01, recovered_s=0.3, within_s=2.5,
    )  # fmt: skip
    made = still(6.0, 4)  # The push does not disturb the last robot.
    made.height[:] = 0.07
    made.pitch[150:180, 0] = 0.3  # The robot tilts from 0.5 s to 1 s after the push.
    made.height[120:300, 1] = 0.05
    fall(made, 2, 3.0)
    columns = recovery(made, options, torch.full((4,), 0.07))
    assert columns["recovery_s"].tolist()[:2] == pytest.approx([1.0, 3.0])
    assert columns["recovered"].tolist() == [1.0, 0.0, 0.0, 1.0]
    assert columns["recovery_s"][2:].isnan().all()


def test_a_ballistic_jump_has_the_clearance_time_and_span_of_the_closed_form():
    made, speed, forwards = still(6.0, 2), 1.0, 0.3
    time = (times(made) - 3.0).clamp(min=0.0)
    height = (speed * time - 9.81 * time**2 / 2).clamp(min=0.0)
    made.clearance[:] = height.view(-1, 1, 1)
    made.clearance[:, 1, 0] = 0.0  # The second robot lifts only one wheel.
    made.down[:] = made.clearance <= 0.0
    made.pos[..., 0] = forwards * times(made).unsqueeze(1)
    found = jump(Motion(made, parts(2), 1.0), JUMP)
    assert found["height_error_m"].tolist() == pytest.approx([speed**2 / (2 * 9.81) - 0.04, 0.04], abs=1e-3)
    assert found["clearance_m"].tolist() == pytest.approx([speed**2 / (2 * 9.81), 0.0], abs=1e-3)
    assert found["air_s"].tolist() == pytest.approx([2 * speed / 9.81, 0.0], abs=0.02)
    above = 2 * math.sqrt(speed**2 - 2 * 9.81 * 0.02) / 9.81
    assert found["span_m"].tolist() == pytest.approx([forwards * above, 0.0], abs=0.01)
    assert found["jumped"].tolist() == [1.0, 0.0]


def test_a_robot_drives_if_its_mean_velocity_before_the_jump_is_near_the_command():
    made = still(6.0, 5)
    made.command[..., 0] = 0.3
    made.vel[..., 0] = torch.tensor([0.26, 0.34, 0.24, 0.3, 0.3])
    made.ang[..., 2] = torch.tensor([0.1, -0.1, 0.0, 0.0, 0.3])
    made.vel[: len(made.vel) // 6, :, 0] = 0.0  # Only the second before the jump counts.
    made.vel[len(made.vel) // 3 :, :, 0] = 0.0
    fall(made, 3, 0.9)
    found = jump(Motion(made, parts(5), 1.0), JUMP)
    assert found["off_speed_m_s"][:3].tolist() == pytest.approx([0.04, 0.04, 0.06], abs=1e-6)
    assert found["drove"].tolist() == [1.0, 1.0, 0.0, 0.0, 0.0]
    columns = {"test": np.array(["jump"] * 5), "cell": np.array([0.0, 0.0, 1.0, 1.0, 1.0])}
    columns["cell_name"] = np.array(["vx=0", "vx=0", "vx=0.3", "vx=0.3", "vx=0.3"])
    columns |= {name: found[name].numpy() for name in ("drove", "off_speed_m_s", "off_yaw_rate_rad_s")}
    columns |= {"jumped": np.ones(5), "recovered": np.array([1.0, 0.0, 1.0, 1.0, 1.0])}
    # Before evaluations had several worlds and turns, their episodes had no columns for these.
    numbers = {m.name: float(m.reduce(m.values(columns))) for m in metrics_of("jump", columns, {})}
    assert (numbers["jump/success"], numbers["jump/worst_success"]) == (0.2, 0.0)
    assert (numbers["jump/success/vx=0"], numbers["jump/success/vx=0.3"]) == (0.5, 0.0)
    assert numbers["jump/speed_error/vx=0.3"] == pytest.approx(0.03)  # without the robot that fell
    assert numbers["jump/yaw_rate_error/vx=0.3"] == pytest.approx(0.15)


def test_a_robot_turns_in_a_jump_if_its_yaw_rate_is_80_percent_of_the_command():
    made = still(7.0, 4)
    made.command[:, 1:, 2] = torch.tensor([0.5, -0.5, 0.5])
    made.ang[..., 2] = torch.tensor([0.1, 0.41, -0.39, 0.41])
    made.ang[: round(2.0 / DT), :, 2] = 0.0  # Only the 2.5 s after the command to jump count.
    made.ang[round(4.5 / DT) :, :, 2] = 0.0
    made.ang[..., 2] *= torch.tensor([1.0, 1.0, 1.0, -1.0])
    found = jump(Motion(made, parts(4), 1.0), JUMP)
    assert found["turn_share"][1:].tolist() == pytest.approx([0.82, 0.78, -0.82], abs=1e-6)
    assert bool(found["turn_share"][0].isnan())
    assert found["turned"].tolist() == [1.0, 1.0, 0.0, 0.0]


def test_a_robot_is_quiet_if_it_neither_drifts_nor_chatters_from_two_seconds_after_its_landing():
    made, after = still(6.0, 5), round(4.5 / DT)
    made.pos[: after - 1, 0, 0] = made.yaw[: after - 1, 0] = 0.3  # Motion before this time does not count.
    made.pos[after - 1 :, 1, 0] = 0.03 * (times(made)[after - 1 :] - 4.5) / 1.5
    made.yaw[after + 9 :, 2] = 0.03
    swing = 0.001 * (-1.0) ** torch.arange(made.steps)  # second differences of 0.004
    made.action[:, 3] = swing.unsqueeze(1)
    fall(made, 4, 5.0)
    found = jump(Motion(made, parts(5), 1.0), JUMP)
    assert found["quiet_drift_m"][:3].tolist() == pytest.approx([0.0, 0.03, 0.0], abs=1e-4)
    assert found["quiet_yaw_rad"][2].item() == pytest.approx(0.03)
    assert found["quiet_chatter_per_s2"][3].item() == pytest.approx(0.004 / DT**2, rel=1e-4)
    assert found["quiet"].tolist() == [1.0, 0.0, 0.0, 0.0, 0.0]


def test_jumps_of_other_worlds_have_their_own_metrics():
    worlds = [("nominal", 0.0), ("nominal", 0.0), ("errors", 0.0), ("delay", 0.0167), ("delay", 0.0333)]
    names = ("drove", "turned", "jumped", "recovered", "survived", "quiet", "command_vx", "command_wz")
    columns = {"test": np.array(["jump"] * 5), **{name: np.ones(5) for name in names}, "cell": np.zeros(5)}
    columns |= {"cell_name": np.array(["vx=0"] * 5), "clearance_m": np.array([0.02, 0.04, 0.9, 0.9, 0.9])}
    columns |= {"sweep": np.array([sweep for sweep, _ in worlds]), "value": np.array([value for _, value in worlds])}
    columns["turned"][[1, 4]] = 0.0
    columns["command_vx"][:] = columns["command_wz"][:] = 0.0
    columns["quiet"][2] = 0.0
    numbers = {m.name: float(m.reduce(m.values(columns))) for m in metrics_of("jump", columns, {})}
    assert (numbers["jump/success"], numbers["jump/errors/success"]) == (0.5, 1.0)
    assert (numbers["jump/delay/0.0167/success"], numbers["jump/delay/0.0333/success"]) == (1.0, 0.0)
    assert (numbers["jump/quiet"], numbers["jump/errors/quiet"]) == (1.0, 0.0)
    assert numbers["jump/clearance"] == numbers["jump/clearance/vx=0"] == pytest.approx(0.03)


def test_hops_do_not_add_up_to_a_flight():
    made = still(6.0)
    made.pos[..., 0] = 0.3 * times(made).unsqueeze(1)
    for start, end in ((180, 192), (210, 216)):
        made.clearance[start:end] = 0.03
        made.down[start:end] = False
    found = jump(Motion(made, parts(), 1.0), JUMP)
    assert float(found["air_s"]) == pytest.approx(12 * DT)
    assert float(found["span_m"]) == pytest.approx(12 * DT * 0.3, rel=1e-3)


def test_an_impact_is_the_change_of_velocity_within_a_step():
    made = still(2.0)
    made.vel[: len(made.vel) // 2, :, 0] = 0.5  # The base stops from 0.5 m/s after a second.
    made.yaw[: len(made.vel) // 2] = math.pi / 2
    made.torque_rms[30, 0, 1] = 1.0
    found = impact(Motion(made, parts(), 1.0), 0.0)
    assert float(found["impact_m_s"]) == pytest.approx(0.5, rel=1e-3)
    assert float(found["torque_peak_share"]) == pytest.approx(0.5)


def test_a_policy_that_cannot_get_up_from_one_side_is_found():
    made = still(5.0, 60)
    half_turn, quarter = math.pi, math.pi / 2
    for number, (roll, pitch) in enumerate([(0, 0), (half_turn, 0), (0, quarter), (0, -quarter), (-quarter, 0)]):
        made.roll[0, 10 * number : 10 * number + 10], made.pitch[0, 10 * number : 10 * number + 10] = roll, pitch
    made.roll[0, 50:] = quarter
    side = resting_sides(made)["side"]
    assert side.tolist() == [number for number in range(6) for _ in range(10)]
    columns = {"test": np.array(["get_up"] * 60), "side": side.double().numpy(), "recovered": np.ones(60)}
    columns["recovered"][40:50] = 0.0
    found = {m.name: float(m.reduce(m.values(columns))) for m in metrics_of("get_up", columns, {})}
    assert found["get_up/success"] == pytest.approx(5 / 6)
    assert found["get_up/worst_success"] == 0.0
    assert found["get_up/success/left"] == 0.0
