"""Run the console script ``wheelleg``: find the command, import only its module, and return the exit status."""

from __future__ import annotations

import argparse
import atexit
import gc
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
from wheelleg_exp.cli.arguments import Parser, UsageError
from wheelleg_exp.cli.printing.terminal import hanging, lasting_streams
from wheelleg_exp.errors import (
    EXIT_FAILED,
    EXIT_INTERRUPTED,
    EXIT_OK,
    ConfigError,
    Interrupted,
    WheellegError,
    nearest_name,
)
from wheelleg_exp.machine import START_SPACE, prepare_threads, require_room
from wheelleg_exp.packages import trust, with_current
from wheelleg_exp.stop_request import stop_signals
from wheelleg_exp.user_exceptions import in_words


@dataclass(frozen=True)
class Command:
    """One command: a module in ``cli`` with ``configure(parser)``, and the text in ``wheelleg --help``."""

    module: str
    help: str
    run: str = "run"  # ``run`` names the function in ``module`` that runs the command.
    project: bool = True  # ``project`` is true if the command reads configs of the current folder's project.


COMMANDS: dict[str, Command] = {
    "train": Command("train", "compose, check, train, and write one run directory"),
    "resume": Command("resume", "continue a run that was stopped or killed, as if it had never stopped"),
    "play": Command("play", "run a policy and record it"),
    "evaluate": Command("evaluate", "measure a policy on fixed scenarios, with confidence intervals"),
    "results": Command("results", "write a table of results with everything needed to reproduce it, or reproduce it"),
    "export": Command("export", "write a policy for deployment: a folder that runs without this program"),
    "zero-agent": Command("agents", "run a task with zero actions and record it", "run_zero"),
    "random-agent": Command("agents", "run a task with random actions and record it", "run_random"),
    "report": Command("report", "write one HTML file about a run"),
    "replay": Command("replay", "re-run a training from its snapshot, with its own code, and compare", project=False),
    "verify": Command("verify", "check a run against its own manifest, or compare two runs", project=False),
    "inspect": Command("inspect", "show the contents of a recording, and answer questions about it"),
    "identify": Command("identify", "identify a robot's motors from a log of chirps, and write a robot profile"),
    "convert": Command("convert", "convert a robot file to MJCF, with a report", project=False),
    "check": Command("configs.check", "find every mistake in a config, and with --physics check its numbers"),
    "doctor": Command(
        "configs.doctor", "examine a robot as an expert would: what is wrong, how it is known, what to write"
    ),
    "compose": Command("configs.compose", "print the composed config"),
    "explain": Command(
        "configs.explain", "explain a key: its value, where it was set, its meaning, and the values that it accepts"
    ),
    "diff": Command("configs.diff", "compare two runs, tasks or lists of overrides by meaning"),
    "list": Command("list", "list tasks, terms, groups, options or runs"),
    "new": Command("new", "create your own project: a robot, a task, a term and a test", project=False),
    "import": Command("import_run", "make a project and a run from an Isaac Lab run, with its policy", project=False),
    "completion": Command("completion", "print the shell's completion script", project=False),
}


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command of ``wheelleg`` and return its exit status; ``argv`` contains the words after ``wheelleg``."""
    prepare_threads()
    if argv is None:
        gc.set_threshold(10_000)  # Run Python's garbage collector only after every 10,000 new objects.
        atexit.register(_skip_last_collection)
    words = list(sys.argv[1:] if argv is None else argv)
    with lasting_streams():
        return _answer(words, "--debug" in words)


def _skip_last_collection() -> None:
    """Skip the collection at exit, which takes 0.7 s with torch; nanobind would warn about each of its objects."""
    if all(metaclass.__module__ != "nanobind" for metaclass in type.__subclasses__(type)):
        gc.freeze()


def _answer(words: list[str], debug: bool) -> int:
    try:
        with _interrupts():
            require_room(START_SPACE)
            status = _dispatch(words)
            sys.stdout.flush()
            return status
    except KeyboardInterrupt:
        return _failed("interrupted", EXIT_INTERRUPTED, debug)
    except WheellegError as error:
        return _failed(str(error), error.exit_code, debug)
    except BaseException as error:  # A user-defined module can raise SystemExit during its import.
        hint = "" if debug else " (--debug shows the traceback)"
        return _failed(f"{in_words(error)}{hint}", EXIT_FAILED, debug)


def _dispatch(words: list[str]) -> int:
    lines = "\n".join(hanging(command.help, 16, f"  {name}") for name, command in COMMANDS.items())
    script = Parser(
        prog="wheelleg",
        usage="wheelleg COMMAND [OVERRIDE ...] [options]",
        description=hanging("Config-first, reproducible reinforcement learning for wheel-legged robots.", 0),
        epilog=f"commands:\n{lines}\n\nFor the options of a command: wheelleg COMMAND --help",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    script.add_argument("--version", action="version", version=f"wheelleg {__version__}")
    script.add_argument("--debug", action="store_true", help="show the traceback of an error")
    split = next((i for i, word in enumerate(words) if not word.startswith("-")), len(words))
    if _parse(script, words[:split]) is None:
        return EXIT_OK
    commands = "one of " + ", ".join(COMMANDS)
    if split == len(words):
        raise UsageError("a command is missing", key="wheelleg", expected=commands)
    name, words = words[split], words[split + 1 :]
    command = COMMANDS.get(name)
    if command is None:
        nearest = nearest_name(name, [*COMMANDS, "--version", "--help"])
        raise UsageError("wheelleg has no command with the given name", key=name, expected=commands, nearest=nearest)
    module = import_module(f"wheelleg_exp.cli.{command.module}")
    parser = Parser(prog=f"wheelleg {name}", description=f"{command.help[0].upper()}{command.help[1:]}.")
    parser.add_argument("--debug", action="store_true", help="show the traceback of an error")
    module.configure(parser)
    args = _parse(parser, words)
    if args is None:
        return EXIT_OK
    args.command = ["wheelleg", name, *words]
    # Load the user project in the current folder; for ``train`` and ``resume``, trust the code in ``--config-dir``.
    if command.project and hasattr(args, "config_dirs"):
        named, args.config_dirs = len(args.config_dirs), with_current(args.config_dirs)
        if name in ("train", "resume"):
            trust(args.config_dirs[:named])
    elif command.project:
        with suppress(ConfigError):  # A command that reads no configs ignores errors in the user's project.
            with_current([])
    return int(getattr(module, command.run)(args))


def _parse(parser: Parser, words: list[str]) -> argparse.Namespace | None:
    """Parse command-line options and config overrides in any order; return None after ``--help`` or ``--version``."""
    try:
        return parser.parse_intermixed_args(words)
    except SystemExit:  # Only --help and --version raise SystemExit; wrong options raise UsageError.
        return None


def _failed(message: str, status: int, debug: bool) -> int:
    if debug:
        traceback.print_exc()
    print(f"wheelleg: error: {message}" if status != EXIT_INTERRUPTED else "wheelleg: interrupted", file=sys.stderr)
    return status


@contextmanager
def _interrupts() -> Iterator[None]:
    """Make SIGTERM and SIGHUP act like Ctrl-C inside the ``with`` block; do nothing outside the main thread."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def interrupt(_signal: int, _frame: FrameType | None) -> None:
        raise Interrupted

    before = {number: signal.signal(number, interrupt) for number in stop_signals()}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


if __name__ == "__main__":
    sys.exit(main())
