"""Test the reference controller against results of an independent simulation and against closed forms."""

import math

import numpy as np
import pytest
import torch

from evaluation.conftest import protocol
from wheelleg_exp.build import prepare_asset
from wheelleg_exp.config.composing.compose import compose
from wheelleg_exp.env import ManagerBasedRLEnv
from wheelleg_exp.errors import ConfigError
from wheelleg_exp.evaluation.disturbance_tests import tiles
from wheelleg_exp.evaluation.lqr_balancer import Pendulum, Plant, Reference, pendulum_of
from wheelleg_exp.evaluation.protocol_options import Terrain

SECONDS, STEP_AT, KICK_AT = 11.0, 3.0, 4.0
COMMANDS = (0.0, 0.1, 0.3, 0.8, 0.3, 0.0, 0.0, 0.0)  # m/s, from STEP_AT on
TURNS = (0.0, 0.0, 0.0, 0.0, 0.5, 0.5, 0.0, 0.0)  # rad/s
KICKS = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.28, 0.36)  # m/s, forwards, at KICK_AT


def stock_env(*overrides: str, num_envs: int = 1, terrain: object = None) -> ManagerBasedRLEnv:
    config = compose(["task=stand", f"env.num_envs={num_envs}", "env.sim.nthread=1", *overrides]).config
    options = {**config["env"], "events": {}, "episode_length_s": 60.0}
    if terrain is not None:
        options["scene"] = {**options["scene"], "terrain": terrain}
    env = ManagerBasedRLEnv(options, prepare_asset(config).output, 0)
    env.autoreset = "disabled"
    return env


@pytest.fixture(scope="module")
def rolled():
    """Return time series (T, 8) of eight robots that stand, drive, turn, or are pushed."""
    env = stock_env(num_envs=len(COMMANDS))
    policy, data = Reference(env), env.scene.robot.data
    env.reset(0)
    held = env.command_manager.get_term("base_velocity").command
    columns = {name: [] for name in ("z", "pitch", "vx", "wz", "tilt", "x", "axle")}
    for step in range(round(SECONDS / env.step_dt)):
        if step == round(KICK_AT / env.step_dt):
            env.scene.sim.view("qvel")[:, 0] += torch.tensor(KICKS, dtype=env.scene.sim.dtype)
            data.invalidate()
        env.step(policy())
        if step + 1 >= round(STEP_AT / env.step_dt):  # The task also draws zero commands.
            held[:, 0], held[:, 2] = torch.tensor(COMMANDS), torch.tensor(TURNS)
        gravity = data.projected_gravity_b
        columns["z"].append(data.root_pos_w[:, 2])
        columns["x"].append(data.root_pos_w[:, 0])
        columns["pitch"].append(torch.atan2(gravity[:, 0], -gravity[:, 2]))
        columns["tilt"].append(torch.acos((-gravity[:, 2]).clamp(-1, 1)))
        columns["vx"].append(data.root_lin_vel_b[:, 0])
        columns["axle"].append(0.02 * (data.joint_vel[:, 4:].mean(dim=1) + data.root_ang_vel_b[:, 1]))  # rolling
        columns["wz"].append(data.root_ang_vel_b[:, 2])
    return {name: torch.stack(rows).double() for name, rows in columns.items()} | {"dt": env.step_dt}


def after(rolled, seconds: float) -> int:
    return round(seconds / rolled["dt"])


def rms(values: torch.Tensor) -> float:
    return float(values.square().mean().sqrt())


def test_the_model_is_the_robot_that_was_authored():
    pendulum, _ = pendulum_of(stock_env())
    assert pendulum.mass == pytest.approx(0.38)
    assert pendulum.height == pytest.approx(0.0441, abs=1e-4)
    assert pendulum.inertia == pytest.approx(1.03e-3, rel=0.01)
    assert pendulum.rolling == pytest.approx(0.12 + 2 * 1.2e-5 / 0.02**2, rel=1e-3)
    assert pendulum.track == pytest.approx(0.112)
    assert pendulum.pole == pytest.approx(9.25, abs=0.01)
    assert abs(pendulum.lean) < 1e-3


@pytest.mark.parametrize("profile", ["article", "physical"])
def test_the_linear_model_is_the_answer_of_the_simulated_robot(profile):
    env = stock_env(f"robot={profile}", num_envs=2)
    policy, data = Reference(env), env.scene.robot.data
    a, b = Plant(env, *pendulum_of(env)).linear()
    assert max(np.log(np.abs(np.linalg.eigvals(a)))) / env.step_dt == pytest.approx(policy.pendulum.pole, rel=0.2)
    env.reset(0)
    for _ in range(round(3.0 / env.step_dt)):
        env.step(policy())
    before = torch.stack((data.root_ang_vel_b[:, 1], data.joint_vel[:, 4:].mean(dim=1)))
    env.step(policy._actions(data.joint_vel[:, 4:] + torch.tensor([[0.5], [-0.5]])))
    after = torch.stack((data.root_ang_vel_b[:, 1], data.joint_vel[:, 4:].mean(dim=1)))
    rate, spin = ((after - before)[:, 0] - (after - before)[:, 1]).tolist()
    assert (0.02 * (spin + rate), rate) == (pytest.approx(b[2, 0], rel=0.03), pytest.approx(b[3, 0], rel=0.03))


@pytest.mark.parametrize("kinds", [("slope",), ("stairs_inverted",), ("slope", "stairs", "rough")])
def test_the_gains_do_not_depend_on_the_shape_of_the_ground(kinds):
    options = Terrain(**protocol("terrain")["terrain"])
    parts = options.scene["terrain"]["sub_terrains"]
    options.scene["terrain"]["sub_terrains"] = {name: node for name, node in parts.items() if name in kinds}
    level, hilly = stock_env(), stock_env(terrain=tiles(options, seed=3))
    assert Reference(hilly).gains == pytest.approx(Reference(level).gains, rel=1e-3)


