"""Test rollouts: command schedules, changed worlds, and mechanical work over physics steps."""

import hashlib
import math
import re
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
import torch

from evaluation.conftest import protocol, read_protocol, stub_env, words, zeros
from wheelleg_exp.config.composing.compose import compose
from wheelleg_exp.errors import ConfigError
from wheelleg_exp.evaluation.disturbance_tests import add_velocity, disturbances, gain_ramp, margin, world, worlds
from wheelleg_exp.evaluation.evaluation_env import build, evaluation_options
from wheelleg_exp.evaluation.lqr_balancer import Reference
from wheelleg_exp.evaluation.policy_rollout import Rollout
from wheelleg_exp.evaluation.protocol import evaluate
from wheelleg_exp.evaluation.scenarios import Scenarios, at_heights, getting_up, in_changed_world, jumping, standing
from wheelleg_exp.evaluation.trajectories import EffortMeter
from wheelleg_exp.managers import Env
from wheelleg_exp.sim.options import EnvOptions, read_env
from wheelleg_exp.terms.config_sections import Realism


def settings(env, options, num_envs=2, horizon_s=1.0) -> EnvOptions:
    return evaluation_options(read_env(env), options, num_envs, horizon_s, "flat")


def rollout(task, scenarios, env=None) -> Rollout:
    options = read_protocol("stand")
    env = env or settings(task[0], options, scenarios.size, scenarios.horizon_s)
    made = build(replace(env, terminations={}), task[1], 5)
    return Rollout(made, scenarios, replace(options, fall_tilt=3.2, settle_s=0.0))


def test_commands_follow_the_table_and_appear_in_every_observation(task):
    # Use binary fractions, because the term adds the difference to the old command, which would round other numbers.
    cells = (((0.125, 0.0, 0.0), (-0.25, 0.0, 0.25)), ((0.0, 0.0, 0.5), (0.0, 0.0, 0.0)))
    made = rollout(task, Scenarios("steps", 0.2, (0.0, 0.1), cells, ("a", "b"), 1))
    term = made.env.command_manager.get_term("base_velocity")
    seen, standing = [], []

    def policy(observations):
        seen.append(made.env.command_manager.get_command("base_velocity").clone())
        standing.append(term.is_standing_env.tolist())
        return zeros(made.env)(observations)

    found = made.roll(policy, 3)
    expected = torch.tensor(cells)[:, [0] * 6 + [1] * 6].transpose(0, 1)
    assert torch.equal(torch.stack(seen), expected)
    assert torch.equal(found.command, expected)
    assert (standing[0], standing[-1]) == ([False, False], [False, True])


def test_the_next_observation_and_the_stored_state_before_it_show_a_push(task):
    made = rollout(task, Scenarios("push", 0.2, (0.0,), (((0.0, 0.0, 0.0),),), ("a",), 2))
    policy, seen = zeros(made.env), []

    def watched(observations):
        seen.append(observations["critic"].clone())
        return policy(observations)

    def push(step):
        if step == 5:
            add_velocity(made.env, torch.tensor([[0.3, 0.0], [0.0, -0.3]]))

    quiet, pushed = (made.roll(watched, 3, disturb=disturb) for disturb in (None, push))
    assert [torch.equal(*pair) for pair in zip(seen[:12], seen[12:], strict=True)] == [True] * 5 + [False] * 7
    change = torch.linalg.vector_norm(pushed.vel - quiet.vel, dim=-1)
    assert not change[:4].any()
    assert change[4].tolist() == pytest.approx([0.3, 0.3])
    assert torch.equal(pushed.pos[:5], quiet.pos[:5])
    assert made.env.observers == []


def held(task, name, term, make, *changes) -> torch.Tensor:
    """Return the values of a command over 4 s, (T, N, D), in the test of the same name."""
    options = read_protocol(name, *changes)
    jump = ["task=jump", "env.commands.jump.heights=[0.02,0.05]", "env.commands.jump.window_s=0.8"]
    env = compose(jump if term == "jump" else ["task=height"]).config["env"]
    table = make(getattr(options, name))
    cfg = replace(settings(env, options, table.size, 4.0), terminations={})
    made = Rollout(build(cfg, task[1], 5), replace(table, horizon_s=4.0), replace(options, fall_tilt=3.2))
    seen = []
    policy = zeros(made.env)

    def watched(observations):
        seen.append(made.env.command_manager.get_command(term).clone())
        return policy(observations)

    made.roll(watched, 3)
    return torch.stack(seen)


