"""Each mistake ends with status 2 and one message: the key, the place, and the nearest valid name."""

from __future__ import annotations

import json
from collections.abc import Callable

import pytest

from wheelleg_exp.cli import main as script
from wheelleg_exp.cli.main import main
from wheelleg_exp.terms import term_binding

# words of the command line -> what the message must hold
OVERRIDES = {
    "unknown task": (
        ["task=stnd"],
        ["task: 'stnd' is not an option", "override task=stnd", "stand, walk", "did you mean 'stand'"],
    ),
    "unknown option": (
        ["robot=artcle"],
        ["robot:", "override robot=artcle", "article, physical", "did you mean 'article'"],
    ),
    "unknown element of a list": (
        ["reward@env.rewards=[alive,heigth]"],
        [
            "reward@env.rewards: 'heigth'",
            "override reward@env.rewards=[alive,heigth]",
            "did you mean 'height'",
        ],
    ),
    "unknown appended element": (
        ["+reward@env.rewards=smoth"],
        ["reward@env.rewards: 'smoth'", "override +reward@env.rewards=smoth", "did you mean 'smooth'"],
    ),
    "unknown group with a mount": (
        ["rewrd@env.rewards=[alive]"],
        ["rewrd: there is no config group", "override rewrd@env.rewards", "did you mean 'reward'"],
    ),
    "unknown group without a mount": (
        ["robt=physical"],
        ["robt:", "override robt=physical", "did you mean 'robot'"],
    ),
    "group without its mount": (
        ["reward=[alive]"],
        [
            "reward: no file mounts a group under this name",
            "override reward=[alive]",
            "'reward@env.rewards'",
        ],
    ),
    "misspelled leaf": (
        ["env.rewards.heigth.weight=-30"],
        [
            "env.rewards.heigth.weight: there is no such key",
            "override env.rewards.heigth.weight=-30",
            "did you mean 'env.rewards.height.weight'",
        ],
    ),
    "misspelled leaf of a short path": (
        ["agent.deice=cpu"],
        ["agent.deice: there is no such key", "did you mean 'agent.device'"],
    ),
    "leaf without its prefix": (
        ["rewards.height.weight=-30"],
        ["rewards.height.weight:", "override rewards", "did you mean 'env.rewards.height.weight'"],
    ),
    "optional key that no file sets": (
        ["agent.clip_actions=1"],
        ["agent.clip_actions: no file of the task sets this key", "expected +agent.clip_actions=1"],
    ),
    "misspelled top key": (["sed=3"], ["sed: there is no such key", "override sed=3", "did you mean 'seed'"]),
    "created key": (
        ["+env.num_env=3"],
        ["env.num_env: nothing reads this key", "override +env.num_env=3", "did you mean 'num_envs'"],
    ),
    "created key in a section": (
        ["+env.sim.solvr=cg"],
        ["env.sim.solvr: nothing reads this key", "override +env.sim.solvr=cg", "did you mean 'solver'"],
    ),
    "created key of a term": (
        ["+env.rewards.height.target_heigth=1"],
        [
            "env.rewards.height.target_heigth:",
            "override +env.rewards.height.target_heigth=1",
            "'target_height'",
        ],
    ),
    "created key of the agent": (
        ["+agent.max_iteration=3"],
        ["agent.max_iteration:", "override +agent.max_iteration=3", "did you mean 'max_iterations'"],
    ),
    "created key of the algorithm": (
        ["+agent.algorithm.gama=0.9"],
        ["agent.algorithm.gama:", "override +agent.algorithm.gama=0.9", "did you mean 'gamma'"],
    ),
    "created top key": (
        ["+evn.x=3"],
        ["evn: nothing reads this key", "override +evn.x=3", "did you mean 'env'"],
    ),
    "added twice": (["+seed=3"], ["seed: the key has a value already", "override +seed=3", "expected seed=3"]),
    "malformed": (["seed"], ["seed: not an override", "override seed", "key=value"]),
    "malformed value": (["seed=[1"], ["seed=[1: not an override", "override seed=[1", "key=value"]),
    "a regular expression without quotes": (
        ["env.robot.actuators=[.*0[23]$]"],
        ["env.robot.actuators=[.*0[23]$]: not an override", "quotes around text", "env.robot.actuators=['...']"],
    ),
    "a mapping with an unknown key": (
        ["env.sim={solvr: cg}"],
        ["env.sim.solvr: there is no such key", "override env.sim={solvr: cg}", "did you mean 'solver'"],
    ),
    "infinite": (
        ["env.robot.length=inf"],
        ["env.robot.length: inf", "override env.robot.length=inf", "a finite number"],
    ),
    "sweep": (["seed=1,2"], ["seed: several values for one run", "override seed=1,2", "seed=[1,2]"]),
    "deleted and not there": (
        ["~env.events.psh"],
        [
            "env.events.psh: there is no such key",
            "override ~env.events.psh",
            "did you mean 'env.events.push'",
        ],
    ),
    "deleted with another value": (
        ["~seed=4"],
        ["seed:", "override ~seed=4", "expected ~seed without a value"],
    ),
    "deleted twice": (
        ["task=walk", "~env.rewards.alive"],
        [
            "env.rewards.alive: is null already",
            "override ~env.rewards.alive",
            "'wheelleg explain task=... env.rewards.alive'",
        ],
    ),
    "a setting of a term that is removed": (
        ["task=walk", "env.rewards.alive.weight=2"],
        ["env.rewards.alive.weight: there is no such key", "it is null: 'wheelleg explain task=... env.rewards.alive'"],
    ),
    "settings of a deselected term": (
        ["reward@env.rewards=[alive]"],
        ["env.rewards.height:", "configs/task/stand.yaml:23", "_target_"],
    ),
    "path through a value": (["seed.x=3"], ["seed.x:", "override seed.x=3"]),
    "wrong type": (
        ["env.decimation=abc"],
        ["env.decimation: 'abc'", "override env.decimation=abc", "a whole number"],
    ),
    "a bool is no number": (
        ["env.num_envs=true"],
        ["env.num_envs: True", "override env.num_envs=true", "a whole number"],
    ),
    "out of range": (["env.num_envs=0"], ["env.num_envs: 0", "override env.num_envs=0", "at least 1"]),
    "out of range in a section": (
        ["env.sim.dt=0.0"],
        ["env.sim.dt: 0.0", "override env.sim.dt=0.0", "more than 0"],
    ),
    "not one of the words": (
        ["env.sim.solver=pgs"],
        ["env.sim.solver: 'pgs'", "override", "one of newton, cg"],
    ),
    "wrong parameter type": (
        ["env.rewards.height.target_height=high"],
        ["env.rewards.height.target_height: 'high'", "override", "expected a number"],
    ),
    "wrong weight": (
        ["env.rewards.height.weight=heavy"],
        ["env.rewards.height.weight: 'heavy'", "override", "a number"],
    ),
    "wrong mode": (
        ["env.events.push.mode=intervall"],
        ["env.events.push.mode:", "unknown mode 'intervall'", "override", "'interval'"],
    ),
    "an interval event without an interval": (
        ["~env.events.push.interval_range_s"],
        ["env.events.push.interval_range_s:", "needs an interval", "override ~env.events.push.interval_range_s"],
    ),
    "a field of another mode": (
        ["+env.events.push.min_step_count_between_reset=3"],
        ["env.events.push.min_step_count_between_reset: only events of mode 'reset'", "override"],
    ),
    "missing parameter": (
        ["~env.rewards.height.target_height"],
        ["env.rewards.height:", "needs 'target_height'", "configs/reward/height.yaml:3"],
    ),
    "missing weight": (
        ["~env.rewards.alive.weight"],
        ["env.rewards.alive.weight:", "needs 'weight'", "override ~env.rewards.alive.weight"],
    ),
    "missing section key": (
        ["~env.sim.solver"],
        ["env.sim.solver: this value is missing", "override ~env.sim.solver"],
    ),
    "target that is not there": (
        ["env.rewards.alive._target_=shelf_terms.alve"],
        ["env.rewards.alive._target_:", "override", "did you mean 'alive'"],
    ),
    "target module that is not there": (
        ["env.rewards.alive._target_=wheelleg_exp.eror.x"],
        ["env.rewards.alive._target_:", "override", "did you mean 'wheelleg_exp.errors.x'"],
    ),
    "target without a module": (
        ["env.rewards.alive._target_=alive"],
        ["env.rewards.alive._target_:", "override", "alive"],
    ),
    "target that cannot be called": (
        ["env.rewards.alive._target_=shelf_terms.NOT_CALLABLE"],
        ["env.rewards.alive._target_:", "no callable 'NOT_CALLABLE'"],
    ),
    "target outside the allow-list": (
        ["env.rewards.alive._target_=os.system"],
        [
            "env.rewards.alive._target_:",
            "outside the allowed packages",
            "override",
            "wheelleg_exp, shelf_terms",
        ],
    ),
    "nested target outside the allow-list": (
        ["env.observations.policy.terms.speed.noise._target_=subprocess.run"],
        ["env.observations.policy.terms.speed.noise._target_:", "outside the allowed packages", "override"],
    ),
    "nested target with a wrong parameter": (
        ["+env.observations.policy.terms.speed.noise.hihg=1"],
        ["env.observations.policy.terms.speed.noise.hihg:", "override", "did you mean 'high'"],
    ),
    "target that takes a reserved name": (
        ["env.rewards.alive._target_=shelf_terms.takes_weight"],
        ["env.rewards.alive:", "is a field of the manager"],
    ),
    "agent class outside the allow-list": (
        ["agent.algorithm.class_name=os:system"],
        ["agent.algorithm.class_name:", "outside the allowed packages", "override", "rsl_rl"],
    ),
    "agent class that is not there": (
        ["agent.algorithm.class_name=PPPO"],
        ["agent.algorithm.class_name:", "override", "did you mean 'PPO'"],
    ),
    "agent parameter of the wrong type": (
        ["agent.algorithm.gamma=high"],
        ["agent.algorithm.gamma: 'high'", "override", "expected a number"],
    ),
    "agent word that is not known": (
        ["++agent.algorithm.optimizer=adamm"],
        ["agent.algorithm.optimizer: 'adamm'", "override", "did you mean 'adam'"],
    ),
    "agent group that is not there": (
        ["agent.obs_groups.actor=[polcy]"],
        ["agent.obs_groups.actor:", "'polcy'", "override", "did you mean 'policy'"],
    ),
    "null for a group": (
        ["robot=null"],
        ["robot: a group takes", "override robot=null", "article, physical"],
    ),
    "a group chosen twice": (
        ["+robot=physical"],
        ["robot: an option", "override +robot=physical", "robot=<option>"],
    ),
    "a group forced": (
        ["++robot=physical"],
        ["robot: a group takes", "override ++robot=physical", "+robot=<option>"],
    ),
    "an index in brackets": (
        ["env.robot.order[0]=c"],
        ["override env.robot.order[0]=c", "env.robot.order.0=c"],
    ),
    "an index that is not there": (
        ["env.robot.order.7=c"],
        ["env.robot.order.7:", "override", "out of range"],
    ),
    "no key": (["=3"], ["=3: not an override", "override =3", "key=value"]),
    "not a number": (
        ["env.rewards.height.weight=nan"],
        ["env.rewards.height.weight: nan", "override", "a finite number"],
    ),
    "a setting of Hydra's that nothing reads": (
        ["hydra.run.dir=x"],
        ["hydra.run.dir: nothing reads this", "override hydra.run.dir=x", "run.root=DIR"],
    ),
    "a misspelled key of hydra": (["+hydra.rn=x"], ["hydra.rn: nothing reads this", "hydra.searchpath"]),
    "a group of Hydra's": (["hydra/job_logging=disabled"], ["hydra/job_logging: nothing reads this"]),
    "a name in a list of Hydra's": (
        ["hydra.searchpath.a=x"],
        ["hydra.searchpath.a:", "override hydra.searchpath.a=x"],
    ),
    "Hydra's settings as a mapping": (["hydra={run: {dir: x}}"], ["hydra: nothing reads this"]),
    "Hydra's settings deleted": (["~hydra"], ["hydra: nothing reads this", "override ~hydra"]),
    "search path that is not there": (["hydra.searchpath=[file:///nope]"], ["hydra.searchpath:", "/nope"]),
    "value deleted that is needed": (["~run"], ["run: this value is missing", "expected a mapping"]),
    "missing value on the command line": (["seed=???"], ["seed: this value is missing", "override seed=???"]),
    "unknown key of an observation group": (
        ["+env.observations.policy.history_lenght=3"],
        ["env.observations.policy.history_lenght:", "override", "did you mean 'history_length'"],
    ),
    "interpolation to nothing": (
        ["env.num_envs=${sed}"],
        ["env.num_envs:", "override env.num_envs=${sed}", "sed"],
    ),
    "config folder that is not there": (
        ["--config-dir", "conifgs"],
        ["conifgs:", "--config-dir", "did you mean 'configs'"],
    ),
    "a joint that the robot does not have": (
        ["env.actions.effort.joint_names=[left_hp]"],
        ["env.actions.effort.joint_names:", "'left_hp' matches nothing", "override", "did you mean 'left_hip'"],
    ),
    "no regular expression": (
        ["env.actions.effort.joint_names=['(']"],
        ["env.actions.effort.joint_names:", "'(' is not a regular expression", "override"],
    ),
    "a joint matched twice": (
        ["env.actions.effort.joint_names=[a,'.*']"],
        ["env.actions.effort.joint_names:", "'a' is matched by both", "override"],
    ),
    "a command that is not there": (
        [
            "+env.rewards.track={_target_: wheelleg_exp.mdp.rewards.track_lin_vel_xy_exp, weight: 1, std: 1, "
            "command_name: base_velocity}"
        ],
        ["env.rewards.track.command_name: there is no command 'base_velocity'", "override"],
    ),
    "a silence that names no rule": (
        ["++check.silence.push_sze=known"],
        ["check.silence.push_sze: there is no such rule", "override", "did you mean 'push_size'"],
    ),
    "a group mounted in the wrong place": (
        ["+reward@env.reward=smooth"],
        [
            "env.reward: nothing reads the options of 'reward' here",
            "override +reward@env.reward=smooth",
            "'reward@env.rewards'",
        ],
    ),
    "an observation group that no network reads the observation group": (
        ["agent.obs_groups.critic=[policy]"],
        [
            "agent.obs_groups.critic: no network reads the observation group",
            "'critic'",
            "override agent.obs_groups.critic=[policy]",
        ],
    ),
    "a set of groups that no network reads": (
        ["+agent.obs_groups.actr=[policy]"],
        ["agent.obs_groups.actr: no network reads this set", "override", "did you mean 'actor'"],
    ),
    "a network without groups": (
        ["agent.obs_groups.actor=[]"],
        ["agent.obs_groups.actor: names no group", "override", "policy, critic"],
    ),
    "an observation group without terms": (
        ["observation@env.observations.policy.terms=[]"],
        [
            "env.observations.policy.terms: this value is missing",
            "override observation@env.observations.policy.terms=[]",
        ],
    ),
    "a range turned round": (
        ["env.events.push.velocity_range=[1,-1]"],
        ["env.events.push.velocity_range: [1, -1] is out of range", "override", "[low, high]"],
    ),
    "a run root that is a file": (
        ["run.root=configs/train.yaml"],
        ["run.root: 'configs/train.yaml' is a file", "override run.root=configs/train.yaml", "a folder"],
    ),
    "two options of a group that takes one": (
        ["task=[stand,walk]"],
        ["task: this group takes one option", "override task=[stand,walk]"],
    ),
    "a section in which a value stands": (
        ["env.rewards=3"],
        ["env.rewards: 3 is not of the right type", "override env.rewards=3", "a mapping"],
    ),
    "a term in which a value stands": (
        ["env.rewards.alive=3"],
        ["env.rewards.alive: a term must be a mapping", "override env.rewards.alive=3"],
    ),
    "an interpolation in a circle": (
        ["env.num_envs=${env.num_envs}"],
        ["env.num_envs: Recursive interpolation", "override"],
    ),
    "an option taken out of a list": (
        ["~reward@env.rewards=alive"],
        ["reward@env.rewards: an option of a list cannot be removed", "override ~reward", "~env.rewards.alive"],
    ),
    "a deleted group": (["~task"], ["task: this value is missing", "override ~task"]),
}

