"""What the commands share: the parser, the options of those that compose, tables and JSON."""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NoReturn

from wheelleg_exp.errors import WheellegError, nearest_name
from wheelleg_exp.run.files import dump_json


class UsageError(WheellegError):
    """The command line is wrong."""


class Parser(argparse.ArgumentParser):
    """A parser whose mistakes are errors for people, with the nearest option."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(**{"allow_abbrev": False, **kwargs})

    def error(self, message: str) -> NoReturn:
        """Raise the mistake as a UsageError."""
        options = [option for action in self._actions for option in action.option_strings]
        raise _unknown_word(message, options) or _wrong_value(message) or UsageError(message, key=self.prog)


def _unknown_word(message: str, options: Sequence[str]) -> UsageError | None:
    match = re.search(r"unrecognized arguments: (\S+)", message)
    if match is None:
        return None
    word = match.group(1)
    if not word.startswith("-"):
        return UsageError("one word too many", key=word)
    nearest = nearest_name(word.split("=")[0], options)
    return UsageError("unknown option", key=word, expected="one of " + ", ".join(options), nearest=nearest)


def _wrong_value(message: str) -> UsageError | None:
    """Explain what argparse says of one argument: a choice, a type, a count, or that it is missing."""
    missing = re.match(r"the following arguments are required: (.+)", message)
    if missing is not None:
        return UsageError("is missing", key=missing.group(1))
    argument = re.match(r"argument (\S+): (.+)", message)
    if argument is None:
        return None
    key, text = argument.group(1), argument.group(2)
    choice = re.match(r"invalid choice: '?(.*?)'? \(choose from (.+)\)", text)
    if choice is not None:
        names = [name.strip(" '") for name in choice.group(2).split(",")]
        expected, nearest = "one of " + ", ".join(names), nearest_name(choice.group(1), names)
        return UsageError(f"'{choice.group(1)}' is not known", key=key, expected=expected, nearest=nearest)
    kind = re.match(r"invalid (\w+) value: '?(.*?)'?$", text)
    if kind is not None:
        wanted = {"int": "a whole number", "float": "a number", "Path": "a path"}.get(kind.group(1), kind.group(1))
        return UsageError(f"'{kind.group(2)}' is not of the right type", key=key, expected=wanted)
    return UsageError(text, key=key)


def add_overrides(parser: argparse.ArgumentParser) -> None:
    """Add Hydra overrides and ``--config-dir``: what every command that composes takes."""
    parser.add_argument(
        "overrides",
        nargs="*",
        metavar="OVERRIDE",
        help="task=stand, env.rewards.alive.weight=2, ~env.events.push_robot, +reward@env.rewards=action_rate, ...",
    )
    add_config_dir(parser)


def add_config_dir(parser: argparse.ArgumentParser) -> None:
    """Add ``--config-dir``, which may be given several times."""
    parser.add_argument(
        "--config-dir",
        dest="config_dirs",
        action="append",
        type=Path,
        default=[],
        metavar="DIR",
        help="a folder of your own configs, a project, or the name of an installed one, searched after the stock "
        "configs (may be repeated); the project that one stands in is found by itself",
    )


def add_json(parser: argparse.ArgumentParser) -> None:
    """Add ``--json``."""
    parser.add_argument("--json", action="store_true", help="print one JSON document and nothing else")


def print_json(document: Any) -> None:
    """Print one JSON document."""
    print(dump_json(document), end="")


def print_table(
    columns: Sequence[str], rows: Sequence[Sequence[Any]], *, title: str | None = None, lines: bool = True
) -> None:
    """Print a table: with lines in a terminal (but for a wide one: ``lines``), as plain columns otherwise."""
    cells = [["" if cell is None else str(cell) for cell in row] for row in rows]
    if lines and sys.stdout.isatty():
        _print_rich(columns, cells, title)
    else:
        _print_plain(columns, cells)


def _print_rich(columns: Sequence[str], rows: Sequence[Sequence[str]], title: str | None) -> None:
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    grid = Table(title=title, title_justify="left")
    for column in columns:
        grid.add_column(column)
    for row in rows:
        grid.add_row(*(Text(cell) for cell in row))
    Console().print(grid)


def _print_plain(columns: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    lines = [list(columns), *rows]
    widths = [max(len(line[i]) for line in lines) for i in range(len(columns))]
    for line in lines:
        print("  ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)).rstrip())