def test_each_episode_has_a_constant_height_command(task):
    changes = words("height", episodes=1, heights="[0.05,0.09]", lin_vel_x="[0.0]")
    seen = held(task, "height", "base_pose", at_heights, *changes)
    assert torch.equal(seen, torch.tensor([[0.05, 0.0, 0.0], [0.09, 0.0, 0.0]]).expand_as(seen))
    seen = held(task, "stand", "base_pose", standing, *words("stand", episodes=1))
    assert seen.flatten().tolist() == pytest.approx([0.0725, 0.0, 0.0] * len(seen))  # the middle of the task's range


def test_each_episode_has_one_jump_at_the_time_of_the_protocol(task):
    changes = words("jump", episodes=1, lin_vel_x="[0.0,0.3]", ang_vel_z="[0.5]", at_s=1.0, height=0.03)
    command = held(task, "jump", "jump", jumping, *changes)
    seen = command[:, :, 0] > 0.0
    jumps = seen[:, 0].nonzero().squeeze(1) / 60
    assert (float(jumps[0]), float(jumps[-1])) == pytest.approx((1.0, 1.8), abs=0.04)
    assert len(jumps) == int(seen[:, 1].sum()) == pytest.approx(48, abs=1)
    assert torch.equal(command[:, :, 1], torch.where(seen, 0.03, 0.0))
    changes = words("stand", episodes=1)
    assert not held(task, "stand", "jump", standing, *changes).any()


def test_a_task_without_a_command_for_jumps_cannot_be_tested_for_jumps(task):
    options = read_protocol("jump")
    table = jumping(replace(options.jump, episodes=1))
    env = build(settings(task[0], options, table.size), task[1], 5)
    with pytest.raises(ConfigError, match=r"env\.commands.*commands no jump"):
        Rollout(env, table, options)


def test_digests_of_tables_depend_on_every_value():
    zero, one = ((0.0, 0.0, 0.0),), ((0.1, 0.0, 0.0),)
    table = Scenarios("stand", 5.0, (0.0,), (zero,), ("a",), 2)
    text = '["stand", 5.0, [0.0], [[[0.0, 0.0, 0.0]]], ["a"], 2, "", 1]'  # The digest must not change between versions.
    assert table.digest(1) == hashlib.sha256(text.encode()).hexdigest()
    changes = ({"test": "walk"}, {"horizon_s": 6.0}, {"cells": (one,)}, {"episodes": 3}, {"settings": "harder"})
    others = [replace(table, **change) for change in changes]
    assert len({table.digest(1), table.digest(2), *(other.digest(1) for other in others)}) == 7


def test_the_work_of_a_step_is_torque_times_way_and_the_net_leaves_out_what_the_armature_gains():
    torque = torch.tensor([[2.0, -1.0]])
    before, after = torch.tensor([[1.0, 3.0]]), torch.tensor([[2.0, 1.0]])
    armature = torch.tensor([[0.01, 0.02]])
    motion = {"joint_vel_before": before, "joint_vel": after, "joint_armature": armature}
    env = stub_env(applied_torque=torque, joint_effort_limits=torch.tensor([[2.0, 2.0]]), **motion)
    meter = EffortMeter(env, 0.99, 0.001, 0.1)
    meter.begin(counted=False)
    meter.update()
    way = (before + after) / 2 * 0.1
    kinetic = armature * (after**2 - before**2) / 2
    assert float(meter.gross) == pytest.approx(float((torque * way).abs().sum()))
    assert float(meter.net) == pytest.approx(float((torque * way - kinetic).abs().sum()))
    assert float(meter.positive) == pytest.approx(float((torque * way).clamp(min=0).sum()))
    assert float(meter.peak) == pytest.approx(3.0)  # One motor has 2 N·m at 1.5 rad/s; the other motor brakes.
    meter.update()
    assert meter.shares().tolist() == [[1.0, 0.0]]
    assert float(meter.gross) == pytest.approx(2 * float((torque * way).abs().sum()))