# file, its text (or old and new text), words, what the message must hold
FILES = {
    "a body that its own parent overwrites": (
        ("task/mine.yaml", "# @package _global_\n# Mine.\ndefaults: [_self_, stand]\nenv: {num_envs: 77}\n"),
        ["task=mine"],
        ["env.num_envs: 77 is lost", "configs/task/mine.yaml:4", "_self_ at the end"],
    ),
    "broken YAML": (
        ("robot/article.yaml", "order: [a, b]", "order: [a, b"),
        [],
        ["robot/article", "configs/robot/article.yaml:7"],
    ),
    "a key twice": (
        ("robot/article.yaml", "order: [a, b]", "asset: again"),
        [],
        ["robot/article", "configs/robot/article.yaml:6", "duplicate key"],
    ),
    "no mapping": (
        ("robot/article.yaml", "- a\n- b\n"),
        [],
        ["configs/robot/article.yaml:1", "does not contain a mapping"],
    ),
    "package line below a comment": (
        ("sim/mujoco.yaml", "# The solver.\n# @package env.sim\ndt: 0.01\n"),
        [],
        ["# @package env.sim: this package line has no effect", "configs/sim/mujoco.yaml:2", "first line"],
    ),
    "package line with a colon": (
        ("sim/mujoco.yaml", "# @package: env.sim\ndt: 0.01\n"),
        [],
        ["configs/sim/mujoco.yaml:1", "no effect"],
    ),
    "misspelled list element in a file": (
        ("task/stand.yaml", "[alive, height]", "[alive, heigth]"),
        [],
        ["reward: 'heigth'", "configs/task/stand.yaml:11", "did you mean 'height'"],
    ),
    "misspelled option in a file": (
        ("task/stand.yaml", "/robot: article", "/robot: articel"),
        [],
        ["robot: 'articel'", "configs/task/stand.yaml:4", "did you mean 'article'"],
    ),
    "misspelled group in a file": (
        ("task/stand.yaml", "/sim: mujoco", "/smi: mujoco"),
        [],
        ["smi: there is no config group", "configs/task/stand.yaml:5", "did you mean 'sim'"],
    ),
    "override of a mount that is not there": (
        ("task/walk.yaml", "- _self_", "- _self_\n  - override /reward@env.reward: [alive]"),
        ["task=walk"],
        ["reward@env.reward:", "configs/task/walk.yaml:7", "did you mean 'reward@env.rewards'"],
    ),
    "defaults in a circle": (
        ("task/stand.yaml", "- /robot: article", "- walk"),
        [],
        ["task/walk: the defaults", "task/stand -> task/walk", "configs/task/walk.yaml:4"],
    ),
    "missing value": (
        ("task/stand.yaml", "decimation: 2", "decimation: ???"),
        [],
        ["env.decimation: this value is missing", "configs/task/stand.yaml:19", "env.decimation=<value>"],
    ),
    "bad interpolation in a file": (
        ("robot/article.yaml", "${env.sim.dt}", "${env.sim.tt}"),
        [],
        ["env.robot.length:", "configs/robot/article.yaml:7"],
    ),
    "unclosed interpolation in a file": (
        ("robot/article.yaml", "${env.sim.dt}", "${env.sim.dt"),
        [],
        ["configs/robot/article.yaml:7", "env.sim.dt"],
    ),
    "settings for a misspelled term": (
        ("task/stand.yaml", "    height:\n", "    heigth:\n"),
        [],
        ["env.rewards.heigth:", "configs/task/stand.yaml:23"],
    ),
    "key that nothing reads": (
        ("sim/mujoco.yaml", "solver: newton", "solver: newton\nimpratios: 3"),
        [],
        ["env.sim.impratios: nothing reads this key", "configs/sim/mujoco.yaml:4"],
    ),
    "a value where a mapping is needed": (
        ("reward/alive.yaml", "alive: 3\n"),
        [],
        ["env.rewards.alive:", "configs/reward/alive.yaml:1", "mapping"],
    ),
    "a term under another name": (
        ("reward/alive.yaml", "alve:\n  _target_: shelf_terms.alive\n  weight: 1.0\n"),
        [],
        [
            "env.rewards.alive: this file contains the term 'alve'",
            "configs/reward/alive.yaml:1",
            "did you mean 'alive'",
        ],
    ),
    "a term without its name": (
        ("reward/height.yaml", "_target_: shelf_terms.height\nweight: 1.0\ntarget_height: 0.1\n"),
        [],
        [
            "env.rewards.height: this file does not contain the key 'height'",
            "configs/reward/height.yaml:1",
            "did you mean 'height'",
        ],
    ),
    "an empty file of a term": (
        ("reward/alive.yaml", ""),
        [],
        ["env.rewards.alive: this file is empty, and does not contain the term 'alive'", "configs/reward/alive.yaml:1"],
    ),
    "a task without a package line": (
        ("task/mine.yaml", "# Mine.\ndefaults: [stand, _self_]\nenv: {num_envs: 3}\n"),
        ["task=mine"],
        ["task/mine: this file has no package line", "configs/task/mine.yaml:1", "'# @package _global_'"],
    ),
    "a task without a package line, and an override that it makes fail": (
        ("task/mine.yaml", "defaults: [stand, _self_]\n"),
        ["task=mine", "env.decimation=3"],
        ["task/mine: this file has no package line", "configs/task/mine.yaml:1", "'# @package _global_'"],
    ),
    "a robot without a package line": (
        ("robot/mine.yaml", "asset: mine.usda\n"),
        ["robot=mine"],
        ["robot/mine: this file has no package line", "configs/robot/mine.yaml:1", "'# @package env.robot'"],
    ),
    "a list whose order is not kept": (
        ("task/stand.yaml", "  - _self_\n", "", "defaults:\n", "defaults:\n  - _self_\n"),
        [],
        ["env.rewards: the order of the terms is not that of the list", "configs/task/stand.yaml:23", "alive, height"],
    ),
    "a list mounted in the wrong place": (
        ("task/stand.yaml", "/reward@env.rewards:", "/reward@env.reward:"),
        [],
        [
            "env.reward: nothing reads the options of 'reward' here",
            "configs/task/stand.yaml:11",
            "'reward@env.rewards'",
        ],
    ),
    "a tab": (
        ("reward/alive.yaml", "alive:\n\t_target_: shelf_terms.alive\n"),
        [],
        ["reward/alive: the file is not valid YAML", "configs/reward/alive.yaml:2"],
    ),
    "a misspelled key of a term": (
        ("reward/alive.yaml", "weight: 1.0", "weight: 1.0\n  wieght: 2.0"),
        [],
        ["env.rewards.alive.wieght:", "configs/reward/alive.yaml:4", "one of weight"],
    ),
    "a misspelled key at the top": (
        ("train.yaml", "seed: 1", "sed: 1"),
        [],
        ["sed: nothing reads this key", "configs/train.yaml:7", "did you mean 'seed'"],
    ),
    "a module that does not import": (
        ("../shelf_broken.py", "raise NameError('oops')\n"),
        ["env.rewards.alive._target_=shelf_broken.alive"],
        ["env.rewards.alive._target_:", "oops", "override"],
    ),
}


