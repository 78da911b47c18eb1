"""Apply the advice of each finding, and check that the finding disappears."""

import copy
import json
import re
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import pytest

from lint.cases import CONFIG, FACTS, LEG, WHEEL, case, joints, term
from wheelleg_exp.anatomy.compiled_robot import RobotFacts
from wheelleg_exp.cli.main import main
from wheelleg_exp.config.schema import Experiment
from wheelleg_exp.lint.physics_check import RULES
from wheelleg_exp.lint.rule import Case, Finding
from wheelleg_exp.terms.config_sections import plain_section, read_section
from wheelleg_exp.terms.key_syntax import split_path

# For many of these sizes, rounding to two digits would exceed a bound.
SIZES = (0.1234, 0.3333, 0.5, 0.7777, 0.9949, 1.0, 1.005, 1.2499, 1.449, 1.7321, 2.5001, 3.1416, 6.6666, 9.951)


def robot(x: float = 1.0, **changes: Any) -> RobotFacts:
    """Return the round robot with lengths, efforts, and rates multiplied by ``x``."""
    assert LEG.drive is not None
    assert WHEEL.drive is not None
    leg = replace(LEG, hold=2.0 * x, drive=replace(LEG.drive, effort=8.0 * x))
    wheel = replace(WHEEL, drive=replace(WHEEL.drive, effort=0.4 * x, velocity=20.0 * x))
    balance = replace(FACTS.balance, pole=2.0 * x, pendulum=3.0 * x, height=0.5 * x)
    found = replace(FACTS, balance=balance, standing_height=0.4 * x, mass=x)
    found = replace(found, joints={"hip": leg, "left": wheel, "right": wheel})
    return replace(found, **changes)


def changed_drive(x: float, names: tuple[str, ...], **drive: float) -> RobotFacts:
    found = robot(x)
    joint = found.joints[names[0]]
    joint = replace(joint, drive=replace(joint.drive, **drive))
    return replace(found, joints={**found.joints, **dict.fromkeys(names, joint)})


drives = partial(changed_drive, names=("hip",))
weak = partial(changed_drive, names=("left", "right"))


def act(target: str, *names: str, **settings: Any) -> dict[str, Any]:
    return {"act": term(f"actions.{target}", joint_names=list(names), **settings)}


def track(size: float, std: float, weight: float = 1.0) -> dict[str, Any]:
    ranges = {"lin_vel_x": [-size, size], "lin_vel_y": [0.0, 0.0], "ang_vel_z": [0.0, 0.0]}
    node = term("rewards.track_lin_vel_xy_exp", weight=weight, std=std, command_name="v")
    alive = term("rewards.is_alive", weight=1.0)
    wheels = act("JointVelocityAction", "left", "right", scale=4.0)
    command = term("commands.UniformVelocityCommand", ranges=ranges, rel_standing_envs=0.0)
    return {"commands": {"v": command}, "actions": wheels, "rewards": {"alive": alive, "t": node}}


def reward(name: str, **settings: Any) -> dict[str, Any]:
    return {"rewards": {"alive": term("rewards.is_alive", weight=5.0), "r": term(f"rewards.{name}", **settings)}}


def event(name: str, **settings: Any) -> dict[str, Any]:
    return {"events": {"e": term(f"events.{name}", **{"mode": "reset", **settings})}}


def observed(name: str, corrupt: bool = False, **settings: Any) -> dict[str, Any]:
    group = {"enable_corruption": corrupt, "terms": {"o": term(f"observations.{name}", **settings)}}
    return {"observations": {"policy": group}}


def noise(kind: str, **settings: Any) -> dict[str, Any]:
    return {"_target_": f"wheelleg_exp.mdp.noise.{kind}", **settings}


def push(x: float, share: float) -> dict[str, Any]:
    return event("push_by_setting_velocity", velocity_range={"x": [-share * x, share * x]})


def tilt(limit: float, x: float) -> dict[str, Any]:
    base = event("reset_root_state_uniform", pose_range={"pitch": [-0.1 * x, 0.1 * x]}, velocity_range={})
    return {"terminations": {**TIME_OUT, "t": term("terminations.bad_orientation", limit_angle=limit)}, **base}


TIME_OUT = CONFIG["env"]["terminations"]
STILL = {"force_range": [0.0, 0.0], "torque_range": [0.0, 0.0]}

