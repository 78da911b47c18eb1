import inspect
import json
from pathlib import Path

import pytest
from patience import thinned

from wheelleg_exp.cli.main import main
from wheelleg_exp.config.schema import PHYSICS_RULES
from wheelleg_exp.lint.diagnosis import known_by
from wheelleg_exp.lint.physics_check import RULES
from wheelleg_exp.lint.rule import Finding
from wheelleg_exp.paths import configs_dir

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("own_cache")]
TASKS = sorted(path.stem for path in (configs_dir() / "task").glob("*.yaml"))
# The findings that an expert expects in the config of the Isaac Lab project, as rule and key.
AT_LEAST = {
    ("noop_joint_reset", "env.events.reset_robot_joints.velocity_range"),
    ("tracking_std", "env.rewards.track_lin_vel_xy.std"),
    ("armature_ratio", "env.robot.actuators.wheels.armature"),
    ("armature_ratio", "env.robot.actuators.legs.armature"),
    ("effort_against_traction", "env.robot.actuators.wheels.effort_limit"),
    ("event_never_fires", "env.events.push_robot.interval_range_s"),
    ("push_size", "env.events.push_robot.velocity_range"),
    ("reward_too_small", "env.rewards.base_height.weight"),
    ("spawn_height", "env.robot.init_state.pos"),
}


def physics(capsys, *words):
    status = main(["check", "--physics", "--json", *words])
    text = capsys.readouterr().out
    assert "Infinity" not in text
    return status, json.loads(text)


def test_without_its_silences_the_stock_task_has_the_findings_of_an_expert(capsys):
    status, report = physics(capsys, "robot=article", "task=stand", "~check", "~env.robot.silence")
    assert status == 1
    found = {(finding["rule"], finding["key"]): finding for finding in report["findings"]}
    assert set(found) >= AT_LEAST
    wheel = found["armature_ratio", "env.robot.actuators.wheels.armature"]["figures"]
    assert (round(wheel["pitch_ratio"]), round(wheel["translation_kg"])) == (49, 125)
    traction = found["effort_against_traction", "env.robot.actuators.wheels.effort_limit"]["figures"]
    assert traction["slip"] == pytest.approx(0.85 * 0.5 * 9.81 * 0.02 / 2, rel=1e-3)
    assert all(finding["where"] for finding in report["findings"])


@pytest.mark.parametrize("task", thinned(TASKS, 2))
def test_every_finding_on_a_stock_task_is_silenced_with_a_reason(task, capsys):
    status, report = physics(capsys, f"task={task}")
    assert status == 0, report["findings"]
    assert (report["findings"], report["unused_silences"]) == ([], [])
    assert all(len(finding["reason"]) > 20 for finding in report["silenced"])


def test_a_silence_in_a_file_is_not_about_a_value_of_the_user(capsys):
    pushed = "env.events.push_robot.velocity_range.x=[-3,3]"
    _, report = physics(capsys, "task=walk", pushed)
    assert [(f["rule"], f["where"]) for f in report["findings"]] == [("push_size", f"override {pushed}")]
    status, report = physics(capsys, "task=walk", pushed, "++check.silence.push_size=a fall is wanted")
    assert (status, report["findings"]) == (0, [])
    assert "a fall is wanted" in [f["reason"] for f in report["silenced"]]
    _, report = physics(capsys, "task=walk", pushed, "++env.robot.silence.push_size=a fall is wanted")
    assert report["findings"] == []


