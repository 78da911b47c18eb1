"""Parse command lines: the parser, and the options and helpers that several commands share."""

from __future__ import annotations

import argparse
import json
import re
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NoReturn

from wheelleg_exp.cli.printing.terminal import hanging, shown
from wheelleg_exp.errors import EXIT_INTERRUPTED, EXIT_OK, WheellegError, nearest_name, printable
from wheelleg_exp.files import dump_json, json_plain

if TYPE_CHECKING:
    from wheelleg_exp.config.composing.provenance import Source
    from wheelleg_exp.rl.ranks import Ranks
    from wheelleg_exp.run.run_directory import RunDirectory
    from wheelleg_exp.stop_request import StopRequest

    First = Callable[[argparse.Namespace, StopRequest, Ranks], int]
    Other = Callable[[argparse.Namespace, StopRequest, Ranks], None]


# What the shell completes an argument with: a kind of names, or the words themselves.
Candidates = Literal["run", "run to resume", "run or task", "override", "robot", "key", "group", "primary"]


class UsageError(WheellegError):
    """The command line is wrong."""


class Parser(argparse.ArgumentParser):
    """An argument parser that raises UsageError for an unknown option and suggests the most similar known option."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(**{"allow_abbrev": False, **kwargs})

    def error(self, message: str) -> NoReturn:
        """Convert an error message of argparse to a UsageError, and raise the UsageError."""
        known = [action for action in self._actions if action.help != argparse.SUPPRESS]
        options = [option for action in known for option in action.option_strings]
        if unknown := re.search(r"unrecognized arguments: (\S+)", message):
            word = unknown.group(1)
            if not word.startswith("-"):
                raise UsageError("one word too many", key=word)
            nearest, expected = nearest_name(word.split("=")[0], options), "one of " + ", ".join(options)
            if "=" in word and nearest is None:
                expected = f"an override without dashes, {word.lstrip('-')}"
            raise UsageError("unknown option", key=word, expected=expected, nearest=nearest)
        if missing := re.match(r"the following arguments are required: (.+)", message):
            # argparse lists even optional arguments as missing. A required one can have the same name.
            words = [action for action in self._actions if not action.option_strings]
            required = {str(action.metavar) for action in words if action.nargs not in ("*", "?")}
            optional = {str(action.metavar) for action in words} - required
            wanted = missing.group(1).split(", ")
            names = [name for name in wanted if name not in optional] or wanted
            raise UsageError("the argument is missing", key=", ".join(names))
        argument = re.match(r"argument (\S+): (.+)", message)
        if argument is None:
            raise UsageError(message, key=self.prog)
        key, text = argument.groups()
        if choice := re.match(r"invalid choice: '?(.*?)'? \(choose from (.+)\)", text):
            names = [name.strip(" '") for name in choice.group(2).split(",")]
            expected, nearest = "one of " + ", ".join(names), nearest_name(choice.group(1), names)
            raise UsageError(f"'{choice.group(1)}' is not known", key=key, expected=expected, nearest=nearest)
        if kind := re.match(r"invalid (\w+) value: '?(.*?)'?$", text):
            meant = {"int": "a whole number", "float": "a number", "Path": "a path"}.get(kind.group(1), kind.group(1))
            raise UsageError(f"'{kind.group(2)}' is not of the right type", key=key, expected=meant)
        raise UsageError(text, key=key)


def offer(candidates: Candidates | Sequence[str], action: argparse.Action) -> None:
    """Set the words with which the shell completes an argument; files complete an argument of type Path."""
    vars(action)["candidates"] = candidates


def add_overrides(parser: argparse.ArgumentParser) -> None:
    """Add arguments for Hydra overrides and ``--config-dir`` to the parser of a command that composes a config."""
    text = "task=stand, env.rewards.alive.weight=2, ~env.events.push_robot, +reward@env.rewards=action_rate, ..."
    offer("override", parser.add_argument("overrides", nargs="*", metavar="OVERRIDE", help=text))
    add_config_dir(parser)


def add_primary(parser: argparse.ArgumentParser) -> None:
    """Add ``--primary``."""
    text = "the primary config (default: the one that the key or the overrides belong to)"
    offer("primary", parser.add_argument("--primary", metavar="NAME", help=text))


def primary_of(args: argparse.Namespace, key: str = "") -> str:
    """Return the primary config: that of ``--primary``, otherwise the one that the overrides or the key belong to.

    Raise UsageError if words belong to a pipeline, and others to its trainings.
    """
    from wheelleg_exp.terms.key_syntax import PIPELINE, names_pipeline

    words = [word for word in (*args.overrides, key) if word and not word.startswith("hydra")]
    others = [word for word in words if not names_pipeline(word)]
    if args.primary is None and others and len(others) < len(words):
        message = f"the config of a pipeline has only the key '{PIPELINE}'; its phases are trainings of their own"
        expected = f"the task and the overrides of one phase, such as task=walk, instead of {PIPELINE}=..."
        raise UsageError(message, key=others[0], expected=expected)
    other = "play" if key.partition(".")[0] in ("drive", "play") else "train"
    return args.primary or (PIPELINE if words and not others else other)


def add_config_dir(parser: argparse.ArgumentParser) -> None:
    """Add the option ``--config-dir`` to a command's parser; users can repeat the option in one command."""
    text = "a folder of your own configs, a project, or the name of an installed project, searched after the stock "
    text += "configs (repeatable); the project in the current folder is found without this option"
    parser.add_argument(
        "--config-dir", dest="config_dirs", action="append", type=Path, default=[], metavar="DIR", help=text
    )


