import math

import numpy as np
import pytest
import torch
from sim.small_envs import ACTUATORS, physics_step, run, wheel_env

from mdp.nodes import event, joints

ALL = torch.arange(4)


@pytest.fixture
def wheel(tmp_path):
    def make(model="ImplicitActuator", gains=(0.0, 0.0), limited="", /, **events):
        drive = {"_target_": ACTUATORS + model, "stiffness": gains[0], "damping": gains[1]}
        drive |= {"effort_limit": 100.0, "velocity_limit": 100.0}
        env = wheel_env(tmp_path, drive, limited, events=events)
        env.reset()
        return env

    return make


def turn(env, steps):
    physics_step(env, steps)
    data = env.scene.robot.data
    return data.joint_pos[:, 0].clone(), data.joint_vel[:, 0].clone()


@pytest.mark.parametrize("model", ["ImplicitActuator", "IdealPDActuator"])
def test_each_environments_drive_acts_with_its_own_gains(wheel, model):
    """A speed servo reaches its target with the time constant I / kd."""
    ranges = {"damping_distribution_params": [0.05, 0.4], "operation": "abs"}
    env = wheel(model, (0.0, 0.1), gains=event("randomize_actuator_gains", **ranges))
    damping = env.scene.robot.actuators["a"].damping[:, 0]
    assert len(damping.unique()) == 4
    assert ((damping >= 0.05) & (damping <= 0.4)).all()
    env.scene.robot.set_joint_velocity_target(torch.full((4, 1), 3.0))
    _, speed = turn(env, 30)
    torch.testing.assert_close(speed, 3.0 * (1 - torch.exp(-0.03 * damping / 0.01)), rtol=0.03, atol=0.0)
    in_solver = damping if model == "ImplicitActuator" else torch.zeros(4)
    torch.testing.assert_close(env.scene.robot.data.joint_damping[:, 0], in_solver)


def test_gains_are_drawn_from_the_configs_for_the_configured_joints(make_env):
    ranges = {"stiffness_distribution_params": [0.5, 2.0], "damping_distribution_params": [1.5, 1.5]}
    fields = {"mode": "custom", "operation": "scale", "asset_cfg": joints("left_.*")}
    env = make_env(events={"g": event("randomize_actuator_gains", **ranges, **fields)}, num_envs=50)
    for _ in range(2):
        env.apply_event("custom", torch.arange(1, 50))
    data = env.scene.robot.data
    left = [data.joint_names.index(n) for n in ("left_hip", "left_axle")]
    right = [data.joint_names.index(n) for n in ("right_hip", "right_axle")]
    stiffness, damping = data.joint_stiffness, data.joint_damping
    drawn = stiffness[1:, left[0]]
    assert ((drawn >= 10.0) & (drawn <= 40.0)).all()
    assert len(drawn.unique()) == 49
    assert (stiffness[:, left[1]] == 0).all()
    assert damping[1:, left].tolist() == [[1.5, 0.75]] * 49
    assert torch.equal(stiffness[:, right], data.default_joint_stiffness[:, right])
    assert torch.equal(damping[0], data.default_joint_damping[0])
    bias = env.scene.sim.expanded["actuator_biasprm"]
    model = env.scene.model
    assert bias[3, model.actuator("left_hip").id, 1] == pytest.approx(-stiffness[3, left[0]].item())
    assert bias[3, model.actuator("right_hip").id, :3].tolist() == [0, -20, -1]
    assert bias[0].tolist() == model.actuator_biasprm.tolist()


@pytest.mark.parametrize(
    ("name", "parameters", "members"),
    [
        ("randomize_actuator_gains", ["damping"], ["joint_damping"]),
        (
            "randomize_joint_parameters",
            ["friction", "armature"],
            ["joint_friction_coeff", "joint_viscous_friction_coeff", "joint_armature"],
        ),
    ],
)
def test_parameters_do_not_fall_below_0(make_env, name, parameters, members):
    ranges = {f"{parameter}_distribution_params": [-5.0, -5.0] for parameter in parameters}
    data = make_env(events={"p": event(name, operation="add", **ranges)}).scene.robot.data
    for member in members:
        assert (getattr(data, member) == 0).all()


