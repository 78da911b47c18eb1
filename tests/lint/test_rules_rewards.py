import math
from dataclasses import replace

import numpy as np
import pytest

from lint.cases import case, found, joints, term
from wheelleg_exp.lint.reward_tolerances import contributions
from wheelleg_exp.lint.rules_learning import still_score

TRACK = "rewards.track_lin_vel_xy_exp"


def command(x=0.0, yaw=0.0, standing=0.0):
    ranges = {"lin_vel_x": [-x, x], "lin_vel_y": [0.0, 0.0], "ang_vel_z": [-yaw, yaw]}
    return {"velocity": term("commands.UniformVelocityCommand", ranges=ranges, rel_standing_envs=standing)}


def track(std, target=TRACK, weight=1.0):
    return {"track": term(target, weight=weight, std=std, command_name="velocity")}


@pytest.mark.parametrize(("speed", "std"), [(0.3, 0.5), (0.3, 0.1), (0.6, 0.25), (0.5, 0.15)])
def test_what_standing_still_earns_is_the_mean_over_commands(speed, std):
    commands = np.linspace(-speed, speed, 200_001)
    assert still_score(speed, std) == pytest.approx(float(np.exp(-((commands / std) ** 2)).mean()), abs=1e-4)


def test_a_std_as_wide_as_the_speed_or_yaw_commands_is_found():
    # The share is sqrt(pi)/2 · erf(0.6) · 5/3 = 0.8919. With 40 % zero commands it is 0.8919 + 0.4 · 0.1081 = 0.935.
    (finding,) = found("tracking_std", case(commands=command(0.3, standing=0.4), rewards=track(0.5)))
    assert finding.figures["still"] == pytest.approx(0.8919, abs=1e-4)
    assert "0.89" in finding.message
    assert "0.94" in finding.message
    assert found("tracking_std", case(commands=command(0.3), rewards=track(0.15))) == []  # 0.44
    yaw = track(0.5, "rewards.track_ang_vel_z_exp")
    (finding,) = found("tracking_std", case(commands=command(0.01, yaw=0.5), rewards=yaw))
    assert finding.figures["still"] == pytest.approx(0.7468, abs=1e-4)


def wheels(scale):
    node = term("actions.JointVelocityAction", joint_names=["left", "right"], scale=scale)
    return {"commands": command(), "actions": {"wheels": node}}


def test_a_std_with_which_a_drift_earns_the_reward_is_found_if_nothing_is_commanded():
    # One unit of action is 5 rad/s · 0.1 m = 0.5 m/s, so the share is exp(-(0.5/1)²) = 0.7788.
    (finding,) = found("tracking_std", case(**wheels(5.0), rewards=track(1.0, weight=0.0)))
    assert finding.figures["drift"] == pytest.approx(0.5)
    assert finding.figures["drifting"] == pytest.approx(math.exp(-0.25))
    assert "its weight is 0" in finding.message
    assert found("tracking_std", case(**wheels(5.0), rewards=track(0.4))) == []  # exp(-1.5625) = 0.21
    # One unit of opposite actions turns the robot at 2 · 0.5 m/s over a track of 0.5 m, which is 2 rad/s.
    assert found("tracking_std", case(**wheels(5.0), rewards=track(2.0, "rewards.track_ang_vel_z_exp"))) == []
    assert found("tracking_std", case(**wheels(5.0), rewards=track(2.5, "rewards.track_ang_vel_z_exp")))


ALIVE = {"alive": term("rewards.is_alive", weight=5.0)}


def height(weight):
    return {**ALIVE, "height": term("rewards.base_height_l2", weight=weight, target_height=0.4)}


def test_a_term_that_costs_less_than_a_hundredth_is_found():
    # A height error of 0.04 m costs 0.0016 · 20 = 0.032 per second, 0.64 % of the reward of 5 per second.
    (finding,) = found("reward_too_small", case(rewards=height(-20.0)))
    assert (finding.key, finding.figures["share"]) == ("env.rewards.height.weight", pytest.approx(0.0064))
    assert "-32" in finding.hint  # 5 · 0.01 / 0.0016 = 31.25
    assert found("reward_too_small", case(rewards=height(-32.0))) == []


def test_failures_and_unknown_terms_are_not_too_small():
    fall, unknown = term("rewards.is_terminated", weight=-0.001), term("rewards.joint_acc_l2", weight=-1e-9)
    assert found("reward_too_small", case(rewards={**ALIVE, "fall": fall, "x": unknown})) == []


def test_a_cost_that_random_actions_make_larger_than_all_that_is_earned():
    rewards = {**height(-8.0), "fall": term("rewards.is_terminated", weight=-200.0)}

    def tried(cost):
        return replace(case(rewards=rewards), trial={"alive": 5.0, "height": -cost, "fall": -1000.0})

    assert found("reward_outweighs", tried(20.0)) == []
    (finding,) = found("reward_outweighs", tried(40.0))
    assert (finding.key, finding.figures) == ("env.rewards.height.weight", {"cost_per_s": 40.0, "earned_per_s": 5.0})
    assert "a weight near -4," in finding.hint
    assert found("reward_outweighs", case(rewards=rewards)) == []  # This case has no trial.