def add_root(parser: argparse.ArgumentParser) -> None:
    """Add ``--root``."""
    parser.add_argument("--root", type=Path, default=Path("runs"), help="the folder of the runs (default: runs)")


def add_stored(parser: argparse.ArgumentParser) -> None:
    """Add the option ``--stored``; its former name ``--kept`` still works."""
    text = "use a run's stored evaluation of this protocol instead of a new one"
    parser.add_argument("--stored", action="store_true", help=text)
    parser.add_argument("--kept", dest="stored", action="store_true", help=argparse.SUPPRESS)


def add_json(parser: argparse.ArgumentParser) -> None:
    """Add ``--json``."""
    parser.add_argument("--json", action="store_true", help="print one JSON document and nothing else")


def print_json(document: object) -> None:
    """Print one JSON document."""
    text = dump_json(document)
    # Write control characters as JSON escapes, because the output stream's own escapes are not valid JSON.
    if printable(text) != text:
        text = json.dumps(json_plain(document), indent=2, allow_nan=False) + "\n"
    print(text, end="")


def chosen_checkpoint(directory: RunDirectory, asked: str | None) -> Path:
    """Return a run's checkpoint by iteration or path, by default the last one; warn if the checkpoint was changed."""
    if asked is None:
        checkpoint = directory.latest_checkpoint()
    elif asked.isdigit():
        checkpoint = directory.checkpoint(int(asked))
    else:
        inside = directory.path / asked
        checkpoint = inside if inside.is_file() else Path(asked)
    own = checkpoint.is_file() and checkpoint.resolve().parent == directory.path.resolve()
    if own and not directory.manifest().matches_record(checkpoint):
        text = f"{checkpoint.name} differs from its run's record; see 'wheelleg verify {shown(directory.path)}'"
        print(hanging(printable(f"warning: {text}"), 4), file=sys.stderr)
    return checkpoint


def source_document(source: Source) -> dict[str, object]:
    """Return the file, line, or override that set a config value, as a JSON document."""
    file = None if source.file is None else str(source.file)
    facts = {"path": source.path, "value": source.value, "where": source.where}
    return {**facts, "file": file, "line": source.line, "override": source.override}


def together(first: First, other: Other, args: argparse.Namespace, stop: StopRequest) -> int:
    """Run ``first`` in rank 0 of torchrun's processes, and the silent ``other`` in the rest; return the exit status."""
    from wheelleg_exp.rl.ranks import FirstRankFailed, joined

    with joined() as ranks:
        if ranks.first:
            return first(args, stop, ranks)
        try:
            other(args, stop, ranks)
        except KeyboardInterrupt:
            return EXIT_INTERRUPTED
        except FirstRankFailed as error:
            return error.exit_code
        return EXIT_OK
