from dataclasses import replace

import pytest

from lint.cases import FACTS, case, found, joints, term, with_joint


def policy(corrupt=False, **terms):
    return {"observations": {"policy": {"terms": terms, "enable_corruption": corrupt}}}


@pytest.mark.parametrize("target", ["observations.joint_pos_rel", "observations.joint_pos"])
@pytest.mark.parametrize("speed", [20.0, 30.0])
def test_the_angle_of_a_wheel_has_no_bound(target, speed):
    facts = with_joint("left", drive={"velocity": speed})
    (finding,) = found("unbounded_observation", case(facts, **policy(angles=term(target))))
    assert finding.key == "env.observations.policy.terms.angles"
    assert finding.figures["largest_rad"] == 10.0 * speed  # The wheel turns at its top speed for an episode of 10 s.
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


SIZES = {  # The largest value of each observation, computed from the facts of the round robot.
    "observations.joint_vel": 20.0,  # the wheels' speed limit
    "observations.joint_effort": 8.0,  # the hip's effort limit
    "observations.base_lin_vel": 2.0,
    "observations.base_ang_vel": 2.0,  # A fall through one radian at the rate of the pole.
    "observations.joint_pos_rel": 1.5,  # The default is 0.5 rad and the lower limit is -1.0 rad.
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


def test_an_observation_that_its_neighbours_drown_is_found():
    """Alone, 8 N·m at a scale of 0.02 are fine. Next to 20 and 20 rad/s, they are 0.8 % of the median."""
    neighbours = {name: term("observations.joint_vel") for name in ("a", "b")}
    effort = term("observations.joint_effort", scale=0.02)
    (finding,) = [f for f in found("observation_scale", case(**policy(x=effort, **neighbours))) if f.key.endswith(".x")]
    assert "reach the network as 0.16, the group's other terms as 20" in finding.message
    assert found("observation_scale", case(**policy(x=effort))) == []
    louder = {**effort, "scale": 0.03}
    assert not [f for f in found("observation_scale", case(**policy(x=louder, **neighbours))) if f.key.endswith(".x")]


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


def test_an_observation_of_unknown_size_has_no_finding():
    looked_at = policy(x=term("observations.base_ang_vel", scale=1e6), y=term("observations.base_pos_z", scale=1e6))
    assert found("observation_scale", case(replace(FACTS, balance=None), **looked_at)) == []


NOISE = {"_target_": "wheelleg_exp.mdp.noise.UniformNoise", "n_min": -1.0, "n_max": 0.2}


@pytest.mark.parametrize(
    ("corrupt", "noise", "key"),
    [(False, NOISE, "terms.v.noise"), (True, None, "enable_corruption"), (False, None, None)],
)
def test_noise_and_corruption_need_each_other(corrupt, noise, key):
    settings = {} if noise is None else {"noise": noise}
    findings = found("noise_against_signal", case(**policy(corrupt, v=term("observations.joint_vel", **settings))))
    assert [f.key for f in findings] == ([f"env.observations.policy.{key}"] if key else [])


@pytest.mark.parametrize(
    ("noise", "ratio"),
    [
        (NOISE, 0.5),  # The noise has a half-width of 1 m/s, the speed is at most 2 m/s.
        ({"_target_": "wheelleg_exp.mdp.noise.GaussianNoise", "std": 1.2}, 0.6),
    ],
)
def test_noise_of_half_the_signal_is_found(noise, ratio):
    (finding,) = found("noise_against_signal", case(**policy(True, v=term("observations.base_lin_vel", noise=noise))))
    assert finding.figures["ratio"] == pytest.approx(ratio)
    quiet = policy(True, v=term("observations.base_lin_vel", noise={**NOISE, "n_min": -0.9}))
    assert found("noise_against_signal", case(**quiet)) == []
