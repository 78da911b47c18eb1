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
    [
        ("compose --package env.reward", "env.rewards"),
        ("compose --primary trian", "train"),
        ("list task", "tasks"),
        ("list terms rewrd", "reward"),
    ],
)
def test_an_unknown_word_is_reported_with_the_nearest(words, nearest, capsys):
    assert main(words.split()) == 2
    assert f"did you mean '{nearest}'" in capsys.readouterr().err


def test_list_terms_contains_unused_terms_but_no_helpers_and_base_classes(capsys):
    assert main(["list", "terms", "--json"]) == 0
    rows = {(row["group"], row["term"]): row for row in json.loads(capsys.readouterr().out)}
    height = rows["reward", "height"]
    assert height["takes"] == "target_height, sensor=None"
    assert height["file"].endswith("configs/reward/height.yaml")
    unused = rows["reward", "base_height_l2"]
    assert (unused["file"], unused["target"]) == (None, "wheelleg_exp.mdp.rewards.base_height_l2")
    assert (unused["takes"], unused["help"][:14]) == ("target_height, asset_cfg=..., sensor_cfg=None", "(z - target)^2")
    sections = {"action", "command", "observation", "event", "reward", "termination", "curriculum", "recorder"}
    assert {group for group, _ in rows} == sections
    names = {term for _, term in rows}
    assert {"JointEffortAction", "is_terminated_term", "reset_scene_to_default"} <= names
    assert not names & {"draw", "operate", "all_ids", "JointAction", "ActionTerm", "Sequence", "SceneEntityCfg"}


def test_list_terms_of_a_section_takes_both_of_its_names(capsys):
    texts = set()
    for name in ("reward", "rewards"):
        assert main(["list", "terms", name, "--json"]) == 0
        texts.add(capsys.readouterr().out)
    assert len(texts) == 1


def test_list_runs_of_a_missing_folder_is_refused(capsys, tmp_path):
    (tmp_path / "runs").mkdir()
    assert main(["list", "runs", "--root", str(tmp_path / "rnus")]) == 2
    message = capsys.readouterr().err
    assert "--root" in message
    assert f"did you mean '{tmp_path / 'runs'}'" in message


def test_provenance_shows_hidden_and_removed_values_and_resolves(capsys):
    def shown(key, *words):
        assert main(["compose", "--provenance", "--package", key, *words]) == 0
        return capsys.readouterr().out

    key = "env.rewards.height.weight"
    lines = shown(key, f"{key}=1").splitlines()
    assert lines[0] == f"{key}: 1  # override {key}=1"
    assert lines[1].endswith("-50.0 (configs/task/stand.yaml:23)")
    assert shown("env.events.push.mode", "~env.events.push").splitlines() == [
        "# env.events.push.mode: removed  # override ~env.events.push",
        "  # hides env.events.push.mode: 'interval' (configs/event/push.yaml:3)",
    ]
    found = json.loads(shown("env.events.push.mode", "~env.events.push", "--json"))["env.events.push.mode"]
    assert (found["deleted"], found["shadowed"][0]["line"]) == (True, 3)
    words = ("env.num_envs", "task=walk", "seed=4")
    assert shown(*words).startswith("env.num_envs: '${seed}'  #")
    assert shown(*words, "--resolve").startswith("env.num_envs: 4  #")