@pytest.fixture
def command(stock: object, monkeypatch: pytest.MonkeyPatch) -> Callable[[list[str]], int]:
    """Run ``wheelleg check``, with the words that come after it."""
    monkeypatch.setattr(term_binding, "allowed_packages", lambda: ("wheelleg_exp", "shelf_terms", "shelf_broken"))
    return lambda words: main(["check", *words])


def test_the_small_tree_is_free_of_mistakes(command, capsys):
    assert command([]) == 0, capsys.readouterr().err
    assert command(["task=walk"]) == 0, capsys.readouterr().err


@pytest.mark.parametrize("name", OVERRIDES)
def test_a_wrong_command_line_is_told_with_key_place_and_nearest_name(name, command, capsys):
    words, parts = OVERRIDES[name]
    _assert_told(command(words), capsys, parts, alone=name != "a deleted group")


@pytest.mark.parametrize("name", FILES)
def test_a_wrong_file_is_told_with_key_file_and_line(name, command, edit, capsys):
    (file, *texts), words, parts = FILES[name]
    for old, new in zip(texts[::2], texts[1::2], strict=True) if len(texts) > 1 else ():
        edit(file, old, new)
    if len(texts) == 1:
        edit(file, *texts)
    _assert_told(command(words), capsys, parts)


