"""Numbers of the stock robot, converted for a robot that is twice as high, and a thousand times as heavy."""

from __future__ import annotations

import math

import pytest

from wheelleg_exp.config.composing.compose import compose
from wheelleg_exp.config.composing.sized_values import SIZES, robot_sizes
from wheelleg_exp.errors import ConfigError

ROBOT = """# @package env.robot
profile: tall
size: 0.14
mass: 500.0
natural_speed: {speed}
wheel_radius: 0.06
leg_reach: 0.5
"""
SPEED = 0.83 * math.sqrt(2)  # Froude's number, speed² / (gravity · length), is that of the stock robot.


@pytest.fixture
def env(tmp_path):
    def of(*words, primary="train"):
        (tmp_path / "robot").mkdir(exist_ok=True)
        (tmp_path / "robot" / "tall.yaml").write_text(ROBOT.format(speed=SPEED))
        return compose(["robot=tall", *words], primary=primary, config_dirs=[tmp_path]).config["env"]

    return of


def test_a_similar_robot_gets_the_same_rewards_for_similar_errors(env):
    rewards, stock = env("task=walk")["rewards"], compose(["task=walk"]).config["env"]["rewards"]
    second = 0.14 / SPEED / (0.07 / 0.83)  # of the tall robot, in those of the stock robot
    errors = {
        "base_height": 2.0**2,  # m²
        "lin_vel_z": 2.0,  # m²/s²: the speeds of similar robots grow with the square root of their sizes
        "ang_vel_xy": second**-2,  # 1/s²
        "wheel_torques": (1000.0 * 2.0) ** 2,  # (N·m)²
        "travel_error": 2.0**2,  # m²
    }
    for name, squared in errors.items():
        assert rewards[name]["weight"] * squared == pytest.approx(stock[name]["weight"], rel=1e-4), name
    assert rewards["track_lin_vel_xy"]["std"] == pytest.approx(0.15 * math.sqrt(2), rel=1e-4)
    assert rewards["wheel_air"]["threshold"] == pytest.approx(300.0)  # N
    assert second == pytest.approx(math.sqrt(2))


def test_the_stock_robot_keeps_its_numbers_exactly():
    composed = compose(["task=terrain"]).config["env"]
    assert composed["scene"]["terrain"]["sub_terrains"]["stairs"]["step_height_range"] == [0.001, 0.008]
    assert composed["commands"]["base_velocity"]["ranges"]["lin_vel_x"] == [-0.4, 0.4]


def test_the_sizes_in_the_stock_robots_file_are_those_of_the_stock_numbers():
    robot = compose(["task=stand"]).config["env"]["robot"]
    assert {key: robot[key] for key in SIZES} == SIZES


def test_a_robot_file_of_an_earlier_version_keeps_all_numbers(tmp_path):
    (tmp_path / "robot").mkdir()
    (tmp_path / "robot" / "old.yaml").write_text("# @package env.robot\nprofile: old\nwheel_radius: 0.1\n")
    terms = [compose(words, config_dirs=[tmp_path]).config["env"] for words in (["robot=old"], [])]
    assert terms[0]["scene"] == terms[1]["scene"]
    assert terms[0]["rewards"] == terms[1]["rewards"]
    assert robot_sizes(terms[0]) == ["++env.robot.standing_height=0.07"]


@pytest.mark.parametrize("size", [None, math.nan, math.inf, -1.0, "${oc.env:HOME}", {"a": 1}])
def test_only_numbers_of_a_recorded_robot_reach_a_composition(size):
    assert robot_sizes({"robot": {"size": size, "mass": 1.0, "standing_height": size}}) == []


@pytest.mark.parametrize("robot", [{"size": 0.5, "natural_speed": 2.0, "wheel_radius": 0.1, "mass": 3.0}, {}])
def test_the_arena_commands_shares_of_the_largest_commands_of_the_policys_task(robot):
    ranges = {"lin_vel_x": [-1.0, 2.0], "ang_vel_z": [-3.0, 0.5]}
    words = robot_sizes({"robot": robot, "commands": {"base_velocity": {"ranges": ranges}}})
    protocol = compose([*words, "protocol=arena"], primary="evaluate").config["protocol"]
    assert protocol["walk"]["lin_vel_x"] == [-2.0, -1.0, 0.0, 1.0, 2.0]
    assert protocol["walk"]["ang_vel_z"] == [-3.0, 0.0, 3.0]
    assert protocol["terrain"]["lin_vel_x"] == 1.0


def test_a_task_without_commanded_speeds_is_refused_by_the_name_of_its_ranges():
    words = robot_sizes(compose(["task=stand"]).config["env"])
    message = r"the task commands no speed in env\.commands\.base_velocity\.ranges\.lin_vel_x"
    with pytest.raises(ConfigError, match=message):
        compose([*words, "protocol=arena"], primary="evaluate")


@pytest.mark.parametrize("limits", [[], [0.5, None], ["a"], None])
def test_spoiled_ranges_of_a_recorded_task_do_not_reach_a_composition(limits):
    assert robot_sizes({"commands": {"base_velocity": {"ranges": {"lin_vel_x": limits}}}}) == []


def test_powers_of_a_commanded_speed_need_no_size_of_the_robot():
    words = ["++env.robot.lin_vel_x=3.0", "protocol=arena", "protocol.terrain.lin_vel_x='${sized:0.5,vx2}'"]
    assert compose(words, primary="evaluate").config["protocol"]["terrain"]["lin_vel_x"] == 4.5


def test_a_strip_ends_before_the_drive_over_it():
    for speed in (SPEED, 0.5):
        words = [f"++env.robot.{key}={value}" for key, value in {**SIZES, "natural_speed": speed}.items()]
        strip = compose([*words, "protocol=terrain"], primary="evaluate").config["protocol"]["strip"]
        assert strip["before"] + strip["length"] < strip["lin_vel_x"] * strip["horizon_s"]


def test_steps_count_in_radii_of_the_wheels_and_cells_fit_into_them(env):
    terrain = env("task=steps")["scene"]["terrain"]
    assert terrain["sub_terrains"]["step"]["box_height_range"] == pytest.approx([0.006, 0.078])
    width, cell = terrain["sub_terrains"]["stairs"]["step_width"], terrain["horizontal_scale"]
    assert width / cell == pytest.approx(5.0, abs=1e-4)


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ("${sized:1.0,furlong}", r"'furlong' is not a unit of \$\{sized:…\}; units are m, s, kg"),
        ("${sized:1.0,m/s/s}", "'m/s/s' is not a unit"),
        ("${sized:abc,m}", "'abc' is not a number"),
        (
            "${sized:1.0,leg}",
            "the robot has no leg joints: env.robot.leg_reach is None, but a number in 'leg' needs it",
        ),
    ],
)
def test_what_cannot_be_converted_is_reported_at_its_key(value, message):
    with pytest.raises(ConfigError, match=message) as refused:
        compose(["env.robot.leg_reach=null", f"env.rewards.alive.weight='{value}'"])
    assert "env.rewards.alive.weight" in str(refused.value)


def test_a_term_for_a_role_that_no_joint_has_is_left_out():
    without = "env.robot.joint_sets.left_legs=[]", "env.robot.joint_sets.right_legs=[]"
    composed = compose(["task=walk", *without])
    assert composed.terms_without_role == ["env.rewards.leg_joint_symmetry"]
    assert compose(["task=walk", "env.events.push_robot=null"]).terms_without_role == []
    assert "leg_joint_symmetry" not in composed.config["env"]["rewards"]