def metered(*torques: float, counted: Sequence[bool] = (True,) * 9) -> list[tuple[float, float]]:
    """Return the RMS torques and the sign changes of control steps with two physics steps each."""
    zero = torch.zeros(1, 1)
    others = dict.fromkeys(("joint_vel", "joint_vel_before", "joint_armature"), zero)
    env = stub_env(applied_torque=zero, joint_effort_limits=torch.tensor([[10.0]]), **others)
    meter, found = EffortMeter(env, 0.99, 0.001, 0.1), []
    for step, pair in enumerate(zip(torques[::2], torques[1::2], strict=True)):
        meter.begin(counted=step > 0 and counted[step - 1])
        for torque in pair:
            env.scene.robot.data.applied_torque = torch.tensor([[torque]])
            meter.update()
        found.append((float(meter.torque_rms()), float(meter.sign_changes)))
    return found


def test_torques_count_in_every_physics_step():
    assert metered(7.0, 1.0, 1.0, -7.0) == [(pytest.approx(5.0), 0.0), (pytest.approx(5.0), 1.0)]


TURNS = (5.0, 5.0, -5.0, -5.0, 5.0, 5.0)


@pytest.mark.parametrize(
    ("torques", "counted", "expected"),
    [
        ((4.0, -4.0, 4.0, -4.0, -4.0, -4.0), (True,) * 9, [1.0, 2.0, 0.0]),
        ((5.0, -0.009, 0.009, -0.009), (True,) * 9, [0.0, 0.0]),  # Torques in the dead band keep the last sign.
        ((5.0, 0.0, 0.0, -5.0, math.nan, 5.0), (True,) * 9, [0.0, 1.0, 1.0]),
        (TURNS, (True,) * 9, [0.0, 1.0, 1.0]),
        (TURNS, (False, True, True), [0.0, 0.0, 1.0]),  # A sign from before the counted steps is forgotten.
    ],
)
def test_sign_changes_are_counted_in_every_physics_step(torques, counted, expected):
    assert [changes for _, changes in metered(*torques, counted=counted)] == expected


SWEEPS = ("friction=[0.3]", "impratio=[100.0]", "mass=[0.7]", "com=[0.005]", "gains=[1.2]", "noise=[1.0]")


@pytest.fixture(scope="module")
def changed(task) -> dict[tuple[str, float], Env]:
    options = read_protocol("robust", *(f"protocol.robust.{sweep}" for sweep in SWEEPS))
    cfg = settings(task[0], options)
    wanted = ("nominal", "friction", "impratio", "mass", "com", "gains", "noise")
    found = [world for world in worlds(cfg, options.robust) if world.sweep in wanted]
    return {(world.sweep, world.value): build(world.env, task[1], 1) for world in found}


def test_a_wheel_with_a_fixed_tire_touches_the_ground_by_its_tire(task, tmp_path):
    text = task[1].read_text()
    tire = re.compile(r'<geom name="(._wheel_link)_cylinder"[^>]*/>')
    assert len(tire.findall(text)) == 2
    robot = tmp_path / "model.xml"
    robot.write_text(tire.sub(lambda found: f'<body name="{found[1]}_tire">{found[0]}</body>', text))
    made = rollout((task[0], robot), Scenarios("stand", 0.5, (0.0,), (((0.0, 0.0, 0.0),),), ("stand",), 1))
    assert made.roll(zeros(made.env), 1).down[6:18].all()  # The robot first falls by some millimetres.


