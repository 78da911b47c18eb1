"""Mistakes that users make, by where they make them: one message each, with key, place and nearest name.

What follows from a mistake is not told, what stands at several keys is told once, and no message is a library's.
"""

from __future__ import annotations

from collections.abc import Callable

import pytest

from wheelleg_exp.cli.main import main
from wheelleg_exp.terms import term_binding

STAND, HEIGHT, ALIVE = "task/stand.yaml", "reward/height.yaml", "reward/alive.yaml"
SPEED, PUSH, EFFORT = "observation/speed.yaml", "event/push.yaml", "action/effort.yaml"
MINE = "# @package _global_\n# Mine.\ndefaults:\n  - stand\n{}  - _self_\ntask: {{name: mine}}\n"


def mine(*lines: str) -> tuple[str, str]:
    """A task of one's own, with lines in its defaults list."""
    return "task/mine.yaml", MINE.format("".join(f"  - {line}\n" for line in lines))


# where, what -> edits of the small tree (file, then old and new text, or all of it), words, parts of the message
SEEDED: dict[tuple[str, str], tuple[list[tuple[str, ...]], list[str], list[str]]] = {
    # --- a defaults list ---
    ("defaults", "an agent without override"): (
        [mine("/agent: ppo")],
        ["task=mine"],
        ["agent: an option of this group is selected already (configs/task/mine.yaml:5)", "- override /agent: ppo"],
    ),
    ("defaults", "a robot without override"): (
        [mine("/robot: physical")],
        ["task=mine"],
        [
            "robot: an option of this group is selected already (configs/task/mine.yaml:5)",
            "- override /robot: physical",
        ],
    ),
    ("defaults", "an override before other entries"): (
        [mine("override /robot: physical", "/reward@env.rewards: [smooth]")],
        ["task=mine"],
        ["robot: this override comes before other entries", "configs/task/mine.yaml:5", "after all other entries"],
    ),
    ("defaults", "an override without its slash"): (
        [mine("override reward@env.rewards: [alive]")],
        ["task=mine"],
        [
            "task/reward@env.rewards: the group's name lacks its leading slash",
            "mine.yaml:5",
            "- override /reward@env.rewards",
        ],
    ),
    ("defaults", "a list in an observation group itself"): (
        [(STAND, "/observation@env.observations.policy.terms:", "/observation@env.observations.policy:")],
        [],
        [
            "env.observations.policy: terms are mounted at 'env.observations.policy', which is not a list of terms",
            "configs/task/stand.yaml:8",
            "did you mean 'observation@env.observations.policy.terms'",
        ],
    ),
    ("defaults", "a package line that is nearly right"): (
        [(STAND, "# @package _global_", "# @package global")],
        [],
        ["task/stand: this file's package line names 'global'", "configs/task/stand.yaml:1", "'# @package _global_'"],
    ),
    ("defaults", "a robot's package line that is nearly right"): (
        [("robot/article.yaml", "# @package env.robot", "# @package env.robo")],
        [],
        ["robot/article: this file's package line names 'env.robo'", "configs/robot/article.yaml:1", "env.robot"],
    ),
    ("defaults", "a missing comma"): (
        [(STAND, "[alive, height]", "[alive height]")],
        [],
        ["reward: 'alive height' is not an option", "configs/task/stand.yaml:11"],
    ),
    # --- the body of a task ---
    ("body", "a misspelled term"): (
        [(STAND, "    height:\n", "    heigth:\n")],
        [],
        ["env.rewards.heigth: there are settings for this term", "configs/task/stand.yaml:23", "did you mean 'height'"],
    ),
    ("body", "a misspelled observation group"): (
        [(STAND, "    policy: {enable", "    polcy: {enable")],
        [],
        ["env.observations.polcy: there are settings for this group", "stand.yaml:25", "did you mean 'policy'"],
    ),
    ("body", "no name of the task"): (
        [(STAND, "task:\n  name: stand\n", "")],
        [],
        ["task: this value is missing (configs/task/stand.yaml); expected a mapping"],
    ),
    # --- a file of a term ---
    ("file", "a list in place of a mapping"): (
        [(ALIVE, "- alive\n")],
        [],
        ["reward/alive: the file does not contain a mapping", "configs/reward/alive.yaml:1"],
    ),
    ("file", "no target"): (
        [(ALIVE, "alive:\n  weight: 1.0\n")],
        [],
        ["env.rewards.alive: this file's term has no _target_", "configs/reward/alive.yaml:1", "package.module.name"],
    ),
    ("file", "a misspelled target key"): (
        [(ALIVE, "_target_:", "_taget_:")],
        [],
        ["env.rewards.alive._taget_: nothing reads this key", "alive.yaml:2", "did you mean '_target_'"],
    ),
    ("file", "a target key without underscores"): (
        [(ALIVE, "_target_:", "target:")],
        [],
        ["env.rewards.alive.target: nothing reads this key", "alive.yaml:2", "did you mean '_target_'"],
    ),
    ("file", "parameters as Isaac Lab writes them"): (
        [(HEIGHT, "  target_height: 0.07", "  params: {target_height: 0.07}")],
        [],
        ["env.rewards.height.params:", "target_height next to _target_, not below 'params'", "height.yaml:5"],
    ),
    ("file", "a misspelled parameter without a default"): (
        [(HEIGHT, "target_height", "target_heigth")],
        [],
        ["env.rewards.height.target_heigth:", "height.yaml:5", "did you mean 'target_height'"],
    ),
    ("file", "a misspelled package"): (
        [(ALIVE, "shelf_terms.alive", "shlef_terms.alive")],
        [],
        ["env.rewards.alive._target_:", "outside the allowed packages", "did you mean 'shelf_terms.alive'"],
    ),
    ("file", "a colon in a target"): (
        [(ALIVE, "shelf_terms.alive", "shelf_terms.x:alive")],
        [],
        ["env.rewards.alive._target_:", "did you mean 'shelf_terms.x.alive'"],
    ),
    ("file", "a term of another section"): (
        [(ALIVE, "shelf_terms.alive", "wheelleg_exp.mdp.terminations.time_out\n  std: 0.1")],
        [],
        ["env.rewards.alive._target_:", "is a term of terminations", "alive.yaml:2"],
    ),
    ("file", "a name in two groups"): (
        [(SPEED, "_target_: shelf_terms.speed", "_target_: shelf_terms.sped")],
        [],
        ["env.observations.policy.terms.speed._target_:", "speed.yaml:2", "did you mean 'speed'"],
    ),
    ("file", "no name in two groups"): (
        [(SPEED, "_target_: shelf_terms.speed\n")],
        [],
        ["env.observations.policy.terms.speed: this file does not contain the key 'speed'", "observation/speed.yaml:1"],
    ),
    # --- a target of one's own ---
    ("code", "an import of what is not there"): (
        [("../shelf_broken.py", "import scipyy\n")],
        ["env.rewards.alive._target_=shelf_broken.alive"],
        ["cannot import 'shelf_broken': No module named 'scipyy'", "a module that can be imported"],
    ),
    ("code", "a syntax error"): (
        [("../shelf_broken.py", "def alive(env)\n")],
        ["env.rewards.alive._target_=shelf_broken.alive"],
        ["cannot import 'shelf_broken': SyntaxError: expected ':' (shelf_broken.py, line 1)", "can be imported"],
    ),
    ("code", "a function without env"): (
        [("../shelf_broken.py", "def alive(): ...\n")],
        ["env.rewards.alive._target_=shelf_broken.alive"],
        ["env.rewards.alive: 'shelf_broken.alive' takes (), and is called with (env) first", "def alive(env, ...)"],
    ),
    ("code", "an event without env_ids"): (
        [("../shelf_broken.py", "def push(env, velocity_range): ...\n")],
        ["env.events.push._target_=shelf_broken.push"],
        ["env.events.push:", "is called with (env, env_ids) first", "expected def push(env, env_ids, ...)"],
    ),
    ("code", "a class that is no term"): (
        [("../shelf_broken.py", "class alive:\n    def __init__(self, env): ...\n")],
        ["env.rewards.alive._target_=shelf_broken.alive"],
        [
            "env.rewards.alive: 'shelf_broken.alive' is not a subclass of TermBase",
            "a subclass of TermBase or a function",
        ],
    ),
    ("code", "a term that cannot be called"): (
        [
            (
                "../shelf_broken.py",
                "from wheelleg_exp.managers import TermBase\n"
                "class alive(TermBase):\n    def __init__(self, env): ...\n",
            )
        ],
        ["env.rewards.alive._target_=shelf_broken.alive"],
        ["env.rewards.alive: 'shelf_broken.alive' cannot be called", "def __call__(self, env)"],
    ),
    ("code", "a function as an action"): (
        [],
        ["env.actions.effort._target_=shelf_terms.alive"],
        ["env.actions.effort: 'shelf_terms.alive' is not a subclass of ActionTerm", "a subclass of ActionTerm"],
    ),
    # --- overrides ---
    ("overrides", "blanks around the equals sign"): (
        [],
        ["env.num_envs", "=", "4"],
        ["env.num_envs = 4: these are several words", "expected env.num_envs=4, without spaces"],
    ),
    ("overrides", "a blank behind the equals sign"): (
        [],
        ["env.num_envs=", "4"],
        ["env.num_envs= 4: these are several words", "expected env.num_envs=4, without spaces"],
    ),
    ("overrides", "a colon"): ([], ["env.num_envs:4"], ["env.num_envs:4: not an override", "expected env.num_envs=4"]),
    ("overrides", "two equals signs"): (
        [],
        ["env.num_envs==4"],
        ["env.num_envs==4: not an override: extraneous input '=' (override env.num_envs==4); expected key=value"],
    ),
    ("overrides", "dashes"): (
        [],
        ["--env.num_envs=4"],
        ["--env.num_envs=4: unknown option; expected an override without dashes, env.num_envs=4"],
    ),
    ("overrides", "a misspelled interpolation"): (
        [],
        ["env.num_envs=${sed}"],
        ["env.num_envs: Interpolation key 'sed' not found", "override env.num_envs=${sed}", "did you mean 'seed'"],
    ),
    ("overrides", "a variable that is not set"): (
        [],
        ["env.num_envs=${oc.env:NO_SUCH_VARIABLE}"],
        ["env.num_envs: Environment variable 'NO_SUCH_VARIABLE' not found (override"],
    ),
    ("overrides", "a key below an empty section"): (
        [],
        ["env.curriculum.later.weight=1"],
        ["env.curriculum.later.weight: there is no such key", "override env.curriculum.later.weight=1"],
    ),
    ("overrides", "a deleted network"): (
        [],
        ["~agent.actor"],
        ["agent.actor: this value is missing (override ~agent.actor)"],
    ),
    ("overrides", "other capitals"): (
        [],
        ["env.sim.solver=Newton"],
        ["env.sim.solver: 'Newton' is not known", "did you mean 'newton'"],
    ),
    # --- the agent ---
    ("agent", "no distribution"): (
        [],
        ["~agent.actor.distribution_cfg"],
        ["agent.actor.distribution_cfg: this value is missing (override ~agent.actor.distribution_cfg)", "class_name"],
    ),
    ("agent", "a part of a class's name"): (
        [],
        ["agent.actor.distribution_cfg.class_name=Gaussian"],
        ["there is no class 'Gaussian'", "did you mean 'GaussianDistribution'"],
    ),
}  # fmt: skip


