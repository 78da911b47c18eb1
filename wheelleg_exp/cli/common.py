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
        wrong = re.search(r"unrecognized arguments: (\S+)", message)
        word = wrong.group(1) if wrong else None
        raise UsageError(
            "unknown option" if word and word.startswith("-") else message,
            key=word or self.prog,
            expected="one of " + ", ".join(options) if word and word.startswith("-") else None,
            nearest=nearest_name(word.split("=")[0], options) if word else None,
        )


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
        help="a folder of your own configs, searched after the stock ones (may be repeated)",
    )


def add_json(parser: argparse.ArgumentParser) -> None:
    """Add ``--json``."""
    parser.add_argument("--json", action="store_true", help="print one JSON document and nothing else")


def print_json(document: Any) -> None:
    """Print one JSON document."""
    print(dump_json(document), end="")


def print_table(columns: Sequence[str], rows: Sequence[Sequence[Any]], *, title: str | None = None) -> None:
    """Print a table: with lines in a terminal, as plain columns otherwise."""
    cells = [["" if cell is None else str(cell) for cell in row] for row in rows]
    if sys.stdout.isatty():
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
