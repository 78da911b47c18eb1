"""Test that invalid settings of the right type raise ConfigError with their key."""

from __future__ import annotations

import copy
from typing import Any

import pytest
import torch
from sim.small_envs import ACTUATORS, PLANE, env_config

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
MIN_STEPS, VELOCITY = "min_step_count_between_reset", term("observations.joint_vel")
INIT = {"pos": [0, 0, 1], "rot": [1, 0, 0, 0], "joint_pos": {}}
LEFT, RIGHT = ROBOT | {"joint_names": ["left_hip"]}, ROBOT | {"joint_names": ["right_.*"]}
OTHER_SHAPE = term("observations.joint_pos", history_length=2, flatten_history_dim=False)
NO_CONTACTS = term("rewards.undesired_contacts", weight=1.0, threshold=1.0, sensor_cfg=ROBOT)
UNEQUAL_SIDES = term("rewards.joint_symmetry_l1", weight=1.0, left_cfg=LEFT, right_cfg=RIGHT)


def of_event(node: dict[str, Any], key: str) -> tuple[dict[str, Any], str]:
    """Return the sections and the key of an event with a wrong setting."""
    return {"events": {"e": node}}, f"env.events.e.{key}"


def of_sensor(**setting: Any) -> tuple[dict[str, Any], str]:
    """Return the sections and the key of a contact sensor with a wrong setting."""
    sensor = env_config()["scene"]["sensors"]["contact"] | setting
    return {"scene": {"sensors": {"contact": sensor}}}, "env.scene.sensors.contact"


def of_observation(key: str, value: Any) -> tuple[dict[str, Any], str]:
    """Return the sections and the key of an observation with a wrong setting."""
    group = {"enable_corruption": True, "terms": {"q": term("observations.joint_pos", **{key: value})}}
    return {"observations": {"policy": group}}, f"env.observations.policy.terms.q.{key}"


def _run(env):
    env.reset()
    env.step(torch.zeros(4, env.action_manager.total_action_dim))


@pytest.mark.parametrize(
    ("sections", "key"),
    [
        of_event(MATERIAL | {"num_buckets": 0}, "num_buckets"),
        of_event(MATERIAL | {"static_friction_range": [2.0, 1.0]}, "static_friction_range"),
        of_event(MASS | {"mass_distribution_params": [1.0]}, "mass_distribution_params"),
        of_event(MASS | {"mass_distribution_params": [2.0, 1.0]}, "mass_distribution_params"),
        of_event(WRENCH | {"force_range": [1.0, -1.0]}, "force_range"),
        of_event(WRENCH | {"torque_range": [1.0]}, "torque_range"),
        of_event(JOINTS | {"position_range": [1.0]}, "position_range"),
        of_event(JOINTS | {"velocity_range": [1.0, 0.0]}, "velocity_range"),
        of_event(PUSH | {"interval_range_s": [-1.0, 1.0]}, "interval_range_s"),
        of_event(JOINTS | {"interval_range_s": [1.0, 2.0]}, "interval_range_s"),
        of_event(PUSH | {"interval_range_s": [1.0, 2.0], MIN_STEPS: 3}, MIN_STEPS),
        *(({key: value}, f"env.{key}") for key in ("num_envs", "decimation") for value in (0, -1, 2.0, True, "4")),
        *(({"episode_length_s": value}, "env.episode_length_s") for value in (0.0, -1.0, "long", float("nan"))),
        ({"sim": {"gravity": [0.0, 0.0]}}, "env.sim.gravity"),
        ({"scene": {"terrain": {"_target_": PLANE, "static_friction": 0.5}}}, "env.scene.terrain"),
        ({"scene": {"terrain": PLAIN | {"x": 1}}}, "env.scene.terrain"),
        ({"scene": {"terrain": {"_target_": ACTUATORS + "ImplicitActuator"}}}, "env.scene.terrain"),
        ({"robot": {"base": "fixed"}}, "env.robot.base"),
        ({"robot": {"init_state": INIT | {"joint_vel": {}, "lin_vel": [0, 0, 0]}}}, "env.robot.init_state"),
        ({"robot": {"init_state": INIT}}, "env.robot.init_state"),
        of_sensor(max_contacts=0),
        of_sensor(history_length=-1),
        of_sensor(force_threshold=-1.0),
        of_observation("clip", [1.0, -1.0]),
        of_observation("noise", 0.1),
        of_observation("modifiers", [term("noise.UniformNoise")]),
        ({"observations": {"policy": {"terms": {"q": OTHER_SHAPE, "v": VELOCITY}}}}, "env.observations.policy"),
        ({"rewards": {"r": NO_CONTACTS}}, "env.rewards.r"),
        ({"rewards": {"r": UNEQUAL_SIDES}}, "env.rewards.r"),
    ],
)
def test_a_wrong_setting_is_rejected_with_its_key(make_env, sections, key):
    with pytest.raises(ConfigError) as caught:
        _run(make_env(**copy.deepcopy(sections)))
    assert caught.value.key is not None
    assert caught.value.key.startswith(key)
