"""The commands and options that exist, taken from the parsers that ``wheelleg COMMAND --help`` builds."""

import argparse
import re
from dataclasses import dataclass
from typing import Any

import pytest

from .golden import command


@dataclass(frozen=True)
class Command:
    """The long names of the options of a command, without ``--help`` and ``--debug``, and its positional arguments."""

    options: list[str]
    arguments: list[str]


def parser_of(*words: str) -> argparse.ArgumentParser:
    seen: list[argparse.ArgumentParser] = []

    def remember(parser: argparse.ArgumentParser, file: Any = None) -> None:
        seen.append(parser)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(argparse.ArgumentParser, "print_help", remember)
        command(*words, "--help")
    (parser,) = seen
    return parser


def _read(name: str) -> Command:
    options, arguments = [], []
    for action in parser_of(name)._actions:
        if action.help == argparse.SUPPRESS:
            continue
        if action.option_strings:
            options.append(max(action.option_strings, key=len))
        else:
            choices = "{" + ",".join(map(str, action.choices)) + "}" if action.choices else action.dest
            arguments.append(str(action.metavar or choices))
    return Command([option for option in options if option not in ("--help", "--debug")], arguments)


COMMANDS = {name: _read(name) for name in re.findall(r"^  (\w[\w-]*)  +\S", parser_of().epilog or "", re.MULTILINE)}
