from dataclasses import replace

import numpy as np
import pytest

from lint.cases import FACTS, case, found, term, with_joint

# Each row contains a rule, a joint, changes with a finding, the key, the figures, and changes without a finding.
DRIVES = [
    ("armature_ratio", "hip", {"armature": 0.5}, "legs.armature", {"ratio": 0.5 / 0.04}, {"armature": 0.4}),
    ("armature_ratio", "left", {"armature": 0.8}, "wheels.armature",
     {"pitch_ratio": 0.8 / 0.4, "translation_kg": 0.8 / 0.1**2}, {"armature": 0.01}),
    ("effort_against_traction", "left", {"effort": 4.4}, "wheels.effort_limit",
     {"slip": 0.8 * 5 * 0.1, "ratio": 11.0}, {"effort": 3.9}),
    ("effort_against_load", "hip", {"effort": 2.9}, "legs.effort_limit", {"load": 2.0}, {"effort": 3.1}),
    ("effort_against_load", "hip", {"stiffness": 16.0}, "legs.stiffness", {"sag_rad": 0.125}, {"stiffness": 21.0}),
    # The drive's rate is sqrt(0.3 / 0.1) = 1.73 rad/s, below the fall's 2; its damping ratio is 2 / (2 sqrt(0.3 ·
    # 0.1)).
    ("drive_bandwidth", "hip", {"stiffness": 0.3}, "legs.stiffness",
     {"bandwidth": np.sqrt(3.0), "damping_ratio": 1 / np.sqrt(0.03)}, {"stiffness": 0.5}),
    # A wheel needs twice the rate of the fall, 4 rad/s, but kd / I is 0.07 / 0.02 = 3.5 rad/s.
    ("drive_bandwidth", "left", {"damping": 0.07}, "wheels.damping", {"bandwidth": 3.5}, {"damping": 0.09}),
]  # fmt: skip


def changed(joint, change):
    return with_joint(joint, **(change if "armature" in change else {"drive": change}))


@pytest.mark.parametrize(("rule", "joint", "change", "key", "figures", "fine"), DRIVES)
def test_a_drive_beyond_a_limit_is_found(rule, joint, change, key, figures, fine):
    (finding,) = found(rule, case(changed(joint, change)))
    assert finding.key == f"env.robot.actuators.{key}"
    assert {name: finding.figures[name] for name in figures} == pytest.approx(figures)
    assert found(rule, case(changed(joint, fine))) == []


def test_the_bandwidth_of_a_drive_with_negative_stiffness_is_that_of_its_damping():
    # kd / I is 2 / 0.1 = 20 rad/s, above the fall's 2 rad/s, or a hundredth of it.
    assert found("drive_bandwidth", case(with_joint("hip", drive={"stiffness": -1.0}))) == []
    slow = case(with_joint("hip", drive={"stiffness": -1.0, "damping": 0.02}))
    assert found("drive_bandwidth", slow)[0].figures["bandwidth"] == pytest.approx(0.2)


def test_a_leg_drive_is_not_compared_with_traction():
    assert found("effort_against_traction", case(with_joint("hip", drive={"effort": 100.0}))) == []


@pytest.mark.parametrize(("source", "friction"), [("static", 0.9), ("dynamic", 0.7)])
def test_traction_counts_the_largest_friction_that_events_draw(source, friction):
    # The friction is (1.2 + 0.6) / 2 = 0.9 or (1.0 + 0.4) / 2 = 0.7, instead of the model's 0.8.
    ranges = {"static_friction_range": [0.6, 1.2], "dynamic_friction_range": [0.5, 1.0], "restitution_range": [0, 0]}
    node = term("events.randomize_rigid_body_material", mode="startup", **ranges)
    looked_at = case(with_joint("left", drive={"effort": 9.0}), events={"m": node}, robot={"friction_source": source})
    assert found("effort_against_traction", looked_at)[0].figures["friction"] == pytest.approx(friction)


def grows(kp, kd, inertia, dt, implicit):
    """Return whether the motion of a drive on a free inertia grows, by simulating the integrator."""
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
    assert bool(findings) == (expected or (not explicit and a > 2.0))  # contacts come and go before the drive grows
    if findings:
        assert (findings[0].figures["a"], findings[0].figures["b"]) == (pytest.approx(a), pytest.approx(b))


def test_an_integrator_that_is_not_implicit_makes_every_drive_explicit():
    stiff = with_joint("hip", drive={"damping": 20.0})  # kd·dt/I = 2: an explicit drive needs less
    assert found("gains_against_time_step", case(stiff)) == []
    (finding,) = found("gains_against_time_step", case(stiff, sim={"integrator": "euler"}))
    assert finding.key == "env.robot.actuators.legs.damping"


def test_too_few_control_steps_in_a_fall_are_found():
    # At a pole of 2 rad/s the time constant is 0.5 s, exactly five steps of 0.1 s.
    (finding,) = found("control_rate", case(decimation=11))
    assert finding.figures["samples"] == pytest.approx(0.5 / 0.11)
    assert found("control_rate", case(decimation=9)) == []
    assert found("control_rate", case(replace(FACTS, balance=None), decimation=100)) == []


def test_a_leg_whose_targets_make_up_for_its_sag_is_fine():
    soft = with_joint("hip", drive={"stiffness": 10.0})  # A torque of 2.0 N·m at 0.5 rad needs a target of 0.7 rad.
    sagging = {"legs": term("actions.JointPositionAction", joint_names=["hip"], use_default_offset=True)}
    assert len(found("effort_against_load", case(soft, actions=sagging))) == 1
    for offset, findings in ((0.7, 0), (0.5, 1), ({"hip": 0.72}, 0)):
        node = term("actions.JointPositionAction", joint_names=["hip"], use_default_offset=False, offset=offset)
        assert len(found("effort_against_load", case(soft, actions={"legs": node}))) == findings, offset
