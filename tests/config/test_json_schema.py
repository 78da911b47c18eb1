"""The JSON Schema of a config accepts and rejects the same values as `wheelleg check`, by an independent validator."""

import copy
import json
from typing import Any

import pytest
from patience import thinned

from wheelleg_exp.cli.main import main
from wheelleg_exp.config.checking.find_mistakes import check_tree
from wheelleg_exp.config.composing.compose import compose
from wheelleg_exp.config.explaining.json_schema import json_schema
from wheelleg_exp.config.schema import Experiment
from wheelleg_exp.files import json_plain
from wheelleg_exp.paths import configs_dir

jsonschema = pytest.importorskip("jsonschema")

TASKS = sorted(path.stem for path in (configs_dir() / "task").glob("*.yaml"))
ABSENT = object()


def validator(tree: dict[str, Any]) -> Any:
    document = json_plain(json_schema(tree))
    jsonschema.Draft202012Validator.check_schema(document)
    return jsonschema.Draft202012Validator(document)


def changed(tree: dict[str, Any], key: str, value: object) -> dict[str, Any]:
    tree = copy.deepcopy(tree)
    *above, name = key.split(".")
    node = tree
    for part in above:
        node = node[part]
    if value is ABSENT:
        del node[name]
    else:
        node[name] = value
    return tree


@pytest.fixture(scope="module")
def walk() -> dict[str, Any]:
    return dict(compose(["task=walk"]).config)


@pytest.fixture(scope="module")
def of_walk(walk) -> Any:
    return validator(walk)


WORDS = [["realism=full"], *([f"task={task}"] for task in TASKS), ["agent=distillation"]]


@pytest.mark.parametrize("words", thinned(WORDS, 3))
def test_a_stock_config_is_valid(words):
    tree = dict(compose(words).config)
    assert [error.message for error in validator(tree).iter_errors(json_plain(tree))] == []


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("env.num_envs", "many"),
        ("env.num_envs", 0),
        ("env.num_envs", 1.5),
        ("env.num_envs", ABSENT),
        ("env.number", 3),
        ("env.sim.dt", True),
        ("env.sim.dtt", 0.01),
        ("env.observations.policy.history_order", "space"),
        ("env.observations.policy.terms.last_action.clip", [0.0]),
        ("env.rewards.alive.weight", None),
        ("env.rewards.alive.weight", ABSENT),
        ("env.rewards.alive.wieght", 2.0),
        ("env.rewards.track_lin_vel_xy.std", 0.0),
        ("env.commands.base_velocity.resampling_time_range", [1.0]),
        ("env.robot.actuators.wheels.damping", []),
        ("agent.max_iterations", -1),
        ("agent.algorithm.gamma", "high"),
        ("agent.algorithm.gama", 0.9),
        ("recording.env_ids", ["a"]),
        ("run.name", "a/b"),
        ("other", 1),
    ],
)
def test_a_mistake_is_invalid_and_check_reports_it(walk, of_walk, key, value):
    wrong = changed(walk, key, value)
    assert any(str(error.key).startswith(key) for error in check_tree(wrong, Experiment))
    assert not of_walk.is_valid(json_plain(wrong))


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("env.num_envs", 3),
        ("env.rewards.effort", {"_target_": "wheelleg_exp.mdp.rewards.joint_torques_l2", "weight": -0.001}),
        ("env.rewards.alive", ABSENT),
        ("env.observations.policy.terms.last_action.clip", [-float("inf"), 1.0]),
        ("env.observations.policy.terms.last_action.noise", None),
        ("run.name", None),
        ("check", None),
    ],
)
def test_another_value_is_valid_and_check_accepts_it(walk, of_walk, key, value):
    right = changed(walk, key, value)
    assert [str(error) for error in check_tree(right, Experiment)] == []
    assert [error.message for error in of_walk.iter_errors(json_plain(right))] == []


def test_the_command_prints_the_schema_of_what_compose_prints(capsys):
    assert main(["explain", "--schema", "task=stand", "env.events.push_robot=null"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["$schema"] == "https://json-schema.org/draft/2020-12/schema"
    assert main(["compose", "--resolve", "--json", "task=stand", "env.events.push_robot=null"]) == 0
    jsonschema.Draft202012Validator(found).validate(json.loads(capsys.readouterr().out))


def test_the_schema_of_a_part_and_mistakes(capsys):
    assert main(["explain", "--schema", "env.num_envs", "task=walk"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert (found["type"], found["minimum"]) == ("integer", 1)
    assert main(["explain", "env.num_env", "--schema"]) == 2
    assert main(["explain"]) == 2
    assert "KEY: the argument is missing" in capsys.readouterr().err