def test_a_silence_in_a_stock_file_is_not_about_a_value_in_a_file_of_the_user(capsys, tmp_path):
    task = tmp_path / "configs" / "task" / "kicked.yaml"
    task.parent.mkdir(parents=True)
    text = (
        "# @package _global_\ndefaults: [walk, _self_]\nenv: {events: {push_robot: {velocity_range: {x: [-3, 3]}}}}\n"
    )
    task.write_text(text)
    words = ("task=kicked", f"--config-dir={task.parents[1]}")
    _, report = physics(capsys, *words)
    assert [(f["rule"], f["where"]) for f in report["findings"]] == [("push_size", f"{task}:3")]
    task.write_text(text + "check: {silence: {push_size: a fall is wanted}}\n")
    status, report = physics(capsys, *words)
    assert (status, report["findings"]) == (0, [])
    task.write_text(text)
    _, report = physics(capsys, *words, "++env.robot.silence.push_size=null")
    assert [f["rule"] for f in report["findings"]] == ["push_size"]
    task.write_text(text + "check: {silence: {push_size: a fall is wanted}}\n")
    _, report = physics(capsys, *words, "env.events.push_robot.velocity_range.x=[-4,4]")
    assert [f["rule"] for f in report["findings"]] == ["push_size"]


def test_silences_name_a_rule_can_be_removed_and_are_reported_if_they_have_no_effect(capsys):
    wrong = "agent.algorithm.num_mini_batches=7"
    status, report = physics(capsys, wrong, "++check.silence.ppo_batch=rest is dropped")
    assert (status, [f["reason"] for f in report["silenced"] if f["rule"] == "ppo_batch"]) == (0, ["rest is dropped"])
    status, report = physics(capsys, "env.robot.silence.spawn_height=null")  # The robot silences the rule.
    assert (status, {f["rule"] for f in report["findings"]}) == (1, {"spawn_height"})
    assert main(["check", "--physics", "~env.curriculum.lin_vel_z_weight"]) == 0
    assert "check.silence.noop_curriculum silences nothing here" in capsys.readouterr().out


def test_mistakes_come_before_the_numbers(capsys):
    assert main(["check", "--physics", "env.num_envs=0"]) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert "env.num_envs: 0 is out of range" in captured.err


def test_the_text_shows_the_robot_the_rewards_and_each_finding_with_its_place_and_hint(capsys):
    assert main(["check", "--physics", "agent.algorithm.num_mini_batches=7"]) == 1
    text = capsys.readouterr().out
    assert "standing height" in text
    assert "base_height" in text
    assert text[text.index("ppo_batch") :].split("\n\n")[0].splitlines() == [
        "ppo_batch  agent.algorithm.num_mini_batches",
        "    place  override agent.algorithm.num_mini_batches=7",
        "    what   12288 samples in 7 mini-batches of 1755 leave 3 unused",
        "    hint   a number of environments or steps that the mini-batches divide",
    ]
    assert text.splitlines()[-1] == "1 finding, 22 silenced (--all shows them)"


def test_silenced_findings_are_counted_and_shown_with_all(capsys):
    assert main(["check", "--physics"]) == 0
    counted = capsys.readouterr().out
    assert "spawn_height" not in counted
    assert counted.endswith("0 findings, 22 silenced (--all shows them)\n")
    assert main(["check", "--physics", "--all"]) == 0
    told = capsys.readouterr().out
    assert "spawn_height  env.robot.init_state.pos\n" in told
    assert "    silenced  the robot drops by 15 mm, so that the policy first learns to land\n" in told
    assert told.endswith("0 findings, 22 silenced\n")


def test_rules_are_listed_with_one_line_each_and_are_those_of_the_schema(capsys):
    assert list(RULES) == sorted(PHYSICS_RULES)
    assert main(["check", "--list"]) == 0
    lines = [line for line in capsys.readouterr().out.splitlines()[1:] if not line.startswith(" ")]
    assert [line.split()[0] for line in lines] == list(PHYSICS_RULES)
    assert main(["check", "--list", "--json"]) == 0
    assert [row["rule"] for row in json.loads(capsys.readouterr().out)] == list(PHYSICS_RULES)


@pytest.mark.parametrize("name", RULES)
def test_a_rule_gives_its_reasoning_and_its_source_and_has_a_test(name):
    rule = RULES[name]
    assert known_by(Finding("env", "", "", rule=name))
    assert len(rule.text.splitlines()) > 2
    assert len(inspect.getsource(rule.function).splitlines()) < 60
    tests = [path.read_text() for path in Path(__file__).parent.glob("test_rules_*.py")]
    assert any(f'("{name}"' in text for text in tests)