def test_drives_without_gains_are_rejected():
    env = stock_env("robot=explicit")
    env.scene.robot.data.default_joint_damping.fill_(math.nan)
    with pytest.raises(ConfigError, match="'l01' has no stiffness and damping"):
        Reference(env)


def test_the_pendulum_is_one_on_weightless_wheels():
    pendulum = Pendulum(1.0, 0.5, 0.0, 0.25, 0.0, 1e-9, 0.1, 9.81)
    assert pendulum.pole == pytest.approx(math.sqrt(9.81 / 0.5), rel=1e-6)
    pendulum = Pendulum(0.38, 0.0441, 0.0, 1.03e-3, 0.18, 0.02, 0.112, 9.81)
    assert pendulum.pole == pytest.approx(9.25, abs=0.02)
    assert pendulum.tilt < 0  # Accelerating wheels push the body back.


@pytest.mark.parametrize(("profile", "survived", "too_hard"), [("article", 0.36, 0.40), ("physical", 0.76, 0.82)])
def test_it_survives_kicks_of_the_measured_size(profile, survived, too_hard):
    env = stock_env(f"robot={profile}", num_envs=2)
    policy, data = Reference(env), env.scene.robot.data
    env.reset(0)
    for step in range(round(4.0 / env.step_dt)):
        if step == round(2.0 / env.step_dt):
            env.scene.sim.view("qvel")[:, 0] += torch.tensor([survived, too_hard], dtype=env.scene.sim.dtype)
            data.invalidate()
        env.step(policy())
    assert (data.projected_gravity_b[:, 2] < -0.9).tolist() == [True, False]


def test_it_stands_still_as_measured_and_returns_to_its_place_after_a_kick(rolled):
    begin = after(rolled, 5.0)
    height, pitch = rolled["z"][begin:, 0], rolled["pitch"][begin:, 0]
    assert rms(height - 0.07) < 1.1e-3
    assert float(pitch.mean()) == pytest.approx(math.radians(0.77), abs=math.radians(0.03))
    assert float(pitch.std()) < 1e-4
    settled = rolled["x"][begin:, 0]
    assert float(settled.max() - settled.min()) < 1e-4
    moved = rolled["x"][:, [0, 6]] - rolled["x"][0, [0, 6]]
    assert float(moved[-1].abs().max()) < 1.5e-3
    assert float(moved[:, 0].abs().max()) < 0.02


def test_a_wrench_leaves_no_offset_once_it_leans_against_it():
    env = stock_env(num_envs=3)
    policy, data = Reference(env), env.scene.robot.data
    env.reset(0)
    wrench = torch.zeros(3, 1, 6)
    wrench[:, 0, 0], wrench[2, 0, 4] = torch.tensor([0.2, -0.2, 0.0]), 0.005  # N, N·m
    env.scene.robot.set_permanent_wrench(torch.arange(3), [0], wrench.unsqueeze(1))
    begin = data.root_pos_w[:, 0].clone()
    for _ in range(round(5.0 / env.step_dt)):
        env.step(policy())
    assert (data.root_pos_w[:, 0] - begin).abs().max() < 6e-3  # The lean moves the base over the axle.
    assert data.projected_gravity_b[:, 0].std() > 0.01  # The robots lean differently.


@pytest.mark.parametrize(("env_id", "most"), [(1, 0.0022), (2, 0.0065)])
def test_it_tracks_as_was_measured(rolled, env_id, most):
    begin = after(rolled, STEP_AT + 3.0)
    assert rms(rolled["vx"][begin:, env_id] - COMMANDS[env_id]) < most


def test_a_step_of_the_command_first_moves_it_the_other_way_and_overshoots(rolled):
    begin, dt = after(rolled, STEP_AT), rolled["dt"]
    speed = rolled["axle"][begin:, 2]
    assert -0.08 < float(speed.min()) < -0.02
    assert float(speed.max()) == pytest.approx(0.385, abs=0.02)
    outside = ((speed - 0.3).abs() > 0.03).nonzero().max()
    assert float(outside) * dt == pytest.approx(0.9, abs=0.3)
    assert not (rolled["tilt"] > 1.0).any()  # A step of 0.8 m/s is limited to an acceleration that it can follow.


def test_it_turns_at_the_speed_that_is_asked_for_while_it_drives_and_on_the_spot(rolled):
    begin = after(rolled, STEP_AT + 3.0)
    assert rms(rolled["wz"][begin:, 4] - 0.5) < 0.02
    assert rms(rolled["wz"][begin:, 5] - 0.5) < 0.02
    assert rms(rolled["vx"][begin:, 4] - 0.3) < 0.01


def test_actions_become_the_targets_that_it_wants_whatever_their_scale_is():
    scaled = "env.actions.wheel_vel.scale=2.5"
    policies = [Reference(stock_env()), Reference(stock_env(scaled))]
    wheels = [policy()[:, 4:] for policy in policies]
    assert torch.allclose(wheels[0] * 5.0, wheels[1] * 2.5)
    assert not policies[0]()[:, :4].any()  # The legs stay at their default positions.


def test_actions_without_wheel_speeds_and_robots_that_do_not_balance_are_rejected(make_env):
    env = stock_env("action@env.actions=[leg_pos]")
    with pytest.raises(ConfigError, match="sets wheel speeds"):
        Reference(env)
    with pytest.raises(ConfigError, match="one axle"):
        pendulum_of(make_env("arm"))