# Functions that return a case with a finding of the rule, for a robot of size x.
CASES: dict[str, list[Callable[[float], Case]]] = {
    "action_scale": [
        lambda x: case(robot(x), actions=act("JointPositionAction", "hip", scale=5.0 * x)),
        lambda x: case(drives(x, stiffness=1.0), actions=act("JointPositionAction", "hip", scale=30.0 * x)),
        lambda x: case(drives(x, effort=999.0), actions=act("JointPositionAction", "hip", scale=1e-4 * x)),
        lambda x: case(robot(x), actions=act("JointVelocityAction", "left", "right", scale=40.0 * x)),
    ],
    "command_reach": [lambda x: case(robot(x), **track(x * 3.0, 0.1))],
    "contact_threshold": [
        lambda x: case(robot(x), terminations={"c": term("terminations.illegal_contact", threshold=3.0 * x)}),
        lambda x: case(robot(x), **reward("no_contact_count", weight=-1.0, threshold=9.0 * x, sensor_cfg={})),
    ],
    "control_rate": [lambda x: case(robot(x), decimation=60), lambda x: case(robot(30.0 * x), decimation=8)],
    "cumulative_randomisation": [lambda x: case(**event("randomize_rigid_body_com", com_range={"x": [-x, x]}))],
    "discount_horizon": [
        lambda x: case(episode_length_s=3.0 * x, algorithm={"gamma": 0.9999}),
        lambda x: case(robot(x), algorithm={"gamma": 0.5}),
    ],
    "drive_bandwidth": [lambda x: case(drives(x, stiffness=0.01 * x)), lambda x: case(robot(30.0 * x))],
    "effort_against_load": [lambda x: case(drives(x, effort=0.5 * x)), lambda x: case(drives(x, stiffness=0.5 * x))],
    "effort_against_traction": [lambda x: case(replace(robot(40.0), mass=x, friction=0.1))],
    "episode_end": [
        lambda x: case(robot(x), episode_length_s=0.5 / x),
        lambda x: case(robot(x), terminations={
            **TIME_OUT, "h": term("terminations.root_height_below_minimum", minimum_height=x)}),
        lambda x: case(**tilt(0.01 * x, x)), lambda x: case(**tilt(4.0, x)),
    ],
    "event_never_fires": [
        lambda x: case(episode_length_s=x, **event("push_by_adding_velocity", mode="interval",
                                                   interval_range_s=[x, 2 * x], velocity_range={})),
    ],
    "noise_against_signal": [
        lambda x: case(robot(x), **observed("joint_vel", True, noise=noise("UniformNoise", n_min=-99.0 * x))),
        lambda x: case(robot(x), **observed("joint_vel", True, noise=noise("GaussianNoise", std=99.0 * x))),
    ],
    "levels_out_of_reach": [lambda x: case(
        scene={"terrain": {"static_friction": 0.6, "dynamic_friction": 0.4, "size": [30.0 * x, 30.0]}},
        commands={"base_velocity": {"ranges": {"lin_vel_x": [-1.0, 1.0], "lin_vel_y": [0.0, 0.0]}}},
        curriculum={"c": term("curriculums.terrain_levels_vel")})],
    "noop_curriculum": [lambda x: case(**reward("is_alive", weight=1.0), curriculum={
        "c": term("curriculums.modify_reward_weight", term_name="r", weight=2.0, num_steps=999)})],
    "noop_restitution": [
        lambda x: case(**event("randomize_rigid_body_material", restitution_range=[0.0, x],
                               static_friction_range=[0.5, 1.0], dynamic_friction_range=[0.5, 1.0]))
    ],
    "observation_scale": [
        lambda x: case(robot(x), **observed("joint_vel", scale=99.0)),
        lambda x: case(robot(x), **observed("joint_vel", scale=1e-6))],
    "late_average": [lambda x: case(average_iterations=80, max_iterations=round(18 * x))],
    "push_size": [lambda x: case(robot(x), **push(x, 9.0)), lambda x: case(robot(x), **push(1.0 / x, 1e-3))],
    "reward_too_small": [
        lambda x: case(robot(x), **reward("base_height_l2", weight=-0.01, target_height=0.4 * x)),
        lambda x: case(robot(x), **reward("lin_vel_z_l2", weight=-1e-3)),
        lambda x: case(robot(x), **track(x, 0.6 * x, weight=0.01)),
        lambda x: case(robot(x), **reward("joint_deviation_l1", weight=1e-3 * x, asset_cfg=joints("hip"))),
    ],
    "spawn_height": [
        lambda x: case(robot(x, clearance=0.3 * x), robot={"init_state": {"pos": [0.1, 0.0, 1.23456 * x]}}),
        lambda x: case(robot(x, clearance=-0.01 * x), robot={"init_state": {"pos": [0.1, 0.0, 1.23456 * x]}}),
    ],
    "target_height": [lambda x: case(robot(x), **reward("base_height_l2", weight=-1.0, target_height=x))],
    "tracking_std": [lambda x: case(**track(x, 2.0 * x)), lambda x: case(**track(0.0, 2.0 + x))],
    "weak_wheels": [lambda x: case(weak(x, effort=0.01 * x)), lambda x: case(weak(x, velocity=0.5 * x**2))],
    "wrench_size": [
        lambda x: case(robot(x), **event("set_permanent_body_wrench", **{**STILL, "force_range": [-9 * x, 9 * x]})),
        lambda x: case(robot(x), **event("set_permanent_body_wrench", **{**STILL, "torque_range": [0.0, 9 * x]})),
    ],
}  # fmt: skip
# The hints of these rules contain no numbers.
WITHOUT = {
    "reward_outweighs",  # tests/cli/test_doctor.py tests the cost of a weight.
    "action_clip_never_acts", "armature_ratio", "falling_pays", "gains_against_time_step", "noop_joint_reset",
    "cylinder_edges", "ppo_batch", "unbounded_observation", "world_height", "zero_width_range",
    # These rules report defects of a robot file or a pose.
    "assumed_masses", "balance_pose", "contact_at_start", "joint_limits", "link_masses", "lopsided_pose",
    "lost_in_conversion", "mirror_images", "missing_files", "no_colliders", "overlapping_bodies", "placeholder_limits",
    "reset_into_ground", "robot_size", "rolling_direction", "wheel_senses", "wheels_that_do_not_roll",
}  # fmt: skip