@pytest.fixture
def command(stock: object, monkeypatch: pytest.MonkeyPatch) -> Callable[[list[str]], int]:
    """Run ``wheelleg check``, with the words that come after it."""
    monkeypatch.setattr(term_binding, "allowed_packages", lambda: ("wheelleg_exp", "shelf_terms", "shelf_broken"))
    monkeypatch.delitem(__import__("sys").modules, "shelf_broken", raising=False)
    return lambda words: main(["check", *words])


@pytest.mark.parametrize("mistake", SEEDED, ids=": ".join)
def test_a_mistake_is_told_once_with_key_place_and_what_to_write(mistake, command, edit, capsys):
    edits, words, parts = SEEDED[mistake]
    for file, *texts in edits:
        edit(file, *texts)
    assert command(words) == 2
    told = capsys.readouterr()
    assert told.out == ""
    assert "mistakes in the config" not in told.err
    assert len(told.err.splitlines()) == 1
    for part in parts:
        assert part in told.err


# What is broken -> other mistakes, which are told beside it; nothing else is.
BESIDE = [("env.num_envs=0", "env.num_envs: 0 is out of range"), ("env.rewards.height.weight=heavy", "'heavy'")]
BROKEN = {
    "does not parse": "alive:\n  weight: [\n",
    "lacks its key": "_target_: shelf_terms.alive\nweight: 1.0\n",
    "is empty": "",
    "has another key": "alife:\n  _target_: shelf_terms.alive\n  weight: 1.0\n",
}


