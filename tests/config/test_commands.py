"""``wheelleg compose`` and ``wheelleg list`` on the small tree."""

from __future__ import annotations

import json

import pytest
import yaml

from wheelleg_exp.cli.main import main

pytestmark = pytest.mark.usefixtures("stock")


def test_compose_prints_yaml_that_reads_back(capsys):
    assert main(["compose", "task=walk"]) == 0
    tree = yaml.safe_load(capsys.readouterr().out)
    assert tree["env"]["num_envs"] == "${seed}"
    assert tree["env"]["rewards"]["alive"] is None


def test_compose_resolves(capsys):
    assert main(["compose", "task=walk", "seed=4", "--resolve"]) == 0
    assert yaml.safe_load(capsys.readouterr().out)["env"]["num_envs"] == 4


def test_compose_prints_a_part_as_json(capsys):
    assert main(["compose", "--package", "env.rewards", "--json"]) == 0
    assert list(json.loads(capsys.readouterr().out)) == ["alive", "height"]


def test_compose_prints_a_single_value(capsys):
    assert main(["compose", "--package", "env.decimation"]) == 0
    assert capsys.readouterr().out == "2\n"


def test_compose_tells_an_unknown_package(capsys):
    assert main(["compose", "--package", "env.reward"]) == 2
    assert "did you mean 'env.rewards'" in capsys.readouterr().err


def test_compose_tells_where_leaves_come_from(capsys):
    assert (
        main(
            [
                "compose",
                "--provenance",
                "--package",
                "env.rewards.height.weight",
                "env.rewards.height.weight=1",
            ]
        )
        == 0
    )
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "env.rewards.height.weight: 1  # override env.rewards.height.weight=1"
    assert lines[1].endswith("-50.0 (configs/task/stand.yaml:23)")


def test_provenance_as_json(capsys):
    assert main(["compose", "--provenance", "--json", "--package", "seed"]) == 0
    assert json.loads(capsys.readouterr().out)["seed"]["where"] == "configs/train.yaml:7"


def test_list_tasks_with_a_users_folder(capsys, user):
    assert main(["list", "tasks", "--config-dir", str(user)]) == 0
    text = capsys.readouterr().out
    assert "hop" in text
    assert "Stand still." in text


def test_list_as_json(capsys):
    assert main(["list", "--json"]) == 0
    assert [row["task"] for row in json.loads(capsys.readouterr().out)] == ["stand", "walk"]


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
    assert (height["takes"], height["file"].endswith("configs/reward/height.yaml")) == (
        "target_height, sensor=None",
        True,
    )
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
    assert main(["list", "terms", "rewrd"]) == 2
    assert "did you mean 'reward'" in capsys.readouterr().err


def test_list_runs_of_a_folder_that_is_not_there_is_told(capsys, tmp_path):
    (tmp_path / "runs").mkdir()
    assert main(["list", "runs", "--root", str(tmp_path / "rnus")]) == 2
    told = capsys.readouterr().err
    assert "--root" in told
    assert f"did you mean '{tmp_path / 'runs'}'" in told


def test_list_runs_before_the_first_run_is_an_empty_list(capsys):
    assert main(["list", "runs", "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == []


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


def test_list_tells_an_unknown_kind(capsys):
    assert main(["list", "task"]) == 2
    assert "did you mean 'tasks'" in capsys.readouterr().err
