"""The commands and options that exist: taken from the parsers that ``wheelleg COMMAND --help`` builds."""

from __future__ import annotations

import argparse
import re
from dataclasses import dataclass
from typing import Any

import pytest

from .golden import command


@dataclass(frozen=True)
class Command:
    """What a command accepts.

    Attributes:
        options: the long name of each option, ``--help`` and ``--debug`` excluded.
        arguments: the name of each positional argument, or its choices in braces.
    """

    options: list[str]
    arguments: list[str]


def parser_of(*words: str) -> argparse.ArgumentParser:
    """Return the parser that prints the help of a command line."""
    seen: list[argparse.ArgumentParser] = []

    def remember(parser: argparse.ArgumentParser, file: Any = None) -> None:
        seen.append(parser)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(argparse.ArgumentParser, "print_help", remember)
        command(*words, "--help")
    (parser,) = seen
    return parser


def _read(name: str) -> Command:
    actions = parser_of(name)._actions
    options = [max(action.option_strings, key=len) for action in actions if action.option_strings]
    arguments = [_label(action) for action in actions if not action.option_strings]
    return Command([option for option in options if option not in ("--help", "--debug")], arguments)


def _label(action: argparse.Action) -> str:
    if action.metavar:
        return str(action.metavar)
    return "{" + ",".join(map(str, action.choices)) + "}" if action.choices else action.dest


COMMANDS = {name: _read(name) for name in re.findall(r"^  (\w[\w-]*)  +\S", parser_of().epilog or "", re.MULTILINE)}
