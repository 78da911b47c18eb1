"""Curricula that are judged by skill above standing still, and by the way along the commands: worked out by hand."""

from __future__ import annotations

import math
from types import SimpleNamespace

import pytest
import torch

from wheelleg_exp.errors import ConfigError
from wheelleg_exp.jobs.train.run_training import StuckCurricula
from wheelleg_exp.mdp.curriculums import action_delay_levels, command_levels_by_skill, terrain_levels_by_distance
from wheelleg_exp.mdp.terminations import terrain_tile_left

approx = pytest.approx
N, LONGEST = 4, 10
PASSES, MORE = {"passes": 2}, {"min_episodes": 2 * N}
ALL = torch.arange(N)


class World:
    """An environment of four robots whose commands and velocities a test sets."""

    def __init__(self) -> None:
        self.num_envs, self.device = N, torch.device("cpu")
        self.max_episode_length, self.step_dt, self.common_step_counter = LONGEST, 0.1, 0
        self.episode_length_buf = torch.zeros(N, dtype=torch.long)
        self.observers: list = []
        self.command = torch.zeros(N, 3)
        self.term = SimpleNamespace(ranges={"lin_vel_x": [-0.3, 0.3], "ang_vel_z": [-0.5, 0.5]})
        self.command_manager = SimpleNamespace(get_command=lambda _: self.command, get_term=lambda _: self.term)
        self.termination_manager = SimpleNamespace(terminated=torch.zeros(N, dtype=torch.bool))
        names = ("root_lin_vel_b", "root_ang_vel_b", "root_lin_vel_w", "root_pos_w", "projected_gravity_b")
        self.data = SimpleNamespace(**{name: torch.zeros(N, 3) for name in names}, heading_w=torch.zeros(N))
        self.moved: list = []
        terrain = SimpleNamespace(
            terrain_origins=(), terrain_levels=torch.zeros(N), max_terrain_level=10, size=(1.2, 1.2)
        )
        terrain.update_env_origins = lambda _, up, down: self.moved.append((up.tolist(), down.tolist()))
        self.scene = Scene(robot=SimpleNamespace(data=self.data))
        self.scene.robot, self.scene.articulations = self.scene["robot"], self.scene
        self.scene.terrain, self.scene.env_origins = terrain, torch.zeros(N, 3)

    def state_dict(self) -> dict:
        return {}

    def load_state_dict(self, saved) -> None: ...

    def episode(self, curriculum, steps=LONGEST, failed=False):
        for _ in range(steps):
            self.episode_length_buf += 1
            self.common_step_counter += 1
            for observe in self.observers:
                observe()
        self.termination_manager.terminated.fill_(failed)
        state = curriculum(self, ALL)
        self.episode_length_buf.zero_()
        return state


class Scene(dict):
    """A scene, to which a test adds attributes."""


@pytest.fixture
def world():
    return World()


def by_skill(world, **settings):
    given = {"min_episodes": N, "passes": 1, "patience": 3, **settings}
    curriculum = command_levels_by_skill(
        world, {"lin_vel_x": [-0.4, 0.4]}, std={"lin_vel_x": 0.1}, step={"lin_vel_x": 0.06}, **given
    )
    return curriculum


def test_standing_still_has_no_skill_for_any_command(world):
    curriculum = by_skill(world)
    world.command[:, 0] = torch.tensor([0.05, 0.1, -0.2, 0.3])
    assert world.episode(curriculum)["lin_vel_x_skill"] == pytest.approx(0.0, abs=1e-6)
    assert world.term.ranges["lin_vel_x"] == [-0.3, 0.3]


@pytest.mark.parametrize(
    ("axis", "column", "command", "velocity", "std"),
    [("lin_vel_x", 0, 0.3, 0.2, 0.1), ("ang_vel_z", 2, -0.4, -0.25, 0.5)],
)
def test_the_skill_is_that_of_the_formula(world, axis, column, command, velocity, std):
    settings = {"std": {axis: std}, "step": {axis: 0.1}, "min_episodes": N}
    curriculum = command_levels_by_skill(world, {axis: [-1.0, 1.0]}, **settings)
    world.data.root_lin_vel_b[:] = world.data.root_ang_vel_b[:] = 9.0
    of = world.data.root_lin_vel_b if column < 2 else world.data.root_ang_vel_b
    world.command[:, column], of[:, column] = command, velocity
    score, still = math.exp(-(((command - velocity) / std) ** 2)), math.exp(-((command / std) ** 2))
    assert world.episode(curriculum)[f"{axis}_skill"] == pytest.approx((score - still) / (1 - still), rel=1e-5)


def test_steps_without_a_command_do_not_count(world):
    curriculum = by_skill(world)
    world.command[0, 0] = world.data.root_lin_vel_b[0, 0] = 0.2
    world.data.root_lin_vel_b[1:, 0] = 5.0
    assert world.episode(curriculum)["lin_vel_x_skill"] == pytest.approx(1.0)