def _assert_told(status, capsys, parts, *, alone=True):
    captured = capsys.readouterr()
    assert status == 2, captured.err
    assert captured.out == ""
    assert captured.err.startswith("wheelleg: error: ")
    assert "Traceback" not in captured.err
    assert alone == ("mistakes in the config" not in captured.err)
    for part in parts:
        assert part in captured.err


def test_an_unknown_primary_is_told(stock, capsys):
    assert main(["compose", "--primary", "trian"]) == 2
    message = capsys.readouterr().err
    assert "trian: there is no such primary config" in message
    assert "did you mean 'train'" in message


def test_the_small_tree_has_no_mistakes_as_json(command, capsys):
    assert command(["--json"]) == 0
    assert json.loads(capsys.readouterr().out) == {"mistakes": []}


def test_a_mistake_as_json_has_key_file_line_and_nearest_name(command, edit, capsys):
    edit("task/stand.yaml", "[alive, height]", "[alive, heigth]")
    assert command(["--json", "env.num_envs=0"]) == 2
    captured = capsys.readouterr()
    assert captured.err == ""
    first, second = json.loads(captured.out)["mistakes"]
    assert (first["key"], first["file"], first["line"]) == ("reward", "configs/task/stand.yaml", 11)
    assert (first["nearest"], first["override"]) == ("height", None)
    assert (second["key"], second["override"], second["file"]) == ("env.num_envs", "env.num_envs=0", None)


