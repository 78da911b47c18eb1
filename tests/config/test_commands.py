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


def test_list_runs_of_an_empty_folder(capsys, tmp_path):
    assert main(["list", "runs", "--root", str(tmp_path / "none"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == []


def test_list_tells_an_unknown_kind(capsys):
    assert main(["list", "task"]) == 2
    assert "did you mean 'tasks'" in capsys.readouterr().err
