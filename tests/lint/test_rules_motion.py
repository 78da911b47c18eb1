import math
from dataclasses import replace

import pytest

from lint.cases import FACTS, case, found, term, with_joint

POSITION, VELOCITY = "actions.JointPositionAction", "actions.JointVelocityAction"


def act(target, names, **settings):
    return {"actions": {"act": term(target, joint_names=names, **settings)}}


@pytest.mark.parametrize(
    ("action", "facts", "figures"),
    [
        # One unit takes 0.25 rad · 40 N·m/rad = 10 N·m, but the limit is 8 N·m.
        (act(POSITION, ["hip"], scale=0.25), FACTS, {"torque": 10.0}),
        # One unit is 1.1 rad, but the upper limit is 1.0 rad away. The drive is soft, so that the torque is allowed.
        (act(POSITION, ["hip"], scale=1.1), with_joint("hip", drive={"stiffness": 1.0}), {"unit": 1.1, "room": 1.0}),
        # One unit is less than a hundredth of the joint range of 2.5 rad.
        (act(POSITION, ["hip"], scale=0.02), FACTS, {"unit": 0.02, "span": 2.5}),
        (act(POSITION, ["left"], scale=0.1), FACTS, {"stiffness": 0.0}),
        (act("actions.RelativeJointPositionAction", ["left"], scale=0.1), FACTS, {"stiffness": 0.0}),
        (act(VELOCITY, ["left"], scale=21.0), FACTS, {"unit": 21.0, "limit": 20.0}),
        (act(VELOCITY, ["left"], scale=5.0), with_joint("left", drive={"damping": 0.0}), {"damping": 0.0}),
        (act(VELOCITY, ["left", "right"], scale={"left": 5.0, "right": 30.0}), FACTS, {"unit": 30.0, "limit": 20.0}),
    ],
    ids=["torque", "limit", "tiny", "no stiffness", "no stiffness, relative", "speed", "no damping", "one of two"],
)
def test_an_action_whose_unit_does_not_fit_is_found(action, facts, figures):
    (finding,) = found("action_scale", case(facts, **action))
    assert (finding.key, finding.figures) == ("env.actions.act.scale", pytest.approx(figures))
    assert found("action_scale", case(**act(POSITION, ["hip"], scale=0.19))) == []
    assert found("action_scale", case(**act(VELOCITY, ["left", "right"], scale=5.0))) == []


@pytest.mark.parametrize(
    ("action", "acts"),
    [
        (act(POSITION, ["hip"], clip={".*": [-100, 100]}), False),
        (act(POSITION, ["hip"], clip={".*": [-1.0, 1.5]}), False),
        (act(POSITION, ["hip"], clip={".*": [-0.9, 100]}), True),
        (act(VELOCITY, ["left"], clip={"left": [-20, 20]}), False),
        (act(VELOCITY, ["left"], clip={"left": [-19, 20]}), True),
        (act(POSITION, ["hip"]), True),
    ],
)
def test_a_clip_beyond_what_the_joint_reaches_never_acts(action, acts):
    assert bool(found("action_clip_never_acts", case(**action))) != acts


def command(**ranges):
    return {"commands": {"velocity": term("commands.UniformVelocityCommand", ranges=ranges)}}


@pytest.mark.parametrize(
    ("ranges", "axis", "limit"),
    [
        ({"lin_vel_x": [-0.5, 2.1]}, "lin_vel_x", 2.0),
        ({"lin_vel_x": [-1, 1], "lin_vel_y": [-0.1, 0.1]}, "lin_vel_y", 0.0),
        ({"lin_vel_x": [-1, 1], "ang_vel_z": [-9, 9]}, "ang_vel_z", 8.0),
    ],
)
def test_a_command_that_the_wheels_cannot_follow_is_found(ranges, axis, limit):
    (finding,) = found("command_reach", case(**command(**ranges)))
    assert (finding.key, finding.figures["limit"]) == (f"env.commands.velocity.ranges.{axis}", pytest.approx(limit))
    within = {"lin_vel_x": [-2, 2], "lin_vel_y": [0, 0], "ang_vel_z": [-8, 8], "heading": None}
    assert found("command_reach", case(**command(**within))) == []


@pytest.mark.parametrize(
    ("clearance", "figures"), [(-0.01, {"clearance_m": -0.01}), (0.05, {"clearance_m": 0.05, "landing_m_s": 1.0})]
)
def test_a_start_inside_or_above_the_ground_is_found(clearance, figures):
    (finding,) = found("spawn_height", case(replace(FACTS, clearance=clearance)))
    assert finding.figures == pytest.approx(figures)
    assert f"{0.4 - clearance:.4g} m" in finding.hint
    for fine in (0.0, 0.039, -5e-5):
        assert found("spawn_height", case(replace(FACTS, clearance=fine))) == []


