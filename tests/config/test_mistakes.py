"""Run ``wheelleg check`` on each mistake in ``mistakes.yaml``, and compare the error message."""

import json
import re
import sys
from collections import Counter, defaultdict
from collections.abc import Callable
from pathlib import Path

import pytest
import yaml

from wheelleg_exp.cli.main import main
from wheelleg_exp.terms import term_binding

MISTAKES = yaml.safe_load(Path(__file__).with_name("mistakes.yaml").read_text(encoding="utf-8"))


@pytest.fixture
def command(stock: object, monkeypatch: pytest.MonkeyPatch) -> Callable[[list[str]], int]:
    monkeypatch.setattr(term_binding, "allowed_packages", lambda: ("wheelleg_exp", "shelf_terms", "shelf_broken"))
    monkeypatch.delitem(sys.modules, "shelf_broken", raising=False)
    return lambda words: main(["check", *words])


def test_the_small_tree_has_no_mistakes(command, capsys):
    assert command([]) == 0, capsys.readouterr().err
    assert command(["task=walk"]) == 0, capsys.readouterr().err
    capsys.readouterr()
    assert command(["--json"]) == 0
    assert json.loads(capsys.readouterr().out) == {"mistakes": []}


def _groups() -> list[list[str]]:
    """Group overrides of different sections, because one check reports all their mistakes."""
    groups, uses = defaultdict(list), Counter()
    for name, case in MISTAKES.items():
        word, *more = case.get("words", [""])
        key = re.split("[=:]", word)[0].lstrip("+~").split("@")[-1].split(".")
        section = str(key[: 2 if key[0] == "env" else 1])
        alone = more or word.startswith(("--", "hydra.searchpath", "task=[")) or case.keys() - {"words", "message"}
        groups[name if alone else uses[section]].append(name)
        uses[section] += 1
    return list(groups.values())


@pytest.mark.parametrize("names", _groups(), ids=lambda names: names[0])
def test_a_mistake_is_reported_once_with_key_place_and_nearest_name(names, command, edit, capsys):
    case, *others = cases = [MISTAKES[name] for name in names]
    for file, *texts in case.get("edits", ()):
        edit(file, *texts)
    status = command([word for case in cases for word in case.get("words", [])])
    if not others:
        return _assert_reported(status, capsys, case["message"], case.get("several", False), case.get("without", ()))
    _, *told = capsys.readouterr().err.splitlines()
    assert (status, len(told)) == (2, len(cases)), told
    assert [c for c in cases if not any(all(part in line for part in c["message"]) for line in told)] == [], told


def _assert_reported(status, capsys, parts, several=False, without=()):
    captured = capsys.readouterr()
    assert (status, captured.out) == (2, ""), captured.err
    assert captured.err.startswith("wheelleg: error: ")
    assert "Traceback" not in captured.err
    assert several == ("mistakes in the config" in captured.err)
    assert several or len(captured.err.splitlines()) == 1
    assert [part for part in parts if part not in captured.err] == []
    assert [part for part in without if part in captured.err] == []


def test_a_mistake_as_json_has_key_file_line_and_nearest_name(command, edit, capsys):
    edit("task/stand.yaml", "[alive, height]", "[alive, heigth]")
    assert command(["--json", "env.num_envs=0"]) == 2
    captured = capsys.readouterr()
    assert captured.err == ""
    first, second = json.loads(captured.out)["mistakes"]
    assert (first["key"], first["file"], first["line"]) == ("reward", "configs/task/stand.yaml", 11)
    assert (first["nearest"], first["override"]) == ("height", None)
    assert (second["key"], second["override"], second["file"]) == ("env.num_envs", "env.num_envs=0", None)


def test_unread_settings_of_hydra_in_a_users_file_are_reported(command, user, capsys):
    defaults = "# @package _global_\ndefaults:\n- walk\n- override /hydra/job_logging: disabled\n- _self_\n"
    text = "hydra:\n  run: {dir: x}\n  sweeper: {params: {seed: 1}, max_batch_size: 2}\n"
    (user / "task" / "mine.yaml").write_text(defaults + text)
    expected = ["hydra.run.dir: nothing reads this", "mine.yaml:7", "run.root=DIR",
                "hydra.sweeper.max_batch_size: nothing reads this", "mine.yaml:8", "hydra.sweeper.params",
                "hydra/job_logging: nothing reads this", "mine.yaml:4", "3 mistakes"]  # fmt: skip
    _assert_reported(command(["--config-dir", str(user), "task=mine"]), capsys, expected, several=True)


def test_a_user_file_that_a_stock_file_hides_is_reported(command, user, capsys):
    (user / "reward" / "alive.yaml").write_text("alive: {_target_: shelf_terms.alive, weight: 9.0}\n")
    assert command(["--config-dir", str(user)]) == 2
    message = capsys.readouterr().err
    assert "never read" in message
    assert "mine/configs/reward/alive.yaml" in message


@pytest.mark.parametrize("text", ["alive:\n  weight: [\n", "alife:\n  _target_: shelf_terms.alive\n  weight: 1.0\n"])
def test_a_broken_file_of_a_term_hides_no_other_mistake_and_makes_none(text, command, edit, capsys):
    edit("reward/alive.yaml", text)
    edit("task/stand.yaml", "  rewards:\n", "  rewards:\n    alive: {weight: 2.0}\n")
    edit("task/stand.yaml", "  - _self_", "  - /curriculum@env.curriculum: [later]\n  - _self_")
    later = "later:\n  _target_: wheelleg_exp.mdp.curriculums.modify_reward_weight\n"
    edit("curriculum/later.yaml", later + "  term_name: alive\n  weight: 1.0\n  num_steps: 10\n")
    expected = ["3 mistakes in the config", "alive.yaml", "env.num_envs: 0 is out of range", "'heavy'"]
    status = command(["env.num_envs=0", "env.rewards.height.weight=heavy"])
    _assert_reported(status, capsys, expected, several=True)