def test_mistakes_behind_those_that_stop_the_composition_are_told_as_well(command, edit, capsys):
    edit("task/stand.yaml", "[alive, height]", "[alive, heigth]")
    edit("task/stand.yaml", "decimation: 2", "decimation: ???")
    edit("sim/mujoco.yaml", "solver: newton", "solver: newton\nimpratios: 3")
    edit("robot/article.yaml", "${env.sim.dt}", "${env.sim.tt}")
    assert command(["robt=physical", "env.rewards.alive.weight=heavy"]) == 2
    message = capsys.readouterr().err
    assert "6 mistakes" in message
    for part in (
        "reward: 'heigth' is not an option (configs/task/stand.yaml:11)",
        "robt: there is no such key (override robt=physical)",
        "env.robot.length: Interpolation key 'env.sim.tt' not found (configs/robot/article.yaml:7)",
        "env.decimation: this value is missing (configs/task/stand.yaml:19)",
        "env.sim.impratios: nothing reads this key (configs/sim/mujoco.yaml:4)",
        "env.rewards.alive.weight: 'heavy' is not of the right type (override env.rewards.alive.weight=heavy)",
    ):
        assert f"\n  {part}" in message


def test_mistakes_behind_two_broken_files_are_told_as_well(command, edit, capsys):
    edit("robot/article.yaml", "order: [a, b]", "order: [a, b")
    edit("reward/height.yaml", "height:\n\tweight: 1.0\n")
    assert command(["env.num_envs=0", "env.robot.ordr=[a]"]) == 2
    message = capsys.readouterr().err
    assert "robot/article: the file is not valid YAML" in message
    assert "reward/height: the file is not valid YAML" in message
    assert "env.num_envs: 0 is out of range" in message
    assert "not selected" not in message, "a broken file makes its settings look like a mistake"


