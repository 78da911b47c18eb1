"""``wheelleg play RUN --drive`` and ``--script FILE``."""

from __future__ import annotations

import argparse
import shlex
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any

from wheelleg_exp.cli.common import UsageError, print_json
from wheelleg_exp.errors import EXIT_OK

if TYPE_CHECKING:
    from wheelleg_exp.jobs.drive.drive import Drive
    from wheelleg_exp.run.directory import RunDirectory

_PORT = 8080
_OWN = {"--scene": "scene", "--port": "port"}  # options that mean nothing when nobody drives


def add_driving(parser: argparse.ArgumentParser) -> None:
    """Add what a drive takes."""
    parser.add_argument("--drive", action="store_true", help="drive the robot by hand, live in the browser")
    parser.add_argument("--script", type=Path, metavar="FILE", help="drive it by a list of commands (docs/drive.md)")
    parser.add_argument("--scene", metavar="NAME", help="the ground to drive on; by default the run's own")
    parser.add_argument("--port", type=int, help=f"port of the page, on this machine alone (default: {_PORT})")


def is_driven(args: argparse.Namespace) -> bool:
    """Return whether the robot is to be driven.

    Raises:
        UsageError: an option is given that only a drive has.
    """
    if args.drive or args.script is not None:
        return True
    for option, name in _OWN.items():
        if getattr(args, name) is not None:
            raise UsageError("is for driving", key=option, expected="--drive or --script FILE beside it")
    return False


def run_drive(args: argparse.Namespace, run: RunDirectory, checkpoint: Path | None) -> int:
    """Drive, and print what was driven."""
    from wheelleg_exp.cli.printing.display import ConsoleDisplay
    from wheelleg_exp.jobs.drive.drive import Wish, drive

    wish = Wish(run, checkpoint, args.overrides, args.scene, args.script, args.command)
    with ConsoleDisplay(quiet=True) as display, _page(args, run) as page:
        drives = drive(wish, display, page)
    if args.json:
        documents = [{"folder": str(made.folder), "figures": made.figures} for made in drives]
        print_json({"run": str(run.path), "drives": documents})
        return EXIT_OK
    for made in drives:
        _print(made)
    return EXIT_OK


def _page(args: argparse.Namespace, run: RunDirectory) -> Any:
    if not args.drive:
        return nullcontext()
    from wheelleg_exp.jobs.drive.ground import scenes
    from wheelleg_exp.jobs.drive.page import DrivePage

    return DrivePage(_PORT if args.port is None else args.port, scenes(), run.checkpoints())


def _print(made: Drive) -> None:
    from wheelleg_exp.cli.printing.figures import print_recording, shown, tool
    from wheelleg_exp.cli.printing.tables import print_table
    from wheelleg_exp.definitions.drive import rows

    print(f"drove {shown(made.checkpoint)} without exploration noise")
    print_table(("figure", "value"), rows(made.figures))
    print(f"\nagain: {tool('wheelleg')} {shlex.join(_again(made))}")
    print_recording(made.recording)


def _again(made: Drive) -> list[str]:
    """Return the words that drive the same again."""
    from wheelleg_exp.cli.printing.figures import shown
    from wheelleg_exp.jobs.drive.ground import OWN

    run, scene = made.folder.parent.parent, made.figures["scene"]
    own = made.checkpoint.resolve().is_relative_to(run)
    words = ["play", shown(run), *made.figures["overrides"]]
    words += ["--checkpoint", made.checkpoint.name if own else shown(made.checkpoint)]
    words += [] if scene == OWN else ["--scene", scene]
    return [*words, "--script", shown(made.folder / "driven.yaml")]
