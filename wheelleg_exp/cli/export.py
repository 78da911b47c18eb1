"""``wheelleg export RUN``."""

from __future__ import annotations

import argparse
import shlex
from pathlib import Path

from wheelleg_exp.cli.arguments import add_json, add_root, chosen_checkpoint, offer, print_json
from wheelleg_exp.cli.printing.terminal import shown
from wheelleg_exp.errors import EXIT_OK

_NEXT = {
    "bundle": "python {folder}/simulate.py   (numpy and mujoco)",
    "isaaclab": "load the policy and params/env.yaml in Isaac Lab (docs/isaaclab.md)",
    "leapp": "give policy.yaml to the ros2_control runtime of the robot",
}


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    text = "a run directory, its id, 'latest', or a shipped policy: stock:walk"
    offer("run", parser.add_argument("run", metavar="RUN", help=text))
    parser.add_argument("--checkpoint", metavar="FILE|ITERATION", help="the checkpoint (default: the last one)")
    text = "bundle: runs without this program (default); isaaclab: a run folder of Isaac Lab; "
    text += "leapp: for ros2_control runtimes, needs the package leapp"
    parser.add_argument("--format", choices=tuple(_NEXT), default="bundle", help=text)
    text = "the folder to create; by default exported/FORMAT of the run"
    parser.add_argument("-o", "--output", type=Path, metavar="DIR", help=text)
    add_root(parser)
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Export a policy for deployment, and print how much one step of the exported files differs from the simulation."""
    from wheelleg_exp.run.run_directory import RunDirectory

    directory = RunDirectory.open(args.run, args.root)
    checkpoint = chosen_checkpoint(directory, args.checkpoint)

    from wheelleg_exp.jobs.export.export_bundle import export

    made = export(directory, checkpoint, args.output, args.command, args.format)
    if args.json:
        found = {"run": str(directory.path), "checkpoint": str(made.checkpoint), "folder": str(made.folder)}
        margins = [margin._asdict() for margin in made.margins]
        print_json({**found, "largest_difference": made.differences, "lacks": made.notes, "margins": margins})
        return EXIT_OK
    print(f"exported {shown(made.checkpoint)} to {shown(made.folder)}")
    if made.differences:
        differences = ", ".join(f"{name} {difference:.1g}" for name, difference in made.differences.items())
        print(f"largest difference of a step from the simulation: {differences}")
    for margin in made.margins:
        print(f"largest survived {margin.name}: {margin.policy:.3g} {margin.unit}")
    for note in made.notes:
        print(f"not exported: {note}" if args.format == "isaaclab" else f"it lacks {note}")
    print(f"next: {_NEXT[args.format].format(folder=shlex.quote(shown(made.folder)))}")
    return EXIT_OK