@pytest.mark.parametrize(
    ("section", "target", "limit"),
    [
        ("terminations", "terminations.illegal_contact", 1.0),  # The limit is a tenth of the weight of 10 N.
        ("rewards", "rewards.undesired_contacts", 1.0),
        ("rewards", "rewards.no_contact_count", 2.5),  # The limit is half of the 5 N on one wheel.
    ],
)
def test_a_threshold_too_large_for_the_weight_is_found(section, target, limit):
    def contact(threshold):
        more = {"weight": -1.0} if section == "rewards" else {}
        return case(**{section: {"c": term(target, threshold=threshold, sensor_cfg={}, **more)}})

    (finding,) = found("contact_threshold", contact(limit + 0.1))
    assert finding.key == f"env.{section}.c.threshold"
    assert found("contact_threshold", contact(limit - 0.1)) == []
    steps = term("rewards.feet_air_time", weight=1.0, threshold=99.0)  # The threshold is in seconds, not in N.
    assert found("contact_threshold", case(rewards={"steps": steps})) == []


def height(target):
    return {"rewards": {"h": term("rewards.base_height_l2", weight=-1.0, target_height=target)}}


# Each row contains a rule, sections with a finding, the key, the figures, and sections without a finding.
NUMBERS = [
    ("target_height", height(0.37), "env.rewards.h.target_height", {"target_m": 0.37, "standing_m": 0.4},
     height(0.381)),
    ("episode_end", {"terminations": {"time_out": term("terminations.time_out")}}, "env.terminations", {}, {}),
    # Five time constants of the fall are 2.5 s.
    ("episode_end", {"episode_length_s": 2.4}, "env.episode_length_s", {"episode_s": 2.4}, {"episode_length_s": 2.6}),
    ("ppo_batch", {"algorithm": {"num_mini_batches": 3}}, "agent.algorithm.num_mini_batches",
     {"batch": 80, "mini_batches": 3, "unused": 2}, {}),
    # The horizon of 1000 steps exceeds the 500 steps of an episode; 333 steps do not.
    ("discount_horizon", {"algorithm": {"gamma": 0.999}}, "agent.algorithm.gamma", {"horizon_s": 20.0},
     {"algorithm": {"gamma": 0.997}}),
    # A horizon of 2 s is shorter than five time constants of the fall; 4 s are not.
    ("discount_horizon", {"algorithm": {"gamma": 0.99}}, "agent.algorithm.gamma", {"time_constant_s": 0.5}, {}),
]  # fmt: skip


@pytest.mark.parametrize(("rule", "sections", "key", "figures", "fine"), NUMBERS)
def test_a_number_beyond_a_limit_is_found(rule, sections, key, figures, fine):
    (finding,) = found(rule, case(**sections))
    assert (finding.key, {name: finding.figures[name] for name in figures}) == (key, pytest.approx(figures))
    assert found(rule, case(**fine)) == []


@pytest.mark.parametrize("target", ["root_height_below_minimum", "root_height_over_ground_below_minimum"])
@pytest.mark.parametrize(("limit", "ends"), [(0.4, True), (0.39, False)])
def test_a_height_limit_above_the_standing_height_ends_every_episode(target, limit, ends):
    node = {"low": term(f"terminations.{target}", minimum_height=limit)}
    assert bool(found("episode_end", case(terminations=node))) == ends


@pytest.mark.parametrize(("limit", "wrong"), [(0.5, True), (0.51, False), (math.pi, True), (3.0, False)])
def test_a_tilt_limit_lies_between_the_drawn_tilt_and_upside_down(limit, wrong):
    pose = {"roll": [-0.3, 0.3], "pitch": [-0.4, 0.1]}  # hypot(0.3, 0.4) = 0.5
    events = {"base": term("events.reset_root_state_uniform", mode="reset", pose_range=pose, velocity_range={})}
    node = {"tilt": term("terminations.bad_orientation", limit_angle=limit)}
    assert bool(found("episode_end", case(terminations=node, events=events))) == wrong


def push(x, y=0.0, facts=FACTS, **more):
    node = term("events.push_by_setting_velocity", mode="interval", interval_range_s=[1, 2], **more)
    node["velocity_range"] = {"x": [-x, x], "y": [-y, y]}
    return case(facts, events={"push": node})


