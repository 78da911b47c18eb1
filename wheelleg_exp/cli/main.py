"""The console script ``wheelleg``: finds the command, imports its module alone, returns the exit status."""

from __future__ import annotations

import argparse
import os
import signal
import sys
import threading
import traceback
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from importlib import import_module
from types import FrameType

from wheelleg_exp import __version__
from wheelleg_exp.cli.common import Parser, UsageError
from wheelleg_exp.errors import EXIT_FAILED, EXIT_INTERRUPTED, EXIT_OK, ConfigError, WheellegError, nearest_name
from wheelleg_exp.projects import with_current
from wheelleg_exp.threads import prepare_threads


@dataclass(frozen=True)
class Command:
    """A command: the module with ``configure(parser)`` and the function ``run(args) -> int``; its help.

    ``project`` says whether it works in the project of the user's that one stands in.
    """

    module: str
    help: str
    run: str = "run"
    project: bool = True


COMMANDS: dict[str, Command] = {
    "train": Command("train", "compose, check, train, and write one run directory"),
    "resume": Command("resume", "go on with a run that was stopped or killed, as if it had never been"),
    "play": Command("play", "run a policy and record it"),
    "zero-agent": Command("agents", "run a task with zero actions and record it", "run_zero"),
    "random-agent": Command("agents", "run a task with random actions and record it", "run_random"),
    "report": Command("report", "write one HTML file about a run, for people"),
    "replay": Command("replay", "train a run again from its snapshot, with its own code, and compare", project=False),
    "verify": Command("verify", "hold a run against its own manifest, or two runs against each other", project=False),
    "inspect": Command("inspect", "tell what a recording holds, and answer questions about it"),
    "convert": Command("convert", "convert a robot file to MJCF, with a report", project=False),
    "check": Command("check", "find every mistake in a config, and with --physics look at its numbers"),
    "compose": Command("compose", "print the composed config"),
    "explain": Command("explain", "say what a key holds, who set it, what it means, what else could stand there"),
    "diff": Command("diff", "compare two runs, tasks or lists of overrides by meaning"),
    "list": Command("list", "list tasks, terms, groups, options or runs"),
    "new": Command("new", "make a project of your own: a robot, a task, a term and a test", project=False),
    "completion": Command("completion", "print the shell's completion script", project=False),
}


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command and return the exit status.

    Args:
        argv: the words after ``wheelleg``; by default the process's own.
    """
    prepare_threads()
    words = list(sys.argv[1:] if argv is None else argv)
    debug = "--debug" in words
    try:
        with _terminate_is_interrupt():
            status = _dispatch(words)
            sys.stdout.flush()
            return status
    except BrokenPipeError:
        _silence_stdout()
        return EXIT_OK
    except KeyboardInterrupt:
        return _failed("interrupted", EXIT_INTERRUPTED, debug)
    except WheellegError as error:
        return _failed(str(error), error.exit_code, debug)
    except Exception as error:
        hint = "" if debug else " (--debug shows the traceback)"
        notes = "".join(f", {note}" for note in getattr(error, "__notes__", ()))
        return _failed(f"{type(error).__name__}: {error}{notes}{hint}", EXIT_FAILED, debug)


def _dispatch(words: list[str]) -> int:
    parser = _script_parser()
    split = next((i for i, word in enumerate(words) if not word.startswith("-")), len(words))
    options = _parse(parser, words[:split])
    if options is None:
        return EXIT_OK
    if split == len(words):
        raise UsageError("a command is missing", key="wheelleg", expected="one of " + ", ".join(COMMANDS))
    return _run(words[split], words[split + 1 :])


def _run(name: str, words: list[str]) -> int:
    command = COMMANDS.get(name)
    if command is None:
        raise UsageError(
            "there is no such command",
            key=name,
            expected="one of " + ", ".join(COMMANDS),
            nearest=nearest_name(name, COMMANDS),
        )
    module = import_module(f"wheelleg_exp.cli.{command.module}")
    parser = Parser(prog=f"wheelleg {name}", description=f"{command.help[0].upper()}{command.help[1:]}.")
    parser.add_argument("--debug", action="store_true", help="show the traceback of an error")
    module.configure(parser)
    args = _parse(parser, words)
    if args is None:
        return EXIT_OK
    args.command = ["wheelleg", name, *words]
    if command.project:
        _enter_project(args)
    return int(getattr(module, command.run)(args))


def _enter_project(args: argparse.Namespace) -> None:
    """Let a command work in the project that one stands in: with its configs, if it composes, and its terms."""
    if hasattr(args, "config_dirs"):
        args.config_dirs = with_current(args.config_dirs)
        return
    with suppress(ConfigError):  # what a command without configs does not need is no mistake
        with_current([])


def _parse(parser: Parser, words: list[str]) -> argparse.Namespace | None:
    """Parse words in any order of options and overrides; None when --help or --version has answered."""
    try:
        return parser.parse_intermixed_args(words)
    except SystemExit:
        # argparse leaves by SystemExit only after --help and --version: mistakes raise UsageError.
        return None


def _script_parser() -> Parser:
    lines = "\n".join(f"  {name:<14}{command.help}" for name, command in COMMANDS.items())
    parser = Parser(
        prog="wheelleg",
        usage="wheelleg COMMAND [OVERRIDE ...] [options]",
        description="Config-first, reproducible reinforcement learning for wheel-legged robots.",
        epilog=f"commands:\n{lines}\n\n'wheelleg COMMAND --help' tells more.",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"wheelleg {__version__}")
    parser.add_argument("--debug", action="store_true", help="show the traceback of an error")
    return parser


def _failed(message: str, status: int, debug: bool) -> int:
    if debug:
        traceback.print_exc()
    print(
        f"wheelleg: error: {message}" if status != EXIT_INTERRUPTED else "wheelleg: interrupted",
        file=sys.stderr,
    )
    return status


def _silence_stdout() -> None:
    """Point standard output at nothing, so that the interpreter's last flush does not complain."""
    null = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(null, sys.stdout.fileno())
    except (OSError, ValueError):
        pass
    finally:
        os.close(null)


@contextmanager
def _terminate_is_interrupt() -> Iterator[None]:
    """Treat SIGTERM as Ctrl-C; only the main thread may set handlers."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def interrupt(_signal: int, _frame: FrameType | None) -> None:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


if __name__ == "__main__":
    sys.exit(main())
