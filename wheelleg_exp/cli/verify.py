"""``wheelleg verify``: check a run against its own manifest, or compare two runs."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from wheelleg_exp.cli.arguments import UsageError, add_json, add_root, offer, print_json
from wheelleg_exp.cli.printing.terminal import hanging
from wheelleg_exp.errors import EXIT_FINDING, EXIT_OK

if TYPE_CHECKING:
    from wheelleg_exp.verify import Comparison, RunFindings


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    offer("run", parser.add_argument("a", metavar="RUN", help="a run's path, its id, or latest"))
    text = "another run, which is compared with the first"
    offer("run", parser.add_argument("b", metavar="RUN", nargs="?", help=text))
    add_root(parser)
    parser.add_argument("--common", action="store_true", help="compare only the iterations that both runs have")
    parser.add_argument("--iterations", type=int, metavar="N", help="compare only the first N iterations")
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Check one run or compare two runs; return exit status 1 if a check failed or if the two runs differ."""
    from wheelleg_exp.run.run_directory import RunDirectory
    from wheelleg_exp.verify import compare_runs, verify_run

    for option, given in (("--common", args.common), ("--iterations", args.iterations is not None)):
        if given and args.b is None:
            message = "the option needs two runs, but only one was given"
            raise UsageError(message, key=option, expected="wheelleg verify A B")
    if args.iterations is not None and args.iterations < 1:
        message = "no iteration is selected for the comparison"
        raise UsageError(message, key="--iterations", expected="a whole number above 0")
    one = RunDirectory.open(args.a, args.root, odd=args.b is None)
    if args.b is None:
        findings = verify_run(one)
        _print(args.json, findings)
        return EXIT_OK if findings.is_sound else EXIT_FINDING
    comparison = compare_runs(one, RunDirectory.open(args.b, args.root), iterations=args.iterations, common=args.common)
    _print(args.json, comparison)
    return EXIT_FINDING if comparison.verdict == "different" else EXIT_OK


def _print(as_json: bool, found: RunFindings | Comparison) -> None:
    if as_json:
        print_json(found.as_dict())
    else:
        for line in found.lines():
            print(hanging(line, len(line) - len(line.lstrip()) + 4))
