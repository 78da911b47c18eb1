import re

import pytest

from wheelleg_exp.cli.main import COMMANDS, main
from wheelleg_exp.cli.printing.terminal import print_blocks, print_table

COMMANDS_THAT_LIST = (
    *(["list", kind] for kind in ("tasks", "terms", "options", "groups")),
    ["check", "--list"],
    ["check", "--physics", "--all"],
    ["check", "--physics", "task=stand", "~check"],
    *(["explain", f"env.{key}"] for key in ("rewards.base_height", "rewards.base_height.weight", "sim.integrator")),
    *(["explain", key] for key in ("reward@env.rewards", "agent")),
    ["diff", "stand", "task=stand robot=explicit sim=fine reward@env.rewards=[alive] curriculum@env.curriculum=[]"],
    *(["compose", *words] for words in ([], ["--provenance", "env.rewards.alive.weight=2"], ["--shapes"])),
)
LONG = "one two three " * 12


@pytest.fixture
def terminal(monkeypatch):
    def be(columns):
        monkeypatch.setattr("sys.stdout.isatty", lambda: True, raising=False)
        monkeypatch.setenv("COLUMNS", str(columns))

    return be


def widest(text):
    return max(len(line) for line in re.sub(r"\x1b\[[0-9;]*m", "", text).splitlines())


@pytest.mark.parametrize("words", [*COMMANDS_THAT_LIST, *([name, "--help"] for name in COMMANDS)], ids=" ".join)
def test_no_line_is_wider_than_100_columns(words, capsys):
    assert main(words) in ((0,) if "--help" in words else (0, 1))
    assert widest(capsys.readouterr().out) <= 100


@pytest.mark.parametrize("columns", [60, 80, 200])
def test_a_terminal_is_filled_and_not_overrun(columns, terminal, capsys):
    terminal(columns)
    for words in (["check", "--physics", "--all"], ["list", "terms", "reward"], ["--help"], ["explain", "agent"]):
        assert main(words) == 0
        text = capsys.readouterr().out
        assert widest(text) <= max(columns, 70), words
        if columns == 200 and words[0] == "list":
            assert widest(text) > 100


def test_a_table_that_fits_stays_a_table(capsys):
    print_table(("a", "b"), [("x", 1), ("yy", None)])
    assert capsys.readouterr().out == "a   b\nx   1\nyy\n"


def test_a_wide_column_is_wrapped_in_its_place(capsys):
    print_table(("name", "text", "end"), [("x", LONG.strip(), "z"), ("y", "short", "z")])
    lines = capsys.readouterr().out.splitlines()
    assert widest("\n".join(lines)) <= 100
    assert lines[1].startswith("x     one two")
    assert lines[1].endswith("z")
    assert lines[2].startswith("      ")
    assert lines[-1].split() == ["y", "short", "z"]


def test_rows_that_cannot_be_a_table_are_blocks_with_a_line_for_each_cell(capsys):
    rows = [("rule", "a.key", "x" * 70, "y" * 70, "-"), ("other", "b.key", "", LONG.strip(), "z")]
    print_table(("", "", "place", "what", "hint"), rows, heads=2)
    lines = capsys.readouterr().out.splitlines()
    assert lines[:4] == ["rule  a.key", f"    place  {'x' * 70}", f"    what   {'y' * 70}", "other  b.key"]
    assert lines[4].startswith("    what  one two")
    assert lines[5].startswith("          ")
    assert lines[-1] == "    hint  z"
    print_blocks(("", "b", "cc"), [("name", "1", "2")])
    assert capsys.readouterr().out == "name\n    b   1\n    cc  2\n"