def test_each_world_differs_in_the_property_of_its_name(changed):
    nominal = changed["nominal", 0.0]
    model = nominal.scene.model

    def of(sweep, value, field):
        return changed[sweep, value].scene.sim.expanded[field]

    assert (model.opt.impratio, changed["impratio", 100.0].scene.model.opt.impratio) == (10.0, 100.0)
    robot = nominal.scene.robot.body_ids
    assert of("mass", 0.7, "body_mass")[:, robot].sum(dim=1).tolist() == pytest.approx([0.35, 0.35])
    moved = of("com", 0.005, "body_ipos")[:, robot[0]] - torch.from_numpy(model.body_ipos[int(robot[0])])
    assert moved.numpy() == pytest.approx(np.tile([0.005, 0.0, 0.0], (2, 1)), abs=1e-9)
    shapes = nominal.scene.robot.shape_ids(slice(None))
    assert of("friction", 0.3, "geom_friction")[:, shapes, 0].unique().tolist() == pytest.approx([0.3])
    gains = changed["gains", 1.2].scene.robot.data
    for name in ("joint_stiffness", "joint_damping"):
        assert torch.allclose(getattr(gains, name), 1.2 * getattr(nominal.scene.robot.data, name))
    env = changed["noise", 1.0]
    terms = env.observation_manager.terms("policy")
    noisy = {name for name, node in env.cfg["observations"]["policy"]["terms"].items() if node.get("noise")}
    assert noisy == {"base_ang_vel", "projected_gravity", "joint_pos_rel", "joint_vel_rel"} <= set(terms)


def test_a_change_can_delay_actions_and_readings_lose_readings_and_tilt_the_imu(task):
    options = read_protocol("robust")
    cfg = settings(task[0], options)
    dt = cfg.sim.dt

    def of(name, value):
        return world(cfg, options.robust, name, value).env

    assert {tuple(node["delay"]) for node in of("delay_s", 3 * dt).actions.values()} == {(3, 3)}
    late = of("reading_delay_s", dt).observations["policy"].terms
    assert {name for name, node in late.items() if node.get("delay") == [1, 1]} == set(options.robust.noise_std)
    assert of("lost_readings", 0.2).observations["policy"].terms["base_ang_vel"]["noise"]["lost"] == 0.2
    data = build(of("imu_tilt", 0.05), task[1], 1).scene.robot.data
    assert data.imu_tilt[0, 0, 2].item() == pytest.approx(math.sin(0.05))
    kicked = world(cfg, options.robust, "kick", 0.3)
    assert (kicked.kick, kicked.env) == (0.3, cfg)


def test_a_floor_that_swings_moves_under_a_robot_in_the_air(task):
    """A floor with the acceleration A sin(2πt) has the speed A/π after half a second; a robot in the air does not."""
    options = read_protocol("surfaces")
    changed = world(settings(task[0], options), options.robust, "platform", 2.0)
    still = replace(changed.env, events={})  # The task's random forces would move the robot, too.
    table = in_changed_world(replace(options.robust, episodes=1))
    rollout = Rollout(build(still, task[1], 1), table, options)
    env = rollout.env
    env.reset(1)
    robot, still = env.scene.robot, torch.zeros(2, 6)
    robot.write_root_pose_to_sim(robot.data.default_root_state[:, :7] + torch.tensor([0.0, 0, 5, 0, 0, 0, 0]))
    robot.write_root_velocity_to_sim(still)
    swing = disturbances(rollout, changed)
    assert swing is not None
    for step in range(30):
        swing(step)
        env.step(torch.zeros(2, 6))
    moved = robot.data.root_lin_vel_w[:, :2]
    assert moved.numpy() == pytest.approx(-2.0 / math.pi * np.eye(2), abs=0.02)


@pytest.mark.parametrize("robot", ["article", "explicit"])
def test_the_gains_of_the_drives_rise_evenly_at_a_cold_start(task, robot):
    options = read_protocol("get_up")
    env = compose(["task=stand", f"robot={robot}"]).config["env"]
    table = getting_up(replace(options.get_up, episodes=1))
    made = Rollout(build(settings(env, options, 1), task[1], 1), table, options)
    drives = list(made.env.scene.robot.actuators.values())
    whole, ramp = [drive.damping.clone() for drive in drives], gain_ramp(made, 0.5)
    assert min(float(gain.min()) for gain in whole) > 0.0
    for step in range(40):
        ramp(step)
        for drive, gain in zip(drives, whole, strict=True):
            assert torch.allclose(drive.damping, min(1.0, step / 30) * gain)


