"""``wheelleg zero-agent`` and ``wheelleg random-agent``."""

from __future__ import annotations

import argparse
from dataclasses import asdict
from functools import partial
from typing import TYPE_CHECKING

from wheelleg_exp.cli.arguments import add_json, add_overrides, print_json
from wheelleg_exp.errors import EXIT_OK, WheellegError

if TYPE_CHECKING:
    from wheelleg_exp.jobs.play_policy import AgentKind


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the commands' options."""
    add_overrides(parser)
    parser.add_argument("--steps", type=int, help="control steps; by default one episode")
    add_json(parser)


def _run(kind: AgentKind, args: argparse.Namespace) -> int:
    from wheelleg_exp.config.checking.find_mistakes import compose_valid

    if args.steps is not None and args.steps < 1:
        raise WheellegError(f"{args.steps} is not a positive number of steps", key="--steps", expected="at least 1")
    composed = compose_valid(args.overrides, config_dirs=args.config_dirs)

    from wheelleg_exp.cli.printing.metric_tables import print_contacts, print_figures, print_recording
    from wheelleg_exp.cli.printing.progress_display import ConsoleDisplay
    from wheelleg_exp.jobs.play_policy import run_agent

    with ConsoleDisplay(quiet=args.json) as display:
        made = run_agent(kind, composed, args.steps, display)
    if args.json:
        contacts = {name: [asdict(row) for row in rows] for name, rows in made.contacts.items()}
        print_json({"folder": str(made.folder), "contacts": contacts, "figures": made.figures.as_dict()})
    else:
        print_figures(made.figures)
        for sensor, rows in made.contacts.items():
            print_contacts(sensor, rows)
        print_recording(made.recording)
    made.failures.require_few("in this run")
    return EXIT_OK


run_zero, run_random = partial(_run, "zero"), partial(_run, "random")