def test_a_fall_scores_nothing_in_the_rest_of_a_longest_episode(world):
    curriculum, still = by_skill(world), math.exp(-9.0)
    world.command[:, 0] = world.data.root_lin_vel_b[:, 0] = 0.3
    skill = world.episode(curriculum, steps=4, failed=True)["lin_vel_x_skill"]
    assert skill == pytest.approx((0.4 - still) / (1 - still), rel=1e-5)
    assert world.episode(curriculum, steps=4)["lin_vel_x_skill"] == pytest.approx(1.0)  # truncation is not failure


@pytest.mark.parametrize(
    ("settings", "key", "speeds", "expected", "high"),
    [
        # The third evaluation has only episodes from before the growth.
        (PASSES, "lin_vel_x", [0.3] * 6, approx([0.3, 0.36, 0.36, 0.36, 0.4, 0.4]), 0.4),
        (PASSES, "lin_vel_x", [0.3, 0.0, 0.3, 0.3], approx([0.3, 0.3, 0.3, 0.36]), 0.36),
        (MORE, "lin_vel_x", [0.3, 0.3], [0.3, approx(0.36)], 0.36),
        (MORE, "lin_vel_x_skill", [0.0, 0.0, 0.3, 0.3], approx([0.0, 0.0, 0.0, 1.0], abs=1e-6), 0.36),
    ],
    ids=["up to the limit", "a failure restarts the row", "too few episodes", "as many new episodes"],
)
def test_a_range_grows_after_enough_episodes_and_passes_in_a_row(world, settings, key, speeds, expected, high):
    curriculum, found = by_skill(world, **settings), []
    world.command[:, 0] = 0.3
    for speed in speeds:
        world.data.root_lin_vel_b[:, 0] = speed
        found.append(world.episode(curriculum)[key])
    assert found == expected
    assert world.term.ranges == {"lin_vel_x": [-high, high], "ang_vel_z": [-0.5, 0.5]}


def test_episodes_that_started_before_the_growth_do_not_count(world):
    curriculum = by_skill(world, min_episodes=2)
    world.command[:, 0] = world.data.root_lin_vel_b[:, 0] = 0.3
    for _ in range(4):
        world.episode_length_buf += 1
        curriculum.observe()
    assert curriculum(world, ALL[:2])["lin_vel_x"] == pytest.approx(0.36)
    world.episode_length_buf[:2] = 0
    world.data.root_lin_vel_b[:, 0] = 0.0
    curriculum(world, ALL[2:])
    assert curriculum(world, ALL[:0])["lin_vel_x_skill"] == pytest.approx(1.0)  # no evaluation since
    assert world.episode(curriculum)["lin_vel_x_skill"] == pytest.approx(0.0, abs=1e-6)


def test_a_reset_before_the_first_step_is_not_an_episode(world):
    curriculum, ground = by_skill(world), terrain_levels_by_distance(world)
    world.command[:, 0] = 0.3
    assert world.episode(curriculum, steps=0, failed=True)["lin_vel_x_stuck"] == 0.0
    world.data.root_lin_vel_b[:, 0] = 0.3
    assert world.episode(curriculum)["lin_vel_x_skill"] == pytest.approx(1.0)
    world.command[:] = 0.0
    world.episode(ground)
    world.episode(ground, steps=0, failed=True)
    assert world.moved[-1] == ([False] * N, [False] * N)


def test_a_stuck_curriculum_is_reported_once_by_name(world):
    curriculum, found = by_skill(world), StuckCurricula()
    world.command[:, 0] = 0.3
    lines = []
    for index in range(5):
        log = {f"Curriculum/road/{key}": value for key, value in world.episode(curriculum).items()}
        lines += found.take(index, log)
    assert len(lines) == 1
    assert "env.curriculum.road (lin_vel_x) is stuck by iteration 3" in lines[0]
    assert found.now == ["road/lin_vel_x"]
    world.data.root_lin_vel_b[:, 0] = 0.3
    assert world.episode(curriculum)["lin_vel_x_stuck"] == 0.0
    assert (list(found.take(9, {"Curriculum/road/lin_vel_x_stuck": 0.0})), found.now) == ([], [])


@pytest.mark.parametrize(
    ("limits", "std", "said"),
    [
        ({"lin_vel_z": [-1.0, 1.0]}, {}, "has no range 'lin_vel_z'"),
        ({"lin_vel_x": [-0.1, 0.3]}, {"lin_vel_x": 0.1}, "is beyond"),
        ({"lin_vel_x": [-0.3, 0.1]}, {"lin_vel_x": 0.1}, "is beyond"),
        ({"lin_vel_x": [-1.0, 1.0]}, {}, "std.lin_vel_x"),
    ],
)
def test_axes_that_cannot_grow_are_rejected(world, limits, std, said):
    with pytest.raises(ConfigError, match=said):
        command_levels_by_skill(world, limits, std=std, step={"lin_vel_x": 0.1})