# The tolerances are 0.1 rad, 0.04 m, a tenth of sqrt(10 · 0.4) = 2 m/s, and a tenth of sqrt(10/0.4) = 5 rad/s.
VALUES = {
    "rewards.base_height_l2": ({"target_height": 0.4}, 0.04**2),
    "rewards.lin_vel_z_l2": ({}, 0.2**2),
    "rewards.ang_vel_xy_l2": ({}, 0.5**2),
    "rewards.pitch_orientation_l2": ({}, math.sin(0.1) ** 2),
    "rewards.flat_orientation_l2": ({}, math.sin(0.1) ** 2),
    "rewards.joint_deviation_l1": ({"asset_cfg": joints("hip", "left")}, 0.2),
    "rewards.joint_symmetry_l1": ({"left_cfg": joints("left"), "right_cfg": joints("right")}, 0.1),
    "rewards.joint_torques_l2": ({}, 0.8**2 + 2 * 0.04**2),
    "rewards.no_contact_count": ({"threshold": 1.0, "sensor_cfg": {}}, 1.0),
    "rewards.is_alive": ({}, 1.0),
}


@pytest.mark.parametrize(
    ("target", "settings"),
    [
        ("rewards.base_height_exp", {"target_height": 0.4, "std": 0.02}),  # The tolerance is 40 mm, twice the std.
        # The tolerance is 0.1 rad, whose sine is twice the std.
        ("rewards.flat_orientation_exp", {"std": math.sin(0.1) / 2}),
    ],
)
def test_a_kernel_costs_what_it_loses_at_the_tolerance(target, settings):
    looked_at = case(rewards={"x": term(target, weight=3.0, **settings)})
    (item,) = contributions(looked_at)
    assert (item.per_episode(looked_at), item.best) == (pytest.approx(3.0 * math.exp(-4.0) * 10.0), 1.0)
    narrow = case(rewards={"x": term(target, weight=3.0, **{**settings, "std": 1e-200})})
    assert contributions(narrow)[0].value == 0.0


@pytest.mark.parametrize("target", VALUES)
def test_what_a_reward_adds_in_an_episode_at_its_tolerance(target):
    settings, value = VALUES[target]
    looked_at = case(rewards={"x": term(target, weight=-2.0, **settings)})
    (item,) = contributions(looked_at)
    # A control step is 0.02 s, so an episode of 10 s has 500 steps.
    assert item.per_step(looked_at.step_dt) == pytest.approx(-2.0 * value * 0.02)
    assert item.per_episode(looked_at) == pytest.approx(-2.0 * value * 10.0)


def test_a_failure_counts_once_and_an_action_rate_half_a_unit_on_each_action():
    failing = case(rewards={"fall": term("rewards.is_terminated", weight=-200.0)})
    assert contributions(failing)[0].per_episode(failing) == pytest.approx(-200.0 * 0.02)
    shaking = case(**wheels(1.0), rewards={"rate": term("rewards.action_rate_l2", weight=-1.0)})
    assert contributions(shaking)[0].per_episode(shaking) == pytest.approx(-2 * 0.25 * 10.0)


def living(alive, fall):
    rewards = {
        "alive": term("rewards.is_alive", weight=alive),
        "tilt": term("rewards.joint_deviation_l1", weight=-10.0, asset_cfg=joints("hip")),
        "fall": term("rewards.is_terminated", weight=fall),
    }
    return case(rewards=rewards)


def test_falling_at_once_pays_where_going_on_costs_more():
    # A second costs 10 · 0.1 - 0.5 = 0.5. The horizon of 200 steps costs 100 in the unit of the failure's weight.
    (finding,) = found("falling_pays", living(0.5, -99.0))
    assert finding.figures == {"living_per_s": -0.5, "failing": -99.0, "steps": pytest.approx(200.0)}
    assert found("falling_pays", living(0.5, -101.0)) == found("falling_pays", living(1.1, -1.0)) == []


def curriculum(weight, num_steps):
    node = term("curriculums.modify_reward_weight", term_name="alive", weight=weight, num_steps=num_steps)
    return case(rewards=ALIVE, curriculum={"later": node})


def test_a_change_after_the_end_of_training_never_comes():
    (finding,) = found("noop_curriculum", curriculum(1.0, 200))  # The training has 20 iterations of 10 steps.
    assert finding.figures == {"num_steps": 200, "total_steps": 200}
    assert found("noop_curriculum", curriculum(1.0, 199)) == []
    (finding,) = found("noop_curriculum", curriculum(5.0, 100))  # The curriculum sets the current weight.
    assert finding.key == "env.curriculum.later.weight"


def levels(size, speed=1.0):
    ranges = {"lin_vel_x": [-0.6 * speed, 0.3 * speed], "lin_vel_y": [-0.8 * speed, 0.0], "ang_vel_z": [0.0, 9.0]}
    terrain = {"static_friction": 0.6, "dynamic_friction": 0.4, **({} if size is None else {"size": [size, 99.0]})}
    return case(
        scene={"terrain": terrain},
        commands={"base_velocity": term("commands.UniformVelocityCommand", ranges=ranges)},
        curriculum={"c": term("curriculums.terrain_levels_vel")},
    )


def test_levels_need_tiles_and_commands_that_cover_half_a_tile():
    (finding,) = found("levels_out_of_reach", levels(20.0))
    assert finding.key == "env.scene.terrain.size"
    assert finding.figures == {"speed_m_s": pytest.approx(1.0), "way_m": pytest.approx(10.0), "half_tile_m": 10.0}
    assert found("levels_out_of_reach", levels(19.9)) == []
    (finding,) = found("levels_out_of_reach", levels(None))  # Levels need tiles and commands.
    assert finding.key == "env.curriculum.c"
    (finding,) = found("levels_out_of_reach", levels(1.0, speed=0.0))
    assert finding.advice == ()
