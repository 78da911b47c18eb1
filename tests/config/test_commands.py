from __future__ import annotations

import json

import pytest
import yaml

from wheelleg_exp.cli.main import main

pytestmark = pytest.mark.usefixtures("stock")


@pytest.mark.parametrize(
    ("words", "find", "expected"),
    [
        ("compose task=walk", lambda t: (t["env"]["num_envs"], t["env"]["rewards"]["alive"]), ("${seed}", None)),
        ("compose task=walk seed=4 --resolve", lambda tree: tree["env"]["num_envs"], 4),
        ("compose --package env.rewards --json", list, ["alive", "height"]),
        ("compose --package env.decimation", lambda value: value, 2),
        ("compose --provenance --json --package seed", lambda tree: tree["seed"]["where"], "configs/train.yaml:7"),
        ("list --json", lambda rows: [row["task"] for row in rows], ["stand", "walk"]),
        ("list runs --json", list, []),
    ],
)
def test_a_command_prints_yaml_or_json(words, find, expected, capsys):
    assert main(words.split()) == 0
    assert find(yaml.safe_load(capsys.readouterr().out)) == expected


@pytest.mark.parametrize(
    ("words", "nearest"),
    [("compose --package env.reward", "env.rewards"), ("list task", "tasks"), ("list terms rewrd", "reward")],
)
def test_an_unknown_word_is_reported_with_the_nearest(words, nearest, capsys):
    assert main(words.split()) == 2
    assert f"did you mean '{nearest}'" in capsys.readouterr().err


def test_compose_reports_where_leaves_come_from(capsys):
    key = "env.rewards.height.weight"
    assert main(["compose", "--provenance", "--package", key, f"{key}=1"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == f"{key}: 1  # override {key}=1"
    assert lines[1].endswith("-50.0 (configs/task/stand.yaml:23)")


def test_list_tasks_with_a_users_folder(capsys, user):
    assert main(["list", "tasks", "--config-dir", str(user)]) == 0
    text = capsys.readouterr().out
    assert "hop" in text
    assert "Stand still." in text


def test_list_terms_groups_and_options(capsys):
    assert main(["list", "terms", "reward"]) == 0
    assert "One while the robot is up." in capsys.readouterr().out
    assert main(["list", "groups"]) == 0
    assert "reward" in capsys.readouterr().out.split()
    assert main(["list", "options", "robot"]) == 0
    assert "physical" in capsys.readouterr().out


def test_list_terms_holds_those_that_no_file_uses(capsys):
    assert main(["list", "terms", "--json"]) == 0
    rows = {(row["group"], row["term"]): row for row in json.loads(capsys.readouterr().out)}
    height = rows["reward", "height"]
    assert height["takes"] == "target_height, sensor=None"
    assert height["file"].endswith("configs/reward/height.yaml")
    unused = rows["reward", "base_height_l2"]
    assert (unused["file"], unused["target"]) == (None, "wheelleg_exp.mdp.rewards.base_height_l2")
    assert (unused["takes"], unused["help"][:14]) == ("target_height, asset_cfg=..., sensor_cfg=None", "(z - target)^2")
    sections = {group for group, _ in rows}
    assert sections == {"action", "command", "observation", "event", "reward", "termination", "curriculum", "recorder"}


def test_list_terms_leaves_helpers_and_bases_out(capsys):
    assert main(["list", "terms", "--json"]) == 0
    names = {row["term"] for row in json.loads(capsys.readouterr().out)}
    assert {"JointEffortAction", "is_terminated_term", "reset_scene_to_default"} <= names
    assert not names & {"draw", "operate", "all_ids", "JointAction", "ActionTerm", "Sequence", "SceneEntityCfg"}


def test_list_terms_of_a_section_takes_both_of_its_names(capsys):
    assert main(["list", "terms", "reward", "--json"]) == 0
    one = capsys.readouterr().out
    assert main(["list", "terms", "rewards", "--json"]) == 0
    assert capsys.readouterr().out == one


def test_list_runs_of_a_folder_that_is_not_there_is_told(capsys, tmp_path):
    (tmp_path / "runs").mkdir()
    assert main(["list", "runs", "--root", str(tmp_path / "rnus")]) == 2
    told = capsys.readouterr().err
    assert "--root" in told
    assert f"did you mean '{tmp_path / 'runs'}'" in told


def test_a_damaged_run_without_a_date_has_a_dash(capsys, tmp_path):
    folder = tmp_path / "runs" / "stand" / "nameless"
    folder.mkdir(parents=True)
    (folder / "manifest.json").write_text("{")
    assert main(["list", "runs"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[1].split() == ["nameless", "stand", "damaged", *"-" * (len(lines[0].split()) - 3)]
    assert lines[2].startswith("nameless: ")
    assert main(["list", "runs", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)[0]["started"] is None


def test_provenance_tells_what_overrides_removed(capsys):
    words = ["compose", "--provenance", "--package", "env.events.push.mode", "~env.events.push"]
    assert main(words) == 0
    assert capsys.readouterr().out.splitlines() == [
        "# env.events.push.mode: removed  # override ~env.events.push",
        "  # hides env.events.push.mode: 'interval' (configs/event/push.yaml:3)",
    ]
    assert main([*words, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)["env.events.push.mode"]
    assert (found["deleted"], found["shadowed"][0]["line"]) == (True, 3)


def test_provenance_resolves(capsys):
    words = ["compose", "--provenance", "task=walk", "seed=4", "--package", "env.num_envs"]
    assert main(words) == 0
    assert capsys.readouterr().out.startswith("env.num_envs: '${seed}'  #")
    assert main([*words, "--resolve"]) == 0
    assert capsys.readouterr().out.startswith("env.num_envs: 4  #")
