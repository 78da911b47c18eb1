"""Define the command ``wheelleg play RUN`` with the options ``--drive`` and ``--script FILE``."""

from __future__ import annotations

import argparse
import json
import shlex
import sys
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any

from wheelleg_exp.cli.arguments import UsageError, add_json, add_root, chosen_checkpoint, offer, print_json
from wheelleg_exp.cli.printing.terminal import print_table, shown, tool
from wheelleg_exp.errors import EXIT_OK

if TYPE_CHECKING:
    from wheelleg_exp.run.run_directory import RunDirectory

_PORT = 8080


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    text = "a run directory, its id, 'latest', or a shipped policy: stock:walk"
    offer("run", parser.add_argument("run", metavar="RUN", help=text))
    text = "changes for this play: env.num_envs=16, seed=7"
    offer("override", parser.add_argument("overrides", nargs="*", metavar="OVERRIDE", help=text))
    parser.add_argument("--checkpoint", metavar="FILE|ITERATION", help="the checkpoint (default: the last one)")
    parser.add_argument("--drive", action="store_true", help="drive the robot by hand, live in the browser")
    text = "drive the robot by a list of commands (docs/drive.md)"
    parser.add_argument("--script", type=Path, metavar="FILE", help=text)
    parser.add_argument("--scene", metavar="NAME", help="the ground to drive on (default: the ground of the run)")
    parser.add_argument("--port", type=int, help=f"port of the page, on this machine alone (default: {_PORT})")
    add_root(parser)
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Simulate one episode with a trained policy, record the episode, and print performance figures of the episode."""
    from wheelleg_exp.run.run_directory import RunDirectory
    from wheelleg_exp.run.stock_policies import known_fault

    directory = RunDirectory.open(args.run, args.root)
    fault = known_fault(directory.manifest().data.get("stock"))
    if fault is not None:
        print(f"warning: this policy does not meet the bounds of shipped policies: it {fault}", file=sys.stderr)
    checkpoint = chosen_checkpoint(directory, args.checkpoint)
    if args.drive or args.script is not None:
        return _run_drive(args, directory, checkpoint)
    for option, value in (("--scene", args.scene), ("--port", args.port)):
        if value is not None:
            raise UsageError("the option needs --drive/--script", key=option, expected="also --drive or --script FILE")

    from wheelleg_exp.cli.printing.metric_tables import print_figures, print_recording
    from wheelleg_exp.cli.printing.progress_display import ConsoleDisplay
    from wheelleg_exp.jobs.play_policy import play

    with ConsoleDisplay(quiet=True) as display:
        played = play(directory, checkpoint, args.overrides, args.command, display)
    if args.json:
        figures = {**played.figures.as_dict(), **vars(played.motion)}
        print_json({"run": str(directory.path), "folder": str(played.folder), "figures": figures})
    else:
        print(f"played {shown(played.checkpoint)} without exploration noise")
        print_figures(played.figures, played.motion)
        print(f"\nrun directory: {shown(directory.path)}")
        print_recording(played.recording)
    played.failures.require_few("in this play")
    return EXIT_OK


def _run_drive(args: argparse.Namespace, run: RunDirectory, checkpoint: Path | None) -> int:
    from wheelleg_exp.cli.printing.metric_tables import print_recording
    from wheelleg_exp.cli.printing.progress_display import ConsoleDisplay
    from wheelleg_exp.definitions import drive_rows
    from wheelleg_exp.jobs.drive.run_drive import OWN_GROUND, DriveRequest, drive, policies, scenes

    request = DriveRequest(run, checkpoint, args.overrides, args.scene, args.script, args.command)
    place: Any = nullcontext()
    others = policies(run, args.root) if args.drive else {}
    if args.drive:
        from wheelleg_exp.jobs.drive.drive_page import DrivePage

        place = DrivePage(_PORT if args.port is None else args.port, scenes(), list(others))
    with ConsoleDisplay(quiet=True) as display, place as page:
        if args.json and page is not None:
            port, keys_port = page.ports
            start = {"run": str(run.path), "url": page.url, "port": port, "keys_port": keys_port}
            print(json.dumps(start), file=sys.stderr, flush=True)  # Standard output has one document.
        drives = drive(request, display, page, others)
    if args.json:
        documents = [{"folder": str(made.folder), "figures": made.figures} for made in drives]
        print_json({"run": str(run.path), "drives": documents})
        return EXIT_OK
    for made in drives:
        print(f"drove {shown(made.checkpoint)} without exploration noise")
        print_table(("figure", "value"), list(drive_rows(made.figures)))
        run_of_policy, scene = made.folder.parent.parent, made.figures["scene"]
        own = made.checkpoint.resolve().is_relative_to(run_of_policy)
        words = ["play", shown(run_of_policy), *made.figures["overrides"]]
        words += ["--checkpoint", made.checkpoint.name if own else shown(made.checkpoint)]
        words += [] if scene == OWN_GROUND else ["--scene", scene]
        words += ["--script", shown(made.folder / "driven.yaml")]
        if made.figures["handed_over"]:
            print("\nnot repeatable: it started in the last state of the drive before")
        else:
            print(f"\nrepeat: {tool('wheelleg')} {shlex.join(words)}")
        print_recording(made.recording)
    return EXIT_OK
