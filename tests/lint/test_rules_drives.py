"""Drives: armature, effort, gains against the time step, and speed against the fall."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from lint.cases import FACTS, case, found, term, with_joint


def test_an_armature_of_more_than_ten_links_is_found():
    (finding,) = found("armature_ratio", case(with_joint("hip", armature=0.5)))
    assert finding.key == "env.robot.actuators.legs.armature"
    assert finding.figures["ratio"] == pytest.approx(12.5)  # 0.5 / 0.04


def test_the_armature_of_a_wheel_is_told_as_pitch_inertia_and_as_mass():
    (finding,) = found("armature_ratio", case(with_joint("left", armature=0.8)))
    assert finding.figures["pitch_ratio"] == pytest.approx(2.0)  # 0.8 / 0.4
    assert finding.figures["translation_kg"] == pytest.approx(80.0)  # 0.8 / 0.1²


def test_an_armature_of_ten_links_is_fine():
    assert found("armature_ratio", case(with_joint("hip", armature=0.4))) == []


def test_a_wheel_drive_of_more_than_ten_times_the_traction_is_found():
    # 0.8 · 5 N · 0.1 m = 0.4 N·m
    (finding,) = found("effort_against_traction", case(with_joint("left", drive={"effort": 4.4})))
    assert finding.figures["slip"] == pytest.approx(0.4)
    assert finding.figures["ratio"] == pytest.approx(11.0)
    assert found("effort_against_traction", case(with_joint("left", drive={"effort": 3.9}))) == []


@pytest.mark.parametrize(("source", "friction"), [("static", 0.9), ("dynamic", 0.7)])
def test_traction_counts_the_largest_friction_that_events_draw(source, friction):
    # (1.2 + 0.6) / 2 = 0.9; (1.0 + 0.4) / 2 = 0.7, in place of the model's 0.8
    ranges = {"static_friction_range": [0.6, 1.2], "dynamic_friction_range": [0.5, 1.0], "restitution_range": [0, 0]}
    node = term("events.randomize_rigid_body_material", mode="startup", **ranges)
    looked_at = case(with_joint("left", drive={"effort": 9.0}), events={"m": node}, robot={"friction_source": source})
    assert found("effort_against_traction", looked_at)[0].figures["friction"] == pytest.approx(friction)


def test_a_leg_drive_is_not_held_against_traction():
    assert found("effort_against_traction", case(with_joint("hip", drive={"effort": 100.0}))) == []


def test_a_leg_without_a_reserve_is_found():
    (finding,) = found("effort_against_load", case(with_joint("hip", drive={"effort": 2.9})))  # holds 2.0
    assert finding.key == "env.robot.actuators.legs.effort_limit"
    assert found("effort_against_load", case(with_joint("hip", drive={"effort": 3.1}))) == []


def test_a_leg_that_sags_is_found():
    (finding,) = found("effort_against_load", case(with_joint("hip", drive={"stiffness": 16.0})))
    assert finding.key == "env.robot.actuators.legs.stiffness"
    assert finding.figures["sag_rad"] == pytest.approx(0.125)
    assert found("effort_against_load", case(with_joint("hip", drive={"stiffness": 21.0}))) == []


def grows(kp, kd, inertia, dt, implicit):
    """Whether a drive on a free inertia grows, by stepping it as the integrator does."""
    x, v = 1.0, 0.0
    for _ in range(4000):
        v = (v - dt * kp / inertia * x) / (1 + dt * kd / inertia) if implicit else v - dt * (kp * x + kd * v) / inertia
        x += dt * v
        if abs(x) > 1e6:
            return True
    return abs(x) > 100.0


@pytest.mark.parametrize("explicit", [True, False])
@pytest.mark.parametrize("kd", [0.0, 5.0, 12.0, 19.0, 21.0, 100.0])
@pytest.mark.parametrize("kp", [1.0, 500.0, 2000.0, 3900.0, 4100.0, 9000.0])
def test_gains_are_found_where_a_simulated_drive_grows(kp, kd, explicit):
    # I = 0.1 kg·m², dt = 0.01 s: kd·dt/I = kd / 10, kp·dt²/I = kp / 1000
    facts = with_joint("hip", drive={"stiffness": kp, "damping": kd, "explicit": explicit})
    a, b = kd / 10, kp / 1000
    limit = 4 - 2 * a if explicit else 4 + 2 * a
    expected = (a >= 2 or b >= limit) if explicit else b >= limit
    assert grows(kp, kd, 0.1, 0.01, implicit=not explicit) == expected
    findings = found("gains_against_time_step", case(facts))
    assert bool(findings) == expected
    if findings:
        assert findings[0].figures["a"] == pytest.approx(a)
        assert findings[0].figures["b"] == pytest.approx(b)


def test_an_integrator_that_is_not_implicit_makes_every_drive_explicit():
    stiff = with_joint("hip", drive={"damping": 25.0})  # kd·dt/I = 2.5
    assert found("gains_against_time_step", case(stiff)) == []
    (finding,) = found("gains_against_time_step", case(stiff, sim={"integrator": "euler"}))
    assert finding.key == "env.robot.actuators.legs.damping"


def test_too_few_control_steps_in_a_fall_are_found():
    # a pole of 2 rad/s: 0.5 s; five steps of 0.1 s fit exactly
    (finding,) = found("control_rate", case(decimation=11))
    assert finding.figures["samples"] == pytest.approx(0.5 / 0.11)
    assert found("control_rate", case(decimation=9)) == []
    assert found("control_rate", case(replace(FACTS, balance=None), decimation=100)) == []


def test_a_leg_slower_than_the_fall_is_found():
    # sqrt(0.3 / 0.1) = 1.73 rad/s against a pole of 2; damping ratio 2 / (2 sqrt(0.3 · 0.1)) = 5.77
    (finding,) = found("drive_bandwidth", case(with_joint("hip", drive={"stiffness": 0.3})))
    assert finding.figures["bandwidth"] == pytest.approx(np.sqrt(3.0))
    assert finding.figures["damping_ratio"] == pytest.approx(1 / np.sqrt(0.03))
    assert found("drive_bandwidth", case(with_joint("hip", drive={"stiffness": 0.5}))) == []  # 2.24


def test_a_wheel_needs_twice_the_rate_of_the_fall():
    # kd / I = 0.07 / 0.02 = 3.5 rad/s, against 4
    (finding,) = found("drive_bandwidth", case(with_joint("left", drive={"damping": 0.07})))
    assert finding.key == "env.robot.actuators.wheels.damping"
    assert finding.figures["bandwidth"] == pytest.approx(3.5)
    assert found("drive_bandwidth", case(with_joint("left", drive={"damping": 0.09}))) == []


def test_a_leg_whose_targets_make_up_for_its_sag_is_fine():
    soft = with_joint("hip", drive={"stiffness": 10.0})  # holds 2.0 at 0.5 rad: wants a target of 0.7
    sagging = {"legs": term("actions.JointPositionAction", joint_names=["hip"], use_default_offset=True)}
    assert len(found("effort_against_load", case(soft, actions=sagging))) == 1
    for offset, findings in ((0.7, 0), (0.5, 1), ({"hip": 0.72}, 0)):
        node = term("actions.JointPositionAction", joint_names=["hip"], use_default_offset=False, offset=offset)
        assert len(found("effort_against_load", case(soft, actions={"legs": node}))) == findings, offset
