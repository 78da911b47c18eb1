import json
from datetime import datetime
from pathlib import Path

import pytest

from wheelleg_exp.cli.main import main
from wheelleg_exp.config.composing.compose import compose
from wheelleg_exp.config.explaining.config_diff import Side, compare
from wheelleg_exp.errors import WheellegError
from wheelleg_exp.files import read_json, write_json, write_text
from wheelleg_exp.jobs.diff_inputs import load_sides
from wheelleg_exp.run.run_directory import RunDirectory
from wheelleg_exp.run.start_run import start_run


@pytest.fixture
def diff(stock, tmp_path):
    def compare_texts(a, b, config_dirs=()):
        return compare(*load_sides(a, b, tmp_path / "runs", config_dirs))

    return compare_texts


@pytest.fixture
def make_run(stock, tmp_path):
    def make(*overrides, minute=0, task="stand"):
        composed = compose(overrides)
        directory = RunDirectory.create(tmp_path / "runs", task, 1, now=datetime(2026, 1, 1, 1, minute))
        start_run(
            directory,
            command=["wheelleg", "train", *overrides],
            params={"env": composed.config["env"], "agent": composed.config["agent"]},
            hydra_files=composed.hydra_files(),
            source_roots=[],
            seed=composed.config["seed"],
            task=task,
            threads={"torch": 1},
        )
        directory.asset.mkdir()
        write_json(directory.asset / "asset.json", {"sources": {"robot.usda": "aa"}, "model_sha256": "bb"})
        return directory

    return make


EQUAL = {
    "the same words": ("stand", "task=stand"),
    "no words": ("", "stand"),
    "a whole number and a fraction": ("stand", "stand env.episode_length_s=5"),
    "an interpolation and its value": ("stand env.num_envs=1", "stand env.num_envs=${seed}"),
    "a default that is written out": ("stand", "stand +env.actions.effort.gain=1 +env.rewards.height.sensor=null"),
    "a field's default that is written out": ("stand", "stand +env.observations.policy.terms.speed.scale=null"),
    "a section's default that is written out": ("stand", "stand +env.observations.policy.concatenate_terms=true"),
    "a term removed twice": ("stand ~env.events.push", "stand env.events.push=null"),
    "one file and a typed node": ("stand +reward@env.rewards=smooth",
                                  "stand +env.rewards.smooth={weight: -0.1, _target_: shelf_terms.smooth}"),
    "where the run goes": ("stand", "stand run.root=elsewhere"),
    "the order of a mapping's keys": ("stand ++env.robot.joint_pos={a: 1, b: 2}",
                                      "stand ++env.robot.joint_pos={b: 2, a: 1}"),
}  # fmt: skip


@pytest.mark.parametrize("name", EQUAL)
def test_equal_by_meaning_is_equal(diff, name):
    found = diff(*EQUAL[name])
    assert (found.terms, found.parameters, found.facts) == ((), (), ())


def test_a_default_object_equals_the_node_that_makes_it():
    words = "+env.rewards.lin_vel_z.asset_cfg={_target_: wheelleg_exp.managers.SceneEntityCfg, name: robot}"
    sides = load_sides("stand", f"stand {words}", Path("runs"))
    assert not compare(*sides)
    named = words.replace("name: robot", "name: robot, joint_names: [l01]")
    (change,) = compare(*load_sides("stand", f"stand {named}", Path("runs"))).parameters
    path = "env.rewards.lin_vel_z.asset_cfg"
    assert (change.kind, change.path, change.where_b) == ("added", path, f"override {named}")


def test_the_order_of_terms_counts_only_where_it_acts(diff, edit):
    edit("termination/late.yaml", "late:\n  _target_: shelf_terms.fell\n  limit: 2.0\n")
    one, other = "termination@env.terminations=[fell,late]", "termination@env.terminations=[late,fell]"
    assert not diff(f"stand {one}", f"stand {other}")
    found = diff("stand", "stand observation@env.observations.policy.terms=[joints,speed]")
    assert [(c.kind, c.path, c.a, c.b) for c in found.terms] == [
        ("reordered", "env.observations.policy.terms", ["speed", "joints"], ["joints", "speed"])
    ]
    assert "layout" in found.terms[0].note
    assert found.terms[0].where_b == "override observation@env.observations.policy.terms=[joints,speed]"


def test_a_changed_parameter_has_both_values_and_both_places(diff):
    key = "env.rewards.height.weight"
    found = diff("stand", f"stand {key}=3")
    assert found.terms == ()
    (change,) = found.parameters
    assert (change.kind, change.path, change.a, change.b) == ("changed", key, -50.0, 3)
    assert (change.where_a, change.where_b) == ("configs/task/stand.yaml:23", f"override {key}=3")


