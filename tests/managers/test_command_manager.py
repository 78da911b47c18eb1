"""Commands: timers, counters, standing, headings, metrics."""

import math

import pytest
import torch
from sim.small_envs import run

STILL = torch.zeros(4, 4)
RANGES = {"lin_vel_x": [-0.3, 0.3], "lin_vel_y": [0.1, 0.2], "ang_vel_z": [-0.5, 0.5]}


def _command(**changes):
    node = {"_target_": "wheelleg_exp.mdp.commands.UniformVelocityCommand", "resampling_time_range": [0.1, 0.1]}
    return {"v": {**node, "ranges": RANGES, **changes}}


def _env(start_env, **changes):
    sections = {k: changes.pop(k) for k in ("num_envs", "episode_length_s", "seed") if k in changes}
    env = start_env(commands=_command(**changes), **sections)
    return env, env.command_manager.get_term("v")


def test_commands_and_times_between_draws_are_uniform_in_their_ranges(start_env):
    _, term = _env(start_env, resampling_time_range=[1.0, 3.0], num_envs=3000)
    drawn = torch.cat((term.command, term.time_left.unsqueeze(1)), dim=1)
    for column, (low, high) in enumerate([*RANGES.values(), (1.0, 3.0)]):
        values, edge = drawn[:, column], 0.01 if column < 3 else 0.02
        assert low <= float(values.min()) < low + edge
        assert high - edge < float(values.max()) <= high
        assert float(values.mean()) == pytest.approx((low + high) / 2, abs=0.02 if column < 3 else 0.05)
    assert abs(float(torch.corrcoef(term.command.T)[0, 2])) < 0.06


def test_a_command_is_redrawn_when_its_time_is_up(start_env):
    env, term = _env(start_env)
    at = []
    for step in range(1, 12):
        before = term.command.clone()
        env.command_manager.compute(0.02)
        at += [] if torch.equal(before, term.command) else [step]
    # 0.1 is not a multiple of 0.02 in float32, so the timer may reach 0 at the fifth or the sixth step. The timer
    # restarts from the drawn time, so the intervals are equal.
    assert at[0] in (5, 6)
    assert at[1] - at[0] == at[0]


def test_the_counter_is_one_after_a_reset_and_grows_with_each_draw(start_env):
    env, term = _env(start_env, resampling_time_range=[0.05, 0.05])
    assert term.command_counter.tolist() == [1] * 4
    run(env, 3)
    assert term.command_counter.tolist() == [2] * 4
    env.reset(env_ids=torch.tensor([3]))
    assert term.command_counter.tolist() == [2, 2, 2, 1]


def test_a_fresh_timer_loses_a_control_step_at_an_automatic_reset(start_env):
    env, term = _env(start_env, resampling_time_range=[1.0, 1.0], episode_length_s=0.02)
    env.reset()  # a reset by the caller does not advance the timer
    assert term.time_left.tolist() == [1.0] * 4
    env.step(STILL)
    torch.testing.assert_close(term.time_left, torch.full((4,), 0.98))


def test_standing_robots_get_zero_commands_in_each_step(start_env):
    env, term = _env(start_env, rel_standing_envs=1.0, resampling_time_range=[9.0, 9.0])
    assert (term.command[:, 1] != 0).all()
    for _ in range(3):
        env.step(STILL)
        assert (term.command == 0).all()
        term.command[:] = 1.0


def test_standing_and_following_a_heading_are_drawn_independently(start_env):
    """Both act from the first ``compute`` on: the drawn yaw rate is at most 0.2, and a heading of 3 demands more."""
    shares = {"heading_command": True, "rel_heading_envs": 0.5, "rel_standing_envs": 0.4}
    ranges = RANGES | {"heading": [3.0, 3.0], "ang_vel_z": [0.1, 0.2]}
    _, term = _env(start_env, ranges=ranges, num_envs=3000, **shares)
    stands, follows, drawn = term.is_standing_env, term.is_heading_env, term.command.clone()
    found = [float(chosen.float().mean()) for chosen in (stands, follows, stands & follows)]
    assert found == pytest.approx([0.4, 0.5, 0.2], abs=0.03)
    values = torch.stack((drawn[:, 0], stands.float(), follows.float()))
    assert (torch.corrcoef(values) - torch.eye(3)).abs().max() < 0.06
    assert ((drawn[:, 2] >= 0.1) & (drawn[:, 2] < 0.2)).all()
    term.compute(0.02)
    assert torch.equal((term.command == 0).all(dim=1), stands)
    assert torch.equal(term.command[:, 2] == 0.2, follows & ~stands)
    assert torch.equal(term.command[~follows & ~stands], drawn[~follows & ~stands])