def test_a_push_is_compared_with_the_capture_point():
    # The wheels reach 0.4 N·m / 0.02 kg·m² · 0.1 m = 2 m/s², less than the traction 0.8 · 10 m/s².
    limit = 2.0 / math.sqrt(10.0)
    (finding,) = found("push_size", push(0.8))
    assert (finding.figures["limit"], "too much" in finding.message) == (pytest.approx(limit), True)
    # A push of 1.1 times the limit is accepted, because the limit is conservative.
    assert found("push_size", push(0.7)) == []
    assert found("push_size", push(0.3, 4.0, frame="yaw")) == []  # The track width resists a sideways push.
    # A robot that has turned by 90 degrees gets this push from the front.
    (finding,) = found("push_size", push(0.3, 4.0))
    assert finding.figures["push"] == 4.0
    assert [list(advice) for advice in finding.advice] == [["env.events.push.velocity_range.y"]] * 2
    (finding,) = found("push_size", push(0.1))  # A push below a fifth of the limit does not test anything.
    assert finding.figures["ratio"] == pytest.approx(0.1 / limit)
    assert found("push_size", push(0.13)) == []
    # A push that `realism` replaces never acts.
    assert found("push_size", case(events=push(4.0).env.events, realism={"replaces": ["push"]})) == []
    # Traction limits the push that a strong drive could catch.
    strong = with_joint("left", drive={"effort": 9.0})
    strong = replace(strong, joints={**strong.joints, "right": strong.joints["left"]})
    (finding,) = found("push_size", push(4.0, facts=strong))
    assert finding.figures["limit"] == pytest.approx(8.0 / math.sqrt(10.0))  # friction 0.8


def wrench(force, torque):
    node = term("events.set_permanent_body_wrench", mode="reset", force_range=[-force, 0], torque_range=[0, torque])
    return case(events={"wrench": node})


def test_a_wrench_that_leans_the_robot_over_is_found():
    # The force tilts the robot by atan(1/10) = 5.71°, the torque by asin(0.4/4) = 5.74°.
    (finding,) = found("wrench_size", wrench(1.0, 0.4))
    assert finding.figures["force_lean_rad"] == pytest.approx(math.atan(0.1))
    assert finding.figures["torque_lean_rad"] == pytest.approx(math.asin(0.1))
    assert found("wrench_size", wrench(1.0, 0.2)) == []


def test_a_mean_of_weights_that_reaches_back_to_the_beginning_is_found():
    (finding,) = found("late_average", case(average_iterations=10))  # The share is 0.9 to the power of 20 - 10.
    assert finding.figures == {"early_share": pytest.approx(0.34867844)}
    (finding,) = found("late_average", case(average_iterations=80))
    assert finding.message == "100 % of the mean is from iterations 1 to 20 of 20"
    assert found("late_average", case(average_iterations=8)) == []  # The share is 0.875 to the power of 12, 0.20.
    assert found("late_average", case(average_iterations=1)) == found("late_average", case()) == []
    further = case(average_iterations=10)
    assert found("late_average", replace(further, config=replace(further.config, init_from="latest"))) == []


TILES = {
    "_target_": "wheelleg_exp.sim.terrain.TerrainGenerator", "size": [2.0, 2.0], "num_rows": 1, "num_cols": 1,
    "border_width": 1.0, "horizontal_scale": 0.02, "vertical_scale": 0.0001, "curriculum": False,
    "difficulty_range": [1.0, 1.0], "static_friction": 0.6, "dynamic_friction": 0.4, "restitution": 0.0,
}  # fmt: skip


@pytest.mark.parametrize("inverted", [True, False])
@pytest.mark.parametrize(
    ("section", "node"),
    [
        ("terminations", term("terminations.root_height_below_minimum", minimum_height=0.1)),
        ("rewards", term("rewards.base_height_l2", target_height=0.3, weight=-1.0)),
    ],
)
def test_a_height_in_the_world_is_found_on_tiles_with_pits(section, node, inverted):
    """The ground falls at 0.3 rad from the edge of the tile to a platform of 0.4 m: 0.8 m times tan(0.3)."""
    slope = {"proportion": 1.0, "slope_range": [0.3, 0.3], "platform_width": 0.4, "inverted": inverted}
    tiles = {"slope": {"_target_": "wheelleg_exp.sim.terrain.PyramidSlope", **slope}}
    findings = found(
        "world_height", case(scene={"terrain": {**TILES, "sub_terrains": tiles}}, **{section: {"x": node}})
    )
    assert [finding.key for finding in findings] == [f"env.{section}.x"] * inverted
    assert [finding.figures["depth_m"] for finding in findings] == [
        pytest.approx(0.8 * math.tan(0.3), abs=0.01)
    ] * inverted
    assert found("world_height", case(**{section: {"x": node}})) == []