def test_friction_stops_a_wheel_and_viscous_friction_slows_it(wheel):
    """The speed follows I dw/dt = -friction - viscous w, from 5 rad/s."""
    ranges = {"friction_distribution_params": [0.02, 0.08], "operation": "abs"}
    env = wheel(joints=event("randomize_joint_parameters", **ranges))
    data = env.scene.robot.data
    friction, viscous = data.joint_friction_coeff[:, 0], data.joint_viscous_friction_coeff[:, 0]
    for drawn in (friction, viscous):
        assert len(drawn.unique()) == 4
        assert ((drawn >= 0.02) & (drawn <= 0.08)).all()
    assert not torch.equal(friction, viscous)
    env.scene.robot.write_joint_state_to_sim(torch.zeros(4, 1), torch.full((4, 1), 5.0))
    data.invalidate()
    _, speed = turn(env, 100)
    expected = (5.0 + friction / viscous) * torch.exp(-0.1 * viscous / 0.01) - friction / viscous
    torch.testing.assert_close(speed, expected, rtol=0.03, atol=0.0)


def test_an_armature_acts_like_inertia(wheel):
    ranges = {"armature_distribution_params": [0.01, 0.05], "operation": "add"}
    env = wheel(joints=event("randomize_joint_parameters", **ranges))
    armature = env.scene.robot.data.joint_armature[:, 0]
    assert len(armature.unique()) == 4
    env.scene.robot.set_joint_effort_target(torch.full((4, 1), 0.3))
    _, speed = turn(env, 50)
    torch.testing.assert_close(speed, 0.3 * 0.05 / (0.01 + armature), rtol=1e-4, atol=0.0)


LIMITS = {"lower_limit_distribution_params": [-0.6, -0.2], "upper_limit_distribution_params": [0.1, 0.4]}


@pytest.mark.parametrize("limited", ["", "limited='true' range='-2 2'"])
def test_a_joint_stops_at_its_own_limit(wheel, limited):
    env = wheel("ImplicitActuator", (0.0, 0.1), limited, limits=event("randomize_joint_parameters", **LIMITS))
    limits = env.scene.robot.data.joint_pos_limits[:, 0]
    assert ((limits[:, 0] >= -0.6) & (limits[:, 0] <= -0.2)).all()
    assert ((limits[:, 1] >= 0.1) & (limits[:, 1] <= 0.4)).all()
    for effort, column in ((0.5, 1), (-0.5, 0)):
        env.scene.robot.set_joint_effort_target(torch.full((4, 1), effort))
        reached, _ = turn(env, 1000)
        torch.testing.assert_close(reached, limits[:, column], atol=0.02, rtol=0.0)


def test_soft_limits_and_defaults_follow_the_limits(make_env):
    ranges = {"lower_limit_distribution_params": [0.5, 0.6], "upper_limit_distribution_params": [0.1, 0.2]}
    node = event("randomize_joint_parameters", **ranges, operation="add", asset_cfg=joints(".*_hip"))
    data = make_env(events={"l": node}, robot={"soft_joint_pos_limit_factor": 0.5}).scene.robot.data
    hips = [data.joint_names.index(n) for n in ("left_hip", "right_hip")]
    axles = [data.joint_names.index(n) for n in ("left_axle", "right_axle")]
    before, now = data.default_joint_pos_limits[:, hips], data.joint_pos_limits[:, hips]
    assert ((now[..., 0] - before[..., 0] >= 0.5) & (now[..., 0] - before[..., 0] <= 0.6)).all()
    assert ((now[..., 1] - before[..., 1] >= 0.1) & (now[..., 1] - before[..., 1] <= 0.2 + 1e-6)).all()
    middle, half = now.mean(dim=2), (now[..., 1] - now[..., 0]) / 4
    torch.testing.assert_close(data.soft_joint_pos_limits[:, hips], torch.stack((middle - half, middle + half), dim=2))
    assert torch.equal(data.joint_pos_limits[:, axles], data.default_joint_pos_limits[:, axles])
    assert torch.equal(data.soft_joint_pos_limits[:, axles], data.default_joint_pos_limits[:, axles])


