"""``wheelleg evaluate RUN``."""

from __future__ import annotations

import argparse

from wheelleg_exp.cli.common import add_config_dir, add_json, add_root, print_json
from wheelleg_exp.errors import EXIT_OK


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    parser.add_argument("run", metavar="RUN", help="a run directory, its id, or 'latest'")
    parser.add_argument(
        "overrides",
        nargs="*",
        metavar="OVERRIDE",
        help="protocol=walk, protocol.walk.episodes=128, or changes of the run's parameters: env.sim.dt=0.002",
    )
    parser.add_argument("--checkpoint", metavar="FILE|ITERATION", help="which checkpoint; by default the last")
    add_config_dir(parser)
    add_root(parser)
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Evaluate a policy, print the metrics and keep them under the run."""
    from wheelleg_exp.cli.play import chosen_checkpoint
    from wheelleg_exp.run.directory import RunDirectory

    directory = RunDirectory.open(args.run, args.root)
    checkpoint = None if args.checkpoint is None else chosen_checkpoint(directory, args.checkpoint)

    from wheelleg_exp.cli.printing.display import ConsoleDisplay
    from wheelleg_exp.cli.printing.evaluation import print_evaluation
    from wheelleg_exp.cli.printing.figures import shown
    from wheelleg_exp.jobs.evaluate.evaluate import evaluate_run

    with ConsoleDisplay(quiet=True) as display:
        made = evaluate_run(directory, checkpoint, args.overrides, args.command, display.test, args.config_dirs)
    if args.json:
        print_json({"run": str(directory.path), "folder": str(made.folder), **made.content})
    else:
        print(f"evaluated {shown(made.checkpoint)} without exploration noise")
        print_evaluation(made.content)
        print(f"\nevaluation: {shown(made.folder)}")
    return EXIT_OK
