import json

import pytest

from report.runs import change_manifest, make_run
from wheelleg_exp.files import read_yaml, write_text, write_yaml

pytestmark = pytest.mark.slow


# Each case: the overrides of a run, and expected texts in the section on settings.
CHANGED = {
    "env.rewards.base_height.weight=-30": [
        "2 overrides on the command line: task=stand env.rewards.base_height.weight=-30",
        "env.rewards.base_height.weight -1000.0 -30 override env.rewards.base_height.weight=-30"],
    "~env.events.push_robot": ["env.events.push_robot", "not set override ~env.events.push_robot"],
    "+reward@env.rewards=action_acceleration": [
        "env.rewards.action_acceleration not set",
        "weight: -0.005} override +reward@env.rewards=action_acceleration"],
    "robot=physical": ["env.robot.profile article physical", "robot/physical.yaml:"],
}  # fmt: skip


@pytest.mark.parametrize("override", CHANGED)
def test_a_changed_value_is_shown_with_its_default_and_its_source(page, root, override):
    text = page(make_run(root, [override])).section("settings")
    assert [expected for expected in CHANGED[override] if expected not in text] == []


def test_a_run_without_overrides_differs_in_nothing(page, root):
    run = make_run(root)
    write_text(run.hydra / "overrides.yaml", "[]\n")
    text = page(run).section("settings")
    assert "Nothing was changed on the command line." in text
    assert "the task's current default" in text


def test_values_that_the_configs_no_longer_have_are_from_the_configs_at_the_time_of_the_run(page, root):
    run = make_run(root)
    file = run.params / "agent.yaml"
    write_yaml(file, {**read_yaml(file), "save_interval": 7})
    assert "agent.save_interval 50 7 the configs at the time of the run" in page(run).section("settings")
    run = make_run(root, ["env.rewards.base_height.weight=-30"])
    write_text(run.hydra / "overrides.yaml", json.dumps(["env.rewards.gone.weight=1"]))
    text = page(run).section("settings")
    assert "env.rewards.base_height.weight -1000.0 -30 the configs at the time of the run" in text


def test_values_of_the_users_own_files_are_listed(page, root, tmp_path):
    configs = tmp_path / "mine" / "configs"
    write_text(configs / "task" / "mine.yaml", "# @package _global_\ndefaults: [stand, _self_]\nenv: {decimation: 4}\n")
    run = make_run(root, ["task=mine"], config_dirs=(configs,))
    text = page(run).section("settings")
    expected = ("1 value set by files outside the stock configs", "env.decimation 4", "task/mine.yaml:3")
    assert [part for part in (*expected, "the task's current default") if part not in text] == []


def test_the_overrides_of_a_task_that_is_missing_here_are_shown(page, root):
    run = make_run(root, ["env.rewards.base_height.weight=-30"])
    file = run.hydra / "hydra.yaml"
    write_text(file, file.read_text().replace("task: stand", "task: theirs"))
    change_manifest(run, task="theirs")
    text = page(run).section("settings")
    assert "env.rewards.base_height.weight=-30" in text
    assert "The task cannot be composed here" in text
