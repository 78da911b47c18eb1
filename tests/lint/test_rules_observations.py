"""What the networks see: bounds, sizes and noise."""

from __future__ import annotations

from dataclasses import replace

import pytest

from lint.cases import FACTS, case, found, joints, term, with_joint


def policy(corrupt=False, **terms):
    return {"observations": {"policy": {"terms": terms, "enable_corruption": corrupt}}}


@pytest.mark.parametrize("target", ["observations.joint_pos_rel", "observations.joint_pos"])
def test_the_angle_of_a_wheel_has_no_bound(target):
    # 20 rad/s for 10 s
    (finding,) = found("unbounded_observation", case(**policy(angles=term(target))))
    assert finding.key == "env.observations.policy.terms.angles"
    assert finding.figures["largest_rad"] == 200.0
    assert "left, right" in finding.message


@pytest.mark.parametrize(
    "node",
    [
        term("observations.joint_pos_rel", asset_cfg=joints("hip")),
        term("observations.joint_pos_rel", clip=[-3.0, 3.0]),
        term("observations.joint_pos_sin_cos"),
        term("observations.joint_vel_rel"),
    ],
    ids=["legs only", "clipped", "sine and cosine", "a speed"],
)
def test_what_is_bounded_is_fine(node):
    assert found("unbounded_observation", case(**policy(angles=node))) == []


SIZES = {  # largest value: from the facts of the round robot
    "observations.joint_vel": 20.0,  # the wheels' speed limit
    "observations.joint_effort": 8.0,  # the hip's effort limit
    "observations.base_lin_vel": 2.0,  # 20 rad/s · 0.1 m
    "observations.base_ang_vel": 2.0,  # the pole, through one radian
    "observations.joint_pos_rel": 1.5,  # from 0.5 down to -1.0
    "observations.projected_gravity": 1.0,
    "observations.last_action": 1.0,
}


@pytest.mark.parametrize("target", SIZES)
def test_a_scale_that_blows_up_or_buries_a_signal_is_found(target):
    size = SIZES[target]
    for scale in (11.0 / size, 0.009 / size):
        (finding,) = found("observation_scale", case(**policy(x=term(target, scale=scale))))
        assert finding.figures["largest"] == pytest.approx(size)
        assert finding.figures["seen"] == pytest.approx(size * scale)
    for scale in (9.0 / size, 0.011 / size):
        assert found("observation_scale", case(**policy(x=term(target, scale=scale)))) == []


def test_a_command_is_as_large_as_its_range():
    velocity = term("commands.UniformVelocityCommand", ranges={"lin_vel_x": [-0.3, 0.2], "ang_vel_z": [-0.5, 0.5]})
    node = term("observations.generated_commands", command_name="velocity", scale=100.0)
    (finding,) = found("observation_scale", case(commands={"velocity": velocity}, **policy(x=node)))
    assert finding.figures["largest"] == 0.5


def test_a_network_that_normalises_its_input_takes_any_scale():
    looked_at = policy(x=term("observations.joint_vel", scale=100.0))
    both = {"actor": {"obs_normalization": True}, "critic": {"obs_normalization": True}}
    assert found("observation_scale", case(**looked_at, **both)) == []
    assert found("observation_scale", case(**looked_at, actor=both["actor"]))


def test_nothing_is_said_of_a_size_that_is_not_known():
    looked_at = policy(x=term("observations.base_ang_vel", scale=1e6), y=term("observations.base_pos_z", scale=1e6))
    assert found("observation_scale", case(replace(FACTS, balance=None), **looked_at)) == []


NOISE = {"_target_": "wheelleg_exp.mdp.noise.UniformNoise", "n_min": -1.0, "n_max": 0.2}


def test_noise_in_a_group_without_corruption_never_acts():
    (finding,) = found("noise_against_signal", case(**policy(v=term("observations.joint_vel", noise=NOISE))))
    assert finding.key == "env.observations.policy.terms.v.noise"
    assert "env.observations.policy.enable_corruption=true" in finding.hint


def test_a_clean_group_without_noise_is_fine():
    assert found("noise_against_signal", case(**policy(v=term("observations.joint_vel")))) == []


def test_corruption_without_any_noise_corrupts_nothing():
    (finding,) = found("noise_against_signal", case(**policy(True, v=term("observations.joint_vel"))))
    assert finding.key == "env.observations.policy.enable_corruption"


@pytest.mark.parametrize(
    ("noise", "ratio"),
    [
        (NOISE, 0.5),  # half-width 1 on a speed of 2
        ({"_target_": "wheelleg_exp.mdp.noise.GaussianNoise", "std": 1.2}, 0.6),
    ],
)
def test_noise_of_half_the_signal_is_found(noise, ratio):
    (finding,) = found("noise_against_signal", case(**policy(True, v=term("observations.base_lin_vel", noise=noise))))
    assert finding.figures["ratio"] == pytest.approx(ratio)


def test_noise_well_below_the_signal_is_fine():
    looked_at = policy(True, v=term("observations.base_lin_vel", noise={**NOISE, "n_min": -0.9}))
    assert found("noise_against_signal", case(**looked_at)) == []


def test_a_faster_drive_turns_the_wheel_further():
    fast = with_joint("left", drive={"velocity": 30.0})
    (finding,) = found("unbounded_observation", case(fast, **policy(a=term("observations.joint_pos"))))
    assert finding.figures["largest_rad"] == 300.0