def test_a_list_that_overrides_nothing_does_not_hide_other_mistakes(command, edit, capsys):
    edit("task/walk.yaml", "- _self_", "- _self_\n  - override /reward@env.reward: [alive]")
    assert command(["task=walk", "env.num_envs=0"]) == 2
    message = capsys.readouterr().err
    assert "reward@env.reward: no file mounts a group under this name (configs/task/walk.yaml:7)" in message
    assert "env.num_envs: 0 is out of range" in message


def test_debug_shows_the_traceback(command, capsys):
    assert command(["--debug", "task=stnd"]) == 2
    assert "Traceback" in capsys.readouterr().err


def test_all_mistakes_are_told_at_once(command, capsys):
    words = [
        "env.num_envs=0",
        "+env.sim.x=1",
        "env.rewards.alive._target_=os.system",
        "~env.rewards.height.target_height",
    ]
    assert command(words) == 2
    message = capsys.readouterr().err
    assert "4 mistakes" in message
    for key in ("env.num_envs", "env.sim.x", "env.rewards.alive._target_", "env.rewards.height"):
        assert f"\n  {key}: " in message


def test_all_wrong_overrides_are_told_at_once(command, capsys):
    assert command(["env.rewards.heigth.weight=1", "~env.events.psh", "seed=2"]) == 2
    message = capsys.readouterr().err
    assert "2 mistakes" in message
    assert "env.rewards.heigth.weight" in message
    assert "env.events.psh" in message


