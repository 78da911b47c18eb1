"""``wheelleg play RUN``."""

from __future__ import annotations

import argparse

from wheelleg_exp.cli.common import add_json, add_root, chosen_checkpoint, print_json
from wheelleg_exp.cli.driving import add_driving, is_driven, run_drive
from wheelleg_exp.errors import EXIT_OK


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    parser.add_argument("run", metavar="RUN", help="a run directory, its id, or 'latest'")
    parser.add_argument(
        "overrides", nargs="*", metavar="OVERRIDE", help="changes for this play: env.num_envs=16, seed=7"
    )
    parser.add_argument("--checkpoint", metavar="FILE|ITERATION", help="which checkpoint; by default the last")
    add_driving(parser)
    add_root(parser)
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Play a policy for one episode, print the figures and record it."""
    from wheelleg_exp.run.directory import RunDirectory

    directory = RunDirectory.open(args.run, args.root)
    checkpoint = chosen_checkpoint(directory, args.checkpoint)
    if is_driven(args):
        return run_drive(args, directory, checkpoint)

    from wheelleg_exp.cli.printing.display import ConsoleDisplay
    from wheelleg_exp.cli.printing.figures import print_figures, print_recording, shown
    from wheelleg_exp.jobs.play import play

    with ConsoleDisplay(quiet=True) as display:
        played = play(directory, checkpoint, args.overrides, args.command, display)
    if args.json:
        figures = {**played.figures.as_dict(), **played.motion.as_dict()}
        print_json({"run": str(directory.path), "folder": str(played.folder), "figures": figures})
    else:
        print(f"played {shown(played.checkpoint)} without exploration noise")
        print_figures(played.figures, played.motion)
        print(f"\nrun directory: {shown(directory.path)}")
        print_recording(played.recording)
    played.failures.require_few("in this play")
    return EXIT_OK