def test_headings_are_followed_proportionally_and_clipped(start_env):
    ranges = RANGES | {"ang_vel_z": [-0.5, 0.4], "heading": [3.0, 3.0]}
    env, term = _env(
        start_env, ranges=ranges, heading_command=True, rel_heading_envs=1.0, heading_control_stiffness=0.5
    )
    robot = env.scene.robot
    for yaw, expected in (
        (2.5, 0.25),  # .5 * (3 - 2.5)
        (1.0, 0.4),  # clipped
        (-3.0, 0.5 * (6.0 - 2 * math.pi)),  # the shorter turn is backwards
        (-2.0, -0.5),  # 5 rad wraps to -1.283
    ):
        quat = torch.tensor([[math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2)]]).expand(4, 4)
        robot.write_root_pose_to_sim(torch.cat((robot.data.root_pos_w.clone(), quat), dim=1), torch.arange(4))
        env.command_manager.compute(0.0)
        torch.testing.assert_close(term.command[:, 2], torch.full((4,), expected), atol=1e-5, rtol=0)


def test_metrics_are_divided_by_the_longest_command_time_logged_as_means_and_restarted(start_env):
    """Two steps of 0.02 s are divided by the longest time of 0.5 s."""
    env, term = _env(start_env, resampling_time_range=[0.4, 0.5])
    data = env.scene.robot.data
    turned = torch.tensor([[0.8, 0.0, 0.36, 0.48]] * 4)
    env.scene.robot.write_root_pose_to_sim(torch.cat((data.root_pos_w, turned), dim=1), torch.arange(4))
    env.scene.robot.write_root_velocity_to_sim(torch.tensor([[0.3, 0.1, 0.2, 1.0, 0.5, 0.2]] * 4), torch.arange(4))
    xy = float((term.command[:, :2] - data.root_lin_vel_b[:, :2]).norm(dim=1)[[1, 3]].mean())
    yaw = float((term.command[:, 2] - data.root_ang_vel_b[:, 2]).abs()[[1, 3]].mean())
    for _ in range(2):
        env.command_manager.compute(0.02)
    log = env.command_manager.reset(torch.tensor([1, 3]))
    assert float(log["Metrics/v/error_vel_xy"]) == pytest.approx(xy * 2 * 0.02 / 0.5, rel=1e-5)
    assert float(log["Metrics/v/error_vel_yaw"]) == pytest.approx(yaw * 2 * 0.02 / 0.5, rel=1e-5)
    assert float(log["Episode_Metrics/v/error_vel_xy_per_step"]) == pytest.approx(xy, rel=1e-5)
    assert (term.metrics > 0).all(dim=0).tolist() == [True, False, True, False]
    log = env.command_manager.reset(torch.tensor([1]))  # after no step
    assert float(log["Metrics/v/error_vel_xy"]) == float(log["Episode_Metrics/v/error_vel_xy_per_step"]) == 0.0
    error = float((term.command[1, :2] - data.root_lin_vel_b[1, :2]).norm())
    env.command_manager.compute(0.02)
    log = env.command_manager.reset(torch.tensor([1]))
    assert float(log["Episode_Metrics/v/error_vel_xy_per_step"]) == pytest.approx(error)


def test_an_environment_reset_in_a_step_gets_one_sample_of_the_new_command(start_env):
    env, term = _env(start_env, episode_length_s=0.02, resampling_time_range=[0.5, 0.5], rel_standing_envs=1.0)
    drawn, draw = [], term.draw
    term.draw = lambda ids: (draw(ids), drawn.append(term.command.clone()))
    env.step(STILL)
    (command,) = drawn
    error = (command[:, :2] - env.scene.robot.data.root_lin_vel_b[:, :2]).norm(dim=1) * 0.02 / 0.5
    torch.testing.assert_close(term.metrics[0], error)
    assert (error > 0.0).all()
    assert (term.command == 0).all()


def test_the_metric_is_sampled_before_the_command_is_redrawn(start_env):
    env, term = _env(start_env, resampling_time_range=[0.02, 0.02])
    old = term.command[:, :2].clone()
    env.command_manager.compute(0.02)
    assert not torch.equal(old, term.command[:, :2])
    torch.testing.assert_close(term.metrics[0], old.norm(dim=1) * 0.02 / 0.02)


def test_a_heading_range_without_headings_warns(start_env):
    with pytest.warns(UserWarning, match="heading"):
        start_env(commands=_command(ranges=RANGES | {"heading": [0, 1]}))