def changed(looked_at: Case, advice: Mapping[str, Any]) -> Case:
    """Return the case with changed settings, and with robot facts that follow from the settings."""
    config, facts = copy.deepcopy(plain_section(looked_at.config)), looked_at.facts
    for key, value in advice.items():
        path = split_path(key)
        if path[:3] == ("env", "robot", "actuators"):
            facts = replace(facts, joints={n: _driven(j, path[3], path[4], value) for n, j in facts.joints.items()})
            continue
        if path == ("env", "robot", "init_state", "pos"):
            height = looked_at.env.robot.init_state.pos[2]
            facts = replace(facts, clearance=facts.clearance + value[2] - height)
        node: Any = config
        for part in path[:-1]:
            node = node[part]
        node[path[-1]] = value
    return Case(read_section(Experiment, config, ""), facts)


def _driven(joint: Any, group: str, field: str, value: float) -> Any:
    drive = {"effort_limit": "effort", "velocity_limit": "velocity"}.get(field, field)
    return replace(joint, drive=replace(joint.drive, **{drive: value})) if joint.drive.group == group else joint


def keys(findings: list[Finding]) -> set[tuple[str, str]]:
    return {(finding.rule, finding.key) for finding in findings}


@pytest.mark.parametrize(("rule", "number"), [(name, i) for name in CASES for i in range(len(CASES[name]))])
def test_what_a_rule_recommends_silences_its_finding(rule, number):
    advised = 0
    for size in SIZES:
        looked_at = CASES[rule][number](size)
        findings = RULES[rule](looked_at)
        for finding in findings:
            for advice in finding.advice:
                advised += 1
                after = RULES[rule](changed(looked_at, advice))
                assert (rule, finding.key) not in keys(after), (size, finding.hint, advice)
    assert advised > len(SIZES) // 2, "the case finds nothing, or recommends nothing"


def test_every_rule_recommends_numbers_that_are_tested_here_or_no_numbers():
    assert set(CASES) | WITHOUT == set(RULES)
    assert not set(CASES) & WITHOUT


@pytest.mark.parametrize("rule", CASES)
def test_a_hint_prints_the_recommended_numbers(rule):
    for make in CASES[rule]:
        for finding in RULES[rule](make(1.2499)):
            values = [v for advice in finding.advice for v in advice.values() if isinstance(v, (int, float))]
            for value in values:
                assert isinstance(value, bool) or f"{abs(value):g}" in finding.hint or rule == "noop_curriculum"
            if re.search(r"\d", re.sub(r"reset_\w+|1 %|n²", "", finding.hint)):
                assert finding.advice, finding.hint


def test_all_advice_on_the_stock_task_can_be_written(capsys):
    def findings(*words):
        main(["check", "--physics", "--json", "task=stand", "~check", "~env.robot.silence", *words])
        return json.loads(capsys.readouterr().out)["findings"]

    before = findings()
    # The cost of torques depends on the effort limits, which the advice changes.
    apart = ("init_state", "push", "wheel_torques")
    advised = [f for f in before if f["advice"] and not any(part in f["key"] for part in apart)]
    assert len(advised) > 8
    words = [f"++{key}={value}".replace(" ", "") for f in advised for key, value in f["advice"][0].items()]
    after = {(f["rule"], f["key"]) for f in findings(*words)}
    assert not after & {(f["rule"], f["key"]) for f in advised}