def test_defaults_are_clamped_to_the_limits(wheel):
    ranges = {"lower_limit_distribution_params": [0.2, 0.3], "upper_limit_distribution_params": [0.4, 0.5]}
    data = wheel(joints=event("randomize_joint_parameters", **ranges, operation="abs")).scene.robot.data
    assert torch.equal(data.default_joint_pos, data.joint_pos_limits[..., 0])


@pytest.mark.parametrize("model", ["ImplicitActuator", "IdealPDActuator"])
def test_effort_limits_by_environment_limit_the_torque(wheel, model):
    env = wheel(model, (0.0, 0.0))
    limits = torch.tensor([[0.1], [0.2], [math.inf], [0.4]])
    env.scene.robot.write_joint_effort_limit_to_sim(limits)
    env.scene.robot.set_joint_effort_target(torch.full((4, 1), 50.0))
    _, speed = turn(env, 10)
    torch.testing.assert_close(speed, torch.tensor([0.1, 0.2, 50.0, 0.4]) * 0.01 / 0.01, rtol=1e-4, atol=0.0)
    assert torch.equal(env.scene.robot.data.joint_effort_limits, limits)
    assert all(field.isfinite().all() for field in env.scene.sim.expanded.values())


def test_velocity_limits_by_environment_clip_targets(wheel):
    env = wheel("ImplicitActuator", (0.0, 1.0))
    limits = torch.tensor([[1.0], [2.0], [3.0], [4.0]])
    env.scene.robot.write_joint_velocity_limit_to_sim(limits)
    env.scene.robot.set_joint_velocity_target(torch.full((4, 1), 9.0))
    assert torch.equal(env.scene.robot.targets.vel, limits)


@pytest.mark.parametrize("model", ["ImplicitActuator", "IdealPDActuator"])
def test_a_drive_holds_the_position_that_its_encoder_reads(make_env, start_env, model):
    groups = make_env("arm").cfg["robot"]["actuators"]
    groups["all"] |= {"_target_": ACTUATORS + model, "stiffness": 50.0, "damping": 2.0, "effort_limit": 100.0}
    read = {"_target_": "wheelleg_exp.mdp.observations.joint_pos_rel"}
    terms = {"read": read, "true": read | {"measured": False}}
    bias = event("randomize_encoder_bias", "reset", bias_range=[-0.05, 0.05])
    events = {"to_default": event("reset_scene_to_default", "reset"), "bias": bias}
    sections = {"robot": {"actuators": groups}, "sim": {"gravity": [0.0, 0.0, 0.0]}, "events": events}
    env = start_env("arm", observations={"policy": {"terms": terms}}, **sections)
    data = env.scene.robot.data
    bias = data.encoder_bias.clone()
    assert len(bias.unique()) == 8
    assert bias.abs().max() <= 0.05
    obs, *_ = run(env, 99, -0.05)
    torch.testing.assert_close(data.joint_pos + bias, data.joint_pos_target, atol=2e-3, rtol=0.0)
    torch.testing.assert_close(obs["policy"][:, :2] - obs["policy"][:, 2:], bias, atol=1e-6, rtol=0.0)
    torch.testing.assert_close(obs["policy"][:, 2:], data.joint_pos - data.default_joint_pos)
    assert data.computed_torque.abs().max() < 0.2


def test_a_bias_is_drawn_for_the_environments_that_reset(start_env):
    node = event("randomize_encoder_bias", "reset", bias_range=[0.1, 0.2], asset_cfg=joints(".*_hip"))
    env = start_env(events={"b": node})
    bias = env.scene.robot.data.encoder_bias
    before = bias.clone()
    env.reset(env_ids=torch.tensor([2]))
    assert (bias != before).any(dim=1).tolist() == [False, False, True, False]
    assert (bias[:, [env.scene.robot.joint_names.index(n) for n in ("left_axle", "right_axle")]] == 0).all()
    assert np.isfinite(bias.numpy()).all()
