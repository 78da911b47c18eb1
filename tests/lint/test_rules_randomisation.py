import math

import pytest

from lint.cases import case, found, joints, term, with_joint

SCALE = "events.reset_joints_by_scale"


def reset(position, velocity, **more):
    node = term(SCALE, mode="reset", position_range=position, velocity_range=velocity, **more)
    return {"events": {"joints": node}}


@pytest.mark.parametrize(
    ("position", "velocity", "key", "parts"),
    [
        ([1.0, 1.0], [-0.2, 0.2], "velocity_range", ("U(-0.2, 0.2)", "every joint")),
        # Only the two wheels have a default of 0; the hip's default is 0.5 rad.
        ([0.5, 1.5], [0.0, 0.0], "position_range", ("left, right",)),
    ],
)
def test_scaling_a_default_of_zero_is_not_a_randomisation(position, velocity, key, parts):
    (finding,) = found("noop_joint_reset", case(**reset(position, velocity)))
    assert finding.key == f"env.events.joints.{key}"
    assert key == "velocity_range" or finding.figures["joints"] == 2
    assert [part for part in parts if part not in finding.message] == []


def test_a_scaled_default_that_is_not_zero_is_randomised():
    spinning = with_joint("hip", default_velocity=1.0)
    node = reset([0.5, 1.5], [0.5, 1.5], asset_cfg=joints("hip"))
    assert found("noop_joint_reset", case(spinning, **node)) == []
    node = term("events.reset_joints_by_offset", mode="reset", position_range=[-1, 1], velocity_range=[-1, 1])
    assert found("noop_joint_reset", case(events={"joints": node})) == []


def test_a_range_without_width_and_a_command_that_never_changes_are_found():
    events = {
        "joints": reset([1.0, 1.0], [-0.2, 0.2])["events"]["joints"],
        "push": term("events.push_by_adding_velocity", mode="interval", velocity_range={"x": [0.1, 0.1]}),
        "mass": term("events.randomize_rigid_body_mass", mode="startup", mass_distribution_params=[0.1, 0.1]),
    }
    keys = ["joints.position_range", "push.velocity_range", "mass.mass_distribution_params"]
    assert [f.key for f in found("zero_width_range", case(events=events))] == [f"env.events.{key}" for key in keys]
    still = term("commands.UniformVelocityCommand", ranges={"lin_vel_x": [0, 0], "heading": None})
    keys = [finding.key for finding in found("zero_width_range", case(commands={"velocity": still}))]
    assert keys == ["env.commands.velocity.ranges"]


def test_one_axis_with_a_width_and_a_fixed_period_are_fine():
    ranges, pose = {"lin_vel_x": [-1, 1], "lin_vel_y": [0, 0]}, {"x": [0, 0], "y": [0, 1]}
    moving = term("commands.UniformVelocityCommand", ranges=ranges, resampling_time_range=[2.5, 2.5])
    node = term("events.reset_root_state_uniform", mode="reset", pose_range=pose, velocity_range={})
    assert found("zero_width_range", case(commands={"velocity": moving}, events={"base": node})) == []


def push(low, **more):
    settings = {"mode": "interval", "interval_range_s": [low, 20.0], "velocity_range": {}, **more}
    return case(events={"push": term("events.push_by_adding_velocity", **settings)})


def test_an_interval_as_long_as_an_episode_never_fires():
    (finding,) = found("event_never_fires", push(10.0))
    assert finding.figures == {"shortest_s": 10.0, "episode_s": 10.0}
    assert found("event_never_fires", push(9.9)) == found("event_never_fires", push(10.0, is_global_time=True)) == []


def shift(mode, target="events.randomize_rigid_body_com"):
    return case(events={"com": term(target, mode=mode, com_range={"x": [-0.003, 0.001]})})


def test_a_centre_of_mass_that_walks_away_is_found_under_either_name():
    # After 100 draws of ±3 mm the variance is 100 · 3²/3 = 300 mm².
    (finding,) = found("cumulative_randomisation", shift("reset"))
    assert finding.figures["spread_after_100_m"] == pytest.approx(math.sqrt(300) / 1e3)
    assert found("cumulative_randomisation", shift("interval", "events.randomize_rigid_body_com_cumulative"))
    assert found("cumulative_randomisation", shift("startup")) == []


def material(restitution):
    ranges = {"static_friction_range": [0.5, 1.0], "dynamic_friction_range": [0.5, 1.0]}
    node = term("events.randomize_rigid_body_material", mode="startup", restitution_range=restitution, **ranges)
    return case(events={"material": node})


def test_drawn_restitution_has_no_effect():
    (finding,) = found("noop_restitution", material([0.0, 0.05]))
    assert finding.figures == {"low": 0.0, "high": 0.05}
    assert found("noop_restitution", material([0.0, 0.0])) == []
