"""Run ``wheelleg check`` on each mistake in ``mistakes.yaml``, and compare the error message."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
import yaml

from wheelleg_exp.cli import main as script
from wheelleg_exp.cli.main import main
from wheelleg_exp.terms import term_binding

MISTAKES = yaml.safe_load(Path(__file__).with_name("mistakes.yaml").read_text(encoding="utf-8"))


@pytest.fixture
def command(stock: object, monkeypatch: pytest.MonkeyPatch) -> Callable[[list[str]], int]:
    monkeypatch.setattr(term_binding, "allowed_packages", lambda: ("wheelleg_exp", "shelf_terms", "shelf_broken"))
    monkeypatch.delitem(sys.modules, "shelf_broken", raising=False)
    return lambda words: main(["check", *words])


def test_the_small_tree_is_free_of_mistakes(command, capsys):
    assert command([]) == 0, capsys.readouterr().err
    assert command(["task=walk"]) == 0, capsys.readouterr().err


@pytest.mark.parametrize("name", MISTAKES)
def test_a_mistake_is_reported_once_with_key_place_and_nearest_name(name, command, edit, capsys):
    case = MISTAKES[name]
    for file, *texts in case.get("edits", ()):
        edit(file, *texts)
    _assert_reported(command(case.get("words", [])), capsys, case["message"], several=case.get("several", False))


def _assert_reported(status, capsys, parts, *, several=False):
    captured = capsys.readouterr()
    assert (status, captured.out) == (2, ""), captured.err
    assert captured.err.startswith("wheelleg: error: ")
    assert "Traceback" not in captured.err
    assert several == ("mistakes in the config" in captured.err)
    assert several or len(captured.err.splitlines()) == 1
    assert [part for part in parts if part not in captured.err] == []


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
    words = ["env.num_envs=0", "+env.sim.x=1", "env.rewards.alive._target_=os.system", "~env.events.psh"]
    assert command([*words, "~env.rewards.height.target_height"]) == 2
    message = capsys.readouterr().err
    assert "5 mistakes" in message
    for key in ("env.num_envs", "env.sim.x", "env.rewards.alive._target_", "env.rewards.height", "env.events.psh"):
        assert f"\n  {key}: " in message


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
    _assert_reported(command(["--config-dir", str(user), "task=mine"]), capsys, told)


def test_a_user_file_that_a_stock_file_hides_is_told(command, user, capsys):
    (user / "reward" / "alive.yaml").write_text("alive: {_target_: shelf_terms.alive, weight: 9.0}\n")
    assert command(["--config-dir", str(user)]) == 2
    message = capsys.readouterr().err
    assert "never read" in message
    assert "mine/configs/reward/alive.yaml" in message


# Each broken entry, and the only other mistakes that the check reports with it.
BESIDE = [("env.num_envs=0", "env.num_envs: 0 is out of range"), ("env.rewards.height.weight=heavy", "'heavy'")]
BROKEN = {
    "does not parse": "alive:\n  weight: [\n",
    "lacks its key": "_target_: shelf_terms.alive\nweight: 1.0\n",
    "is empty": "",
    "has another key": "alife:\n  _target_: shelf_terms.alive\n  weight: 1.0\n",
}


@pytest.mark.parametrize("how", BROKEN)
def test_a_broken_file_of_a_term_hides_no_other_mistake_and_makes_none(how, command, edit, capsys):
    edit("reward/alive.yaml", BROKEN[how])
    edit("task/stand.yaml", "  rewards:\n", "  rewards:\n    alive: {weight: 2.0}\n")
    edit("task/stand.yaml", "  - _self_", "  - /curriculum@env.curriculum: [later]\n  - _self_")
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
    edit("task/stand.yaml", "  - _self_", "  - /command@env.commands: [drive]\n  - _self_")
    words = ["+env.rewards.track={_target_: wheelleg_exp.mdp.rewards.track_lin_vel_xy_exp, weight: 1, std: 1, "
             "command_name: drive}"]  # fmt: skip
    assert command(words) == 2
    assert "command/drive: the file is not valid YAML" in (message := capsys.readouterr().err)
    assert "there is no command" not in message


def test_every_command_of_the_table_has_help():
    assert all(command.help for command in script.COMMANDS.values())
