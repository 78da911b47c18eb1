"""ledger.yaml names every command, option, README row and docs page, each with a test that exists."""

import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import yaml

from .golden import REPOSITORY
from .parsers import COMMANDS
from .test_commands import LINES

LEDGER: dict[str, Any] = yaml.safe_load(Path(__file__).with_name("ledger.yaml").read_text(encoding="utf-8"))
TABLE = "table"  # A line of test_commands.py uses the option.


@cache
def files_by_test(folder: str) -> dict[str, list[Path]]:
    found: dict[str, list[Path]] = {}
    for path in sorted((REPOSITORY / folder).rglob("test_*.py")):
        for name in re.findall(r"^def (test_\w+)\(", path.read_text(encoding="utf-8"), re.MULTILINE):
            found.setdefault(name, []).append(path)
    return found


def entries(ledger: dict[str, Any]) -> Iterator[tuple[str, str]]:
    for part in ("rows", "pages"):
        for name, entry in ledger[part].items():
            yield from ((f"{part}: {name}", test) for test in entry["tests"])
    for name, tests in ledger["every command"].items():
        yield f"every command: {name}", tests
    for name, entry in ledger["commands"].items():
        yield from ((f"commands: {name} {option}", test) for option, test in entry["options"].items() if test != TABLE)


def missing_tests(ledger: dict[str, Any]) -> list[str]:
    named = [(place, test, *test.split("::")) for place, test in entries(ledger)]
    return [
        f"{place}: there is no test {test}"
        for place, test, folder, function in named
        if function not in files_by_test(folder)
    ]


def unused_options(ledger: dict[str, Any]) -> list[str]:
    """Return the options that their test, or any line of the table, does not use."""
    used = {(line.words.split()[0], word) for line in LINES for word in line.options}
    short = {"--output": "-o"}
    found = []
    for name, entry in ledger["commands"].items():
        for option, test in entry["options"].items():
            if test == TABLE:
                if not {(name, option), (name, short.get(option, option))} & used:
                    found.append(f"{name} {option}: no line of test_commands.py uses it")
                continue
            folder, _, function = test.partition("::")
            texts = [path.read_text(encoding="utf-8") for path in files_by_test(folder).get(function, [])]
            if not any(re.search(rf'["\' ]{option}["\'= ]', text) for text in texts):
                found.append(f"{name} {option}: the file of {test} does not contain it")
    return found


def rows_of_readme() -> list[str]:
    text = (REPOSITORY / "README.md").read_text(encoding="utf-8")
    _, _, table = text.partition("| you want to |")
    rows = re.findall(r"^\| (.+?) \|", table.partition("\n\n")[0], re.MULTILINE)
    return [row for row in rows if not set(row) <= {"-", " "}]


def test_every_named_test_exists():
    assert missing_tests(LEDGER) == []


def test_every_option_is_used_by_its_test():
    assert unused_options(LEDGER) == []


def test_the_commands_are_those_of_the_ledger():
    assert list(COMMANDS) == list(LEDGER["commands"])


@pytest.mark.parametrize("name", COMMANDS)
def test_the_options_and_arguments_of_a_command_are_those_of_the_ledger(name: str):
    entry = LEDGER["commands"][name]
    assert sorted(COMMANDS[name].options) == sorted(entry["options"])
    assert COMMANDS[name].arguments == entry["arguments"]


def test_the_rows_of_the_readme_are_those_of_the_ledger():
    assert rows_of_readme() == list(LEDGER["rows"])


def test_the_pages_of_the_manual_are_those_of_the_ledger():
    pages = sorted(str(path.relative_to(REPOSITORY)) for path in (REPOSITORY / "docs").rglob("*.md"))
    assert pages == sorted(LEDGER["pages"])


def test_every_row_and_page_names_a_test_and_every_page_its_promise():
    for name, entry in {**LEDGER["rows"], **LEDGER["pages"]}.items():
        assert entry["tests"], name
        assert set(entry) <= {"promise", "tests", "via"}, name
        assert entry.get("via") in (None, "python"), name
    assert all(entry["promise"] for entry in LEDGER["pages"].values())


def test_a_test_that_is_gone_is_found():
    row = {"tests": ["tests/cli::test_that_nobody_wrote", "tests/nowhere::test_x"]}
    changed = {"rows": {"a row": row}, "pages": {}, "every command": {}, "commands": {}}
    assert [line.rpartition(" ")[2] for line in missing_tests(changed)] == row["tests"]


def test_an_option_that_no_test_uses_is_found():
    options = {"--config-dir": TABLE, "--live": TABLE, "--fast": "tests/promises::test_debug_shows_a_traceback"}
    changed = {**LEDGER, "commands": {"train": {"options": options, "arguments": []}}}
    assert [line.partition(":")[0] for line in unused_options(changed)] == ["train --live", "train --fast"]