@pytest.mark.parametrize("skill", ["height", "jump"])
def test_the_reference_holds_the_height_but_does_not_jump(task, skill):
    small = {"height": {"heights": "[0.0725]", "lin_vel_x": "[0.0]", "horizon_s": 3.0}}
    small["jump"] = {"lin_vel_x": "[0.0]", "at_s": 2.0, "after_s": 2.0, "within_s": 1.5}
    small["jump"] |= {"ang_vel_z": "[0.0]", "delay_s": "[0.0333]", "errors": "false"}
    env = compose([f"task={skill}"]).config["env"]
    found = evaluate(env, task[1], Reference, protocol(skill, *words(skill, episodes=2, **small[skill])), 1)
    assert found.value(f"{skill}/survival") == 1.0
    if skill == "height":
        assert found.value("height/height_rmse/h=0.0725_vx=0") < 0.01
    else:
        assert (found.value("jump/success"), found.value("jump/worst_success")) == (0.0, 0.0)
        assert (found.value("jump/quiet"), found.value("jump/delay/0.0333/survival")) == (1.0, 1.0)
        assert found.value("jump/clearance") < 0.002
        assert found.value("jump/impact") < 0.01  # The drop at the start does not count.


def test_a_payload_adds_to_the_mass_of_the_base(task):
    options = read_protocol("surfaces")
    loaded = world(settings(task[0], options), options.robust, "payload", 0.25)
    masses = build(loaded.env, task[1], 1).scene.sim.expanded["body_mass"]
    assert masses.sum(dim=1).tolist() == pytest.approx([0.75, 0.75], abs=0.031)  # the task's own range is ±0.03 kg


def test_combined_changes_act_at_once(task):
    options = read_protocol("robust")
    cfg = settings(task[0], options)
    both = next(found for found in worlds(cfg, options.robust) if found.sweep == "combined").env
    assert both.observations["policy"].terms["base_ang_vel"]["noise"]["std"] == pytest.approx(0.2)
    assert {tuple(node["delay"]) for node in both.actions.values()} == {(4, 4)}
    assert "evaluation_randomize_imu_errors" in both.events


@pytest.mark.parametrize(("limit", "expected"), [(0.3, 0.3), (2.0, 1.0), (0.0, 0.0)])
def test_a_margin_is_the_largest_survived_change(limit, expected):
    options = read_protocol("robust").robust
    found = margin(lambda value: 1.0 if value <= limit else 0.9, 1.0, options)
    assert expected - 1 / 64 <= found <= expected
    tried: list[float] = []
    margin(lambda value: tried.append(value) or float(value <= limit), 1.0, options, step=0.3)
    assert all(value == pytest.approx(0.3 * round(value / 0.3)) for value in tried)


@pytest.mark.parametrize(
    ("override", "key", "word"),
    [
        ("+protocol.robust.margins.delayy=2", "margins.delayy", "did you mean 'delay_s'"),
        ("protocol.robust.combined.noise=-2", "combined.noise", "out of range"),
        ("+protocol.robust.combined={mass:1.1,payload:0.1}", "combined.payload", "replace the change of mass"),
        ("protocol.robust.horizon_s=2", "horizon_s", "after the kick"),
    ],
)
def test_changes_that_cannot_be_made_are_refused(override, key, word):
    with pytest.raises(ConfigError, match=rf"protocol\.robust\.{key}.*{word}"):
        read_protocol("robust", override)


@pytest.mark.parametrize("variant", ["sensors", "full"])
def test_an_evaluation_removes_the_tasks_realism_unless_the_protocol_includes_it(variant):
    env = compose(["task=stand", f"realism={variant}"]).config["env"]
    for realism, is_ideal in (("none", True), ("own", False)):
        options = read_protocol("stand", f"protocol.realism={realism}")
        cfg = settings(env, options)
        assert (cfg.realism == Realism(), "imu_errors" not in cfg.events) == (is_ideal, is_ideal)


def test_events_within_an_episode_time_outs_rewards_and_curricula_are_gone_and_the_rest_stays(task):
    options = read_protocol("stand")
    cfg = settings(task[0], options, 7, 9.0)
    assert "push_robot" not in cfg.events
    assert {"physics_material", "reset_base"} <= set(cfg.events)
    assert (cfg.rewards, cfg.curriculum, cfg.num_envs, cfg.episode_length_s) == ({}, {}, 7, 9.0)
    terminations = task[0]["terminations"]
    assert terminations["time_out"]["time_out"]
    assert cfg.terminations == {name: node for name, node in terminations.items() if name != "time_out"}
    assert "push_robot" in task[0]["events"]  # The task's config is unchanged.