@pytest.mark.parametrize(
    ("text", "told"),
    [
        (
            "# @package _global_\ndefaults: [walk, _self_]\nhydra:\n  run: {dir: x}\n  sweeper: {params: {seed: 1}}\n",
            ["hydra.run.dir: nothing reads this", "mine.yaml:4", "run.root=DIR"],
        ),
        (
            "# @package _global_\ndefaults: [walk, _self_]\nhydra: {sweeper: {max_batch_size: 2}}\n",
            ["hydra.sweeper.max_batch_size: nothing reads this", "mine.yaml:3", "hydra.sweeper.params"],
        ),
        (
            "# @package _global_\ndefaults:\n- walk\n- override /hydra/job_logging: disabled\n- _self_\n",
            ["hydra/job_logging: nothing reads this", "mine.yaml:4"],
        ),
    ],
    ids=["run directory", "sweeper", "choice"],
)
def test_a_setting_of_hydras_in_a_users_file_that_nothing_reads_is_told(text, told, command, user, capsys):
    file = user / "task" / "mine.yaml"
    file.parent.mkdir(exist_ok=True)
    file.write_text(text)
    _assert_told(command(["--config-dir", str(user), "task=mine"]), capsys, told)


def test_a_user_file_that_a_stock_file_hides_is_told(command, user, capsys):
    (user / "reward" / "alive.yaml").write_text("alive: {_target_: shelf_terms.alive, weight: 9.0}\n")
    assert command(["--config-dir", str(user)]) == 2
    message = capsys.readouterr().err
    assert "never read" in message
    assert "mine/configs/reward/alive.yaml" in message


def test_every_command_of_the_table_has_help():
    assert all(command.help for command in script.COMMANDS.values())