def test_added_and_removed_terms_have_the_places_that_caused_it(diff):
    found = diff("stand", "task=walk")
    kinds = {change.path: (change.kind, change.where_a, change.where_b) for change in found.terms}
    assert kinds == {
        "env.rewards.alive": ("removed", "configs/reward/alive.yaml:2", "configs/task/walk.yaml:12"),
        "env.rewards.smooth": ("added", "configs/task/stand.yaml:11", "configs/reward/smooth.yaml:2"),
    }
    assert {change.path for change in found.parameters} == {"task.name", "env.num_envs"}


def test_a_users_task_is_a_side(diff, user):
    found = diff("stand", "hop", [user])
    kinds = {change.path: change.kind for change in found.terms}
    assert kinds == {"env.rewards.height": "removed", "env.rewards.bounce": "added"}


def test_two_runs_of_the_same_words_are_equal_and_overrides_may_follow_a_run(diff, make_run):
    one, other = make_run(), make_run(minute=1)
    assert not diff(str(one.path), "latest")
    assert not diff(one.id, other.id)
    assert not diff(one.id, f"{one.id} env.decimation=2.0")
    assert diff(one.id, f"{one.id} env.decimation=3").parameters[0].where_b == "override env.decimation=3"


def test_a_run_names_its_override_or_the_line_of_its_parameters(diff, make_run):
    run = make_run("env.decimation=4", "task=stand")
    (change,) = diff(str(run.path), "stand").parameters
    assert (change.a, change.b, change.where_a) == (4, 2, "override env.decimation=4")
    write_text(run.params / "env.yaml", (run.params / "env.yaml").read_text().replace("newton", "cg"))
    change = next(c for c in diff(str(run.path), "stand").parameters if c.path == "env.sim.solver")
    line = int(change.where_a.removeprefix("params/env.yaml:"))
    assert (run.params / "env.yaml").read_text().splitlines()[line - 1].strip() == "solver: cg"


def test_the_facts_of_two_runs_are_compared(diff, make_run):
    one, other = make_run(), make_run(minute=1)
    manifest = read_json(other.path / "manifest.json")
    manifest["versions"]["mujoco-core"] = "0.0"
    manifest["hardware"]["cpu"] = "another"
    manifest["threads"]["torch"] = 2
    write_json(other.path / "manifest.json", manifest)
    write_json(other.asset / "asset.json", {"sources": {"robot.usda": "cc"}, "model_sha256": "bb"})
    found = diff(one.id, other.id)
    assert (found.terms, found.parameters) == ((), ())
    assert {(f.section, f.name, f.b) for f in found.facts} == {
        ("versions", "mujoco-core", "0.0"), ("hardware", "cpu", "another"), ("threads", "torch", 2),
        ("asset", "robot.usda", "cc"),
    }  # fmt: skip


def test_equal_files_are_equal_code_whatever_they_were_committed_as():
    codes = [{"tree": "t", "commit": "a", "dirty": True}, *({"tree": t, "commit": "b", "dirty": False} for t in "tu")]
    one, other, changed = (Side("", {}, lambda path: None, {"code": code}) for code in codes)
    assert compare(one, other).facts == ()
    assert [f.name for f in compare(one, changed).facts] == ["tree", "commit", "dirty"]


@pytest.mark.parametrize(
    ("side", "parts"),
    [
        ("walkk", ["neither a task nor a run", "did you mean 'walk'?"]),
        ("task=walkk", ["did you mean 'walk'?"]),
        ("stand env.decimatoin=1", ["did you mean 'env.decimation'?"]),
        ("'stand", ["closed quotes"]),
        ("latest", ["there is no run below"]),
    ],
)
def test_a_wrong_side_is_refused(diff, side, parts):
    with pytest.raises(WheellegError) as raised:
        diff("stand", side)
    assert [part for part in parts if part not in str(raised.value)] == []


def test_the_command_ends_with_0_for_equal_and_1_for_different_and_prints_json(stock, capsys):
    assert main(["diff", "stand", "task=stand"]) == 0
    assert capsys.readouterr().out.endswith("equal by meaning\n")
    assert main(["diff", "stand", "task=walk env.rewards.height.weight=2"]) == 1
    out = capsys.readouterr().out
    changed = [line.split()[:3] for line in out.splitlines() if line.startswith("changed") and "height" in line]
    assert changed == [["changed", "env.rewards.height.weight", "-50.0"]]
    assert main(["diff", "stand", "walkk"]) == 2
    capsys.readouterr()
    assert main(["diff", "stand", "stand env.decimation=3", "--json"]) == 1
    found = json.loads(capsys.readouterr().out)
    assert (found["equal"], found["terms"], found["facts"]) == (False, [], [])
    assert found["parameters"][0]["path"] == "env.decimation"