@pytest.mark.parametrize(
    ("speed", "steps", "failed", "moves"),
    [
        (0.71, 10, False, (True, False)),
        (0.69, 10, False, (False, False)),
        (0.36, 10, False, (False, False)),
        (0.34, 10, False, (False, True)),
        (-1.0, 10, False, (False, True)),
        (1.0, 6, True, (False, False)),  # 0.6 of the distance that a full-length episode commands
        (1.0, 3, True, (False, True)),
        (1.0, 3, False, (True, False)),  # a truncated episode, as after leaving the tile
    ],
)
def test_robots_move_by_the_share_of_the_way_that_was_commanded(world, speed, steps, failed, moves):
    """The command is 2 m/s along (0.6, 0.8). Robots cover a share of this way, and also drift across."""
    curriculum = terrain_levels_by_distance(world)
    world.data.heading_w.fill_(0.6)
    world.command[:, :2] = 2.0 * torch.tensor([0.6, 0.8])
    x, y, cos, sin = 2.0 * speed * 0.6 - 0.8, 2.0 * speed * 0.8 + 0.6, math.cos(0.6), math.sin(0.6)
    world.data.root_lin_vel_w[:, :2] = torch.tensor([cos * x - sin * y, sin * x + cos * y])
    world.episode(curriculum, steps, failed)
    assert world.moved == [([moves[0]] * N, [moves[1]] * N)]


def test_the_way_of_an_episode_is_not_that_of_the_last(world):
    curriculum = terrain_levels_by_distance(world)
    world.command[:, 0] = 1.0
    for speed in (1.0, 0.3, 1.0):
        world.data.root_lin_vel_w[:, 0] = speed
        world.episode(curriculum)
    assert [(up[0], down[0]) for up, down in world.moved] == [(True, False), (False, True), (True, False)]


def test_a_robot_commanded_to_stand_stays_unless_it_fell(world):
    curriculum = terrain_levels_by_distance(world)
    world.episode(curriculum)
    world.episode(curriculum, steps=3, failed=True)
    world.episode(curriculum, steps=1, failed=True)
    assert world.moved == [([False] * N, [False] * N), ([False] * N, [True] * N), ([False] * N, [True] * N)]


def test_levels_that_do_not_rise_are_stuck_unless_beyond_half_of_the_hardest(world):
    """The hardest of ten rows is row 9."""
    curriculum = terrain_levels_by_distance(world, patience=2)
    for level, stuck in ((0.0, 1.0), (4.4, 1.0), (4.6, 0.0)):
        world.scene.terrain.terrain_levels.fill_(level)
        assert [world.episode(curriculum)["stuck"] for _ in range(4)] == [0.0, 0.0, 0.0, stuck]


def test_down_must_be_below_up(world):
    with pytest.raises(ConfigError, match="less than up"):
        terrain_levels_by_distance(world, up=0.3, down=0.5)


def test_a_tile_is_left_beyond_its_edge_along_either_axis(world):
    world.scene.env_origins[:] = torch.tensor([10.0, -20.0, 3.0])
    world.data.root_pos_w[:, :2] = torch.tensor([[10.59, -20.0], [10.61, -20.0], [10.0, -20.61], [9.5, -19.5]])
    assert terrain_tile_left(world).tolist() == [False, True, True, False]
    assert terrain_tile_left(world, margin=0.1).tolist() == [False] * N
    world.scene.terrain.size = (math.inf, math.inf)
    assert terrain_tile_left(world).tolist() == [False] * N


def test_a_robot_that_survives_gets_longer_delays_and_harder_kicks():
    world = World()
    delay = SimpleNamespace(share=torch.zeros(N))
    world.action_manager = SimpleNamespace(delays={"legs": delay})
    levels = action_delay_levels(world, num_episodes=4)
    world.termination_manager.time_outs = torch.tensor([True, True, False, True])
    means = [float(world.episode(levels)) for _ in range(5)]
    assert means == approx([0.1875, 0.375, 0.5625, 0.75, 0.75])
    world.termination_manager.time_outs[:2] = False
    world.episode_length_buf[:] = torch.tensor([0, 4, 5, 6])  # Of 10 control steps.
    levels(world, torch.tensor([0, 1, 2]))
    assert levels.level.tolist() == approx([0.75, 0.85, 0.0, 1.0])
    levels.level[0] = 0.375
    world.episode_length_buf[0] = 5
    levels(world, torch.tensor([0]))
    assert delay.share.tolist() == approx([0.5, 1.0, 0.0, 1.0])


def test_a_robot_that_lies_at_the_end_has_not_survived_if_the_tilt_is_limited():
    world = World()
    world.action_manager = SimpleNamespace(delays={})
    world.termination_manager.time_outs = torch.ones(N, dtype=torch.bool)
    for tilt, expected in ((0.4, 0.5), (0.6, 0.0)):
        world.data.projected_gravity_b[:] = torch.tensor([math.sin(tilt), 0.0, -math.cos(tilt)])
        levels = action_delay_levels(world, num_episodes=2, max_tilt=0.5)
        world.episode(levels)
        assert levels.level.tolist() == approx([expected] * N)
        assert float(action_delay_levels(world, num_episodes=2)(world, ALL)) == approx(0.5)
