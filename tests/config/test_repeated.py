from pathlib import Path

import pytest

from wheelleg_exp.config.checking.find_mistakes import check
from wheelleg_exp.config.composing.compose import compose
from wheelleg_exp.errors import ConfigError

HEAD = "# @package _global_\n# A child.\n"


def _errors(*words: str, folder: Path | None = None) -> list[ConfigError]:
    return check(compose(words, config_dirs=[folder] if folder else []))


def _task(folder: Path, name: str, text: str) -> None:
    (folder / "task").mkdir(exist_ok=True)
    (folder / "task" / f"{name}.yaml").write_text(f"{HEAD}{text}task: {{name: {name}}}\n", encoding="utf-8")


@pytest.mark.parametrize(
    ("words", "key"),
    [
        ("event@env.events=[push_robot,reset_base,push_robot]", "env.events.push_robot"),
        ("+reward@env.rewards=alive", "env.rewards.alive"),
        ("observation@env.observations.policy.terms=[last_action,base_ang_vel,base_ang_vel]",
         "env.observations.policy.terms.base_ang_vel"),
    ],
)  # fmt: skip
def test_a_term_that_is_listed_twice_is_errors(words, key):
    (error,) = _errors("task=stand", words)
    assert (error.key, error.where) == (key, f"override {words}")


@pytest.mark.parametrize(
    ("entry", "key"),
    [
        ("/reward@env.rewards: [alive]", "env.rewards.alive"),
        ("override /event@env.events: [reset_base, push_robot, push_robot]", "env.events.push_robot"),
    ],
)
def test_a_term_that_a_child_lists_again_is_reported_with_its_line(tmp_path, entry, key):
    _task(tmp_path, "again", f"defaults:\n  - stand\n  - {entry}\n  - _self_\n")
    (error,) = _errors("task=again", folder=tmp_path)
    assert (error.key, str(error.where).endswith("task/again.yaml:5")) == (key, True)


def test_a_term_that_was_taken_out_may_be_listed_again(tmp_path):
    _task(tmp_path, "without", "defaults: [stand, _self_]\nenv: {rewards: {alive: null}}\n")
    _task(tmp_path, "again", "defaults: [without, /reward@env.rewards: [alive], _self_]\n")
    assert _errors("task=again", folder=tmp_path) == []


A = "wheelleg_exp.mdp.actions."


@pytest.mark.parametrize("kind", ["JointPosition", "RelativeJointPosition", "JointVelocity", "JointEffort"])
def test_a_joint_whose_position_target_two_actions_set_is_reported(kind):
    errors = _errors("task=stand", f"+env.actions.again={{_target_: {A}{kind}Action, joint_names: [l01]}}")
    expected = [("env.actions.again.joint_names", True)] if "Position" in kind else []
    driven = "joint 'l01' is driven by both 'leg_pos' and 'again'"
    assert [(error.key, driven in error.message) for error in errors] == expected


def test_building_such_actions_is_refused_with_the_same_message(make_env):
    node = {"_target_": A + "JointPositionAction", "joint_names": [".*_hip"]}
    with pytest.raises(ConfigError) as caught:
        make_env(actions={"hips": node, "again": node})
    message = "joint 'left_hip' is driven by both 'hips' and 'again'"
    assert (caught.value.key, caught.value.message) == ("env.actions.again.joint_names", message)


def test_a_drive_without_a_number_for_one_of_its_joints_is_errors(tmp_path):
    _task(tmp_path, "gap", 'defaults: [stand, _self_]\nenv: {robot: {actuators: {legs: {damping: {".*01$": 0.3}}}}}\n')
    (error,) = _errors("task=gap", folder=tmp_path)
    assert (error.key, error.message) == ("env.robot.actuators.legs.damping", "no value for joint l02, r02")