@pytest.mark.parametrize("how", BROKEN)
def test_a_broken_file_of_a_term_hides_no_other_mistake_and_makes_none(how, command, edit, capsys):
    edit(ALIVE, BROKEN[how])
    edit(STAND, "  rewards:\n", "  rewards:\n    alive: {weight: 2.0}\n")
    edit(STAND, "  - _self_", "  - /curriculum@env.curriculum: [later]\n  - _self_")
    later = "later:\n  _target_: wheelleg_exp.mdp.curriculums.modify_reward_weight\n"
    edit("curriculum/later.yaml", later + "  term_name: alive\n  weight: 1.0\n  num_steps: 10\n")
    assert command([word for word, _ in BESIDE]) == 2
    message = capsys.readouterr().err
    for _, told in BESIDE:
        assert told in message
    assert message.startswith("wheelleg: error: 3 mistakes in the config"), message
    assert "alive.yaml" in message


def test_a_broken_task_makes_no_key_of_an_override_unknown(command, edit, capsys):
    edit("task/broken.yaml", "# @package _global_\ndefaults: [stand, _self_]\nenv: {rewards: {\n")
    assert command(["task=broken", "env.num_envs=3"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "task/broken: the file is not valid YAML" in line


def test_a_command_of_a_broken_file_is_no_mistake_of_those_that_name_it(command, edit, capsys):
    edit("command/drive.yaml", "drive:\n  weight: [\n")
    edit(STAND, "  - _self_", "  - /command@env.commands: [drive]\n  - _self_")
    words = ["+env.rewards.track={_target_: wheelleg_exp.mdp.rewards.track_lin_vel_xy_exp, weight: 1, std: 1, "
             "command_name: drive}"]  # fmt: skip
    assert command(words) == 2
    assert "command/drive: the file is not valid YAML" in (message := capsys.readouterr().err)
    assert "there is no command" not in message
