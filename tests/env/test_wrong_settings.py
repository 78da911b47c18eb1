"""Test that invalid settings of the right type raise ConfigError with their key."""

from __future__ import annotations

import copy

import pytest
import torch
from sim.small_envs import ACTUATORS, PLANE

from env.composed import event, term
from wheelleg_exp.errors import ConfigError

FRICTION = {"static_friction_range": [0.6, 1.2], "dynamic_friction_range": [0.5, 1.0], "restitution_range": [0.0, 0.1]}
MATERIAL = event("randomize_rigid_body_material", "startup", num_buckets=4, **FRICTION)
MASS = event("randomize_rigid_body_mass", "startup", operation="add")
WRENCH = event("set_permanent_body_wrench", "reset", force_range=[-1.0, 1.0], torque_range=[0.0, 0.0])
JOINTS = event("reset_joints_by_scale", "reset", position_range=[1.0, 1.0], velocity_range=[0.0, 0.0])
PUSH = event("push_by_adding_velocity", "interval", velocity_range={})
PLAIN = {"_target_": PLANE, "static_friction": 0.5, "dynamic_friction": 0.5, "restitution": 0.0}
ROBOT = {"_target_": "wheelleg_exp.managers.SceneEntityCfg", "name": "robot"}


def _run(env):
    env.reset()
    env.step(torch.zeros(4, env.action_manager.total_action_dim))


def _refused(make_env, key, **sections):
    with pytest.raises(ConfigError) as caught:
        _run(make_env(**sections))
    assert caught.value.key is not None
    assert caught.value.key.startswith(key)


@pytest.mark.parametrize(
    ("node", "key"),
    [
        (MATERIAL | {"num_buckets": 0}, "num_buckets"),
        (MATERIAL | {"static_friction_range": [2.0, 1.0]}, "static_friction_range"),
        (MASS | {"mass_distribution_params": [1.0]}, "mass_distribution_params"),
        (MASS | {"mass_distribution_params": [2.0, 1.0]}, "mass_distribution_params"),
        (WRENCH | {"force_range": [1.0, -1.0]}, "force_range"),
        (WRENCH | {"torque_range": [1.0]}, "torque_range"),
        (JOINTS | {"position_range": [1.0]}, "position_range"),
        (JOINTS | {"velocity_range": [1.0, 0.0]}, "velocity_range"),
        (PUSH | {"interval_range_s": [-1.0, 1.0]}, "interval_range_s"),
        (JOINTS | {"interval_range_s": [1.0, 2.0]}, "interval_range_s"),
        (PUSH | {"interval_range_s": [1.0, 2.0], "min_step_count_between_reset": 3}, "min_step_count_between_reset"),
    ],
)
def test_events(make_env, node, key):
    _refused(make_env, f"env.events.e.{key}", events={"e": copy.deepcopy(node)})


@pytest.mark.parametrize(
    ("section", "change", "key"),
    [
        ("sim", {"gravity": [0.0, 0.0]}, "env.sim.gravity"),
        ("scene", {"terrain": {"_target_": PLANE, "static_friction": 0.5}}, "env.scene.terrain"),
        ("scene", {"terrain": PLAIN | {"x": 1}}, "env.scene.terrain"),
        ("scene", {"terrain": {"_target_": ACTUATORS + "ImplicitActuator"}}, "env.scene.terrain"),
        ("robot", {"base": "fixed"}, "env.robot.base"),
    ],
)
def test_fixed_sections(make_env, section, change, key):
    _refused(make_env, key, **{section: change})


def test_initial_state(make_env):
    init = {"pos": [0, 0, 1], "rot": [1, 0, 0, 0], "joint_pos": {}, "joint_vel": {}}
    _refused(make_env, "env.robot.init_state", robot={"init_state": init | {"lin_vel": [0, 0, 0]}})
    del init["joint_vel"]
    _refused(make_env, "env.robot.init_state", robot={"init_state": init})


@pytest.mark.parametrize(("key", "value"), [("max_contacts", 0), ("history_length", -1), ("force_threshold", -1.0)])
def test_sensors(make_env, key, value):
    sensor = make_env(num_envs=1).cfg["scene"]["sensors"]["contact"] | {key: value}
    _refused(make_env, "env.scene.sensors.contact", scene={"sensors": {"contact": sensor}})


@pytest.mark.parametrize(
    ("fields", "key"),
    [
        ({"clip": [1.0, -1.0]}, "clip"),
        ({"noise": 0.1}, "noise"),
        ({"modifiers": [{"_target_": "wheelleg_exp.mdp.noise.UniformNoise"}]}, "modifiers"),
    ],
)
def test_observations(make_env, fields, key):
    node = {"_target_": "wheelleg_exp.mdp.observations.joint_pos", **fields}
    groups = {"policy": {"enable_corruption": True, "terms": {"q": node}}}
    _refused(make_env, f"env.observations.policy.terms.q.{key}", observations=groups)


def test_terms_of_a_group_that_do_not_fit_together(make_env):
    kept = {"_target_": "wheelleg_exp.mdp.observations.joint_pos", "history_length": 2, "flatten_history_dim": False}
    terms = {"q": kept, "v": {"_target_": "wheelleg_exp.mdp.observations.joint_vel"}}
    _refused(make_env, "env.observations.policy", observations={"policy": {"terms": terms}})


def test_a_contact_reward_on_what_is_no_contact_sensor(make_env):
    node = term("rewards.undesired_contacts", weight=1.0, threshold=1.0, sensor_cfg=ROBOT)
    _refused(make_env, "env.rewards.r", rewards={"r": node})


def test_left_and_right_of_different_numbers(make_env):
    left, right = ROBOT | {"joint_names": ["left_hip"]}, ROBOT | {"joint_names": ["right_.*"]}
    node = term("rewards.joint_symmetry_l1", weight=1.0, left_cfg=left, right_cfg=right)
    _refused(make_env, "env.rewards.r", rewards={"r": node})
